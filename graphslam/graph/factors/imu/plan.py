"""Plan the factors of IMU readings in a graph, and count what is not used by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.factors.imu.config import BodyPlace, ImuConfig
from graphslam.graph.factors.imu.preintegration import longest_pause
from graphslam.graph.factors.imu.records import ForceRecord, ImuRecord
from graphslam.graph.submap_node import SubmapNode

FEWEST = 4
"""Minimum number of readings for a preintegrated measurement: with fewer, Δp and Δv are not independent."""


@dataclass(frozen=True, slots=True)
class ImuFactorPlan:
    """Planned factors of IMU readings.

    Parameters
    ----------
    pairs : list of (int, int)
        Nodes to connect by a preintegrated measurement.
    gravity : list of int
        Nodes that get a gravity factor.
    dropped : Counter of str
        Number of unused parts by reason.
    """

    pairs: list[tuple[int, int]]
    gravity: list[int]
    dropped: Counter[str]


def plan_factors(
    submaps: Sequence[SubmapNode],
    records: Collection[FactorRecord],
    imu: Imu,
    stream: str,
    cfg: ImuConfig,
    places: dict[int, BodyPlace],
    waiting: int | None = None,
    *,
    dim: int = 3,
) -> ImuFactorPlan:
    """Pairs and nodes that get factors in addition to those of ``records``, and a count of others by reason.

    A node whose next one is ``waiting`` for its submap may get a preintegrated measurement later, so no gravity yet.
    """
    t, pause = imu.times, cfg.pause_of(imu.times)
    had = {(r.i, r.j) for r in records if isinstance(r, ImuRecord) and r.stream == stream}
    heard = {r.node for r in records if isinstance(r, ForceRecord) and r.stream == stream}
    pairs: list[tuple[int, int]] = []
    near, dropped = {n for pair in had for n in pair}, Counter[str]()
    near |= {a for s in submaps for a, b in zip(s.nodes, s.nodes[1:]) if b == waiting}
    for s in submaps:
        for a, b in zip(s.nodes, s.nodes[1:]):
            if (a, b) in had:
                continue
            why = _why_not(places.get(a), places.get(b), t, cfg.span(dim), pause)
            if why:
                dropped[why] += 1
            else:
                pairs.append((a, b))
                near |= {a, b}
    gravity: list[int] = []
    last = -np.inf
    for n, place in sorted(places.items(), key=lambda item: item[1].time):
        if not (cfg.gravity and cfg.accelerometer and dim == 3) or n in near:
            continue
        begin, end = force_window(place.time, cfg)
        if n in heard:
            last = end
            continue
        if not (t[0] <= begin and end <= t[-1]):
            dropped["gravity outside the readings"] += 1
        elif longest_pause(t, np.array([begin]), np.array([end]))[0] > pause:
            dropped["gravity in a pause of the readings"] += 1
        elif begin >= last:
            gravity.append(n)
            last = end
    return ImuFactorPlan(pairs, gravity, dropped)


def force_window(t: float, cfg: ImuConfig) -> tuple[float, float]:
    """Interval over which the specific force around an instant is averaged."""
    return float(t) - 0.5 * cfg.window, float(t) + 0.5 * cfg.window


def join_readings(old: Imu, new: Imu, stream: str) -> Imu:
    """Concatenate two portions of one IMU's readings."""
    if len(new.times) == 0:
        return old
    if new.times[0] <= old.times[-1]:
        raise DataError(
            "readings of this IMU were given before", where=stream, got=f"from {new.times[0]:.3f} s on",
            wanted=f"after {old.times[-1]:.3f} s",
        )  # fmt: skip
    if not np.array_equal(old.T_base_imu, new.T_base_imu) or old.noise != new.noise:
        raise DataError("noise or mounting of this IMU has changed", where=stream, wanted="one unit a stream")
    return replace(
        old,
        times=np.concatenate([old.times, new.times]),
        angular_rate=np.concatenate([old.angular_rate, new.angular_rate]),
        specific_force=np.concatenate([old.specific_force, new.specific_force]),
        attitude=None,
    )


def _why_not(a: BodyPlace | None, b: BodyPlace | None, t: Array, longest: float, pause: float) -> str:
    """Reason against a preintegrated measurement between two nodes; empty if there is none."""
    if a is None or b is None:
        return "the path does not reach the node"
    if b.time - a.time > longest:
        return "too far apart"
    if a.time < t[0]:
        return "before the first reading"
    if b.time > t[-1]:
        return "after the last reading"
    if longest_pause(t, np.array([a.time]), np.array([b.time]))[0] > pause:
        return "a pause in the readings"
    inside = int(np.searchsorted(t, b.time) - np.searchsorted(t, a.time))
    return "too few readings" if inside < FEWEST else ""
