"""Evenly subsampled beams of any scanner, deskewed to the base frame at the end of their step.

Beams are first listed by stamp and step, then subsampled; only the selected ones are transformed, to save time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter
from graphslam.core.point_clouds import PointClouds
from graphslam.core.poses import group_of
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import LaserScans
from graphslam.core.trajectory import Trajectory

Index = npt.NDArray[np.int64]
_AT_ONCE = 1 << 18


class BeamSource(Protocol):
    """Beams of one stream, numbered; invalid readings are left out and counted."""

    times: Array
    """Stamp of each beam ``(q,)`` [s]."""
    dim: int
    max_range: float
    sigma: float
    skipped: Array
    """Stamps of the scans left out as repetitions, during which the robot may move [s]."""

    def beams(self, chosen: Index) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Origins ``(k, dim)``, ends ``(k, dim)`` in the base frame at the time of the beam, and whether they are
        returns; for beams with increasing numbers."""
        ...


def cut_beams(
    origins: Array, ends: Array, met: npt.NDArray[np.bool_], max_range: float
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Ends of beams cut at ``max_range``: longer beams become beams without a return."""
    along = ends - origins
    length = np.linalg.norm(along, axis=1)
    far = length >= max_range
    scale = np.where(far, max_range / np.where(length > 0, length, 1.0), 1.0)
    return origins + scale[:, None] * along, np.asarray(met & ~far)


@dataclass(slots=True)
class _Beams:
    scans: Any
    record: Index
    beam: Index
    times: Array
    max_range: float
    sigma: float
    skipped: Array


class _Spinning(_Beams):
    scans: RangeScans
    dim = 3

    def beams(self, chosen: Index) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        s, k, j = self.scans, self.record[chosen], self.beam[chosen]
        ranges = s.ranges[k, j].astype(np.float64)
        origins = np.broadcast_to(s.T_base_mount[:3], (len(k), 3))
        met = ranges < s.max_range
        reach = np.minimum(ranges, s.max_range)
        return origins, origins + reach[:, None] * s.beam_directions(k, j), met


class _Planar(_Beams):
    scans: LaserScans
    dim = 2

    def beams(self, chosen: Index) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        s, k, j = self.scans, self.record[chosen], self.beam[chosen]
        ranges = s.ranges[k, j].astype(np.float64)
        reach, angle = np.minimum(ranges, s.max_range), s.bearings[j] + s.T_base_sensor[2]
        origins = np.broadcast_to(s.T_base_sensor[:2], (len(k), 2))
        return origins, origins + reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), ranges < s.max_range


class _Clouds(_Beams):
    scans: PointClouds
    dim = 3

    def beams(self, chosen: Index) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        c, record, row = self.scans, self.record[chosen], self.beam[chosen]
        ends = np.empty((len(chosen), 3))
        bounds = np.flatnonzero(np.append(True, np.diff(record) != 0)) if len(record) else np.zeros(0, dtype=np.int64)
        for a, b in zip(bounds, np.append(bounds[1:], len(record))):
            ends[a:b] = c.cloud(int(record[a]))[row[a:b]]
        origins = np.broadcast_to(se3.se3_transform(c.T_base_sensor, c.origin), ends.shape)
        return origins, se3.se3_transform(c.T_base_sensor, ends), np.ones(len(ends), dtype=np.bool_)


Scanner = RangeScans | PointClouds | LaserScans


def repeated_scans(ranges: npt.NDArray[np.floating[Any]], max_range: float) -> npt.NDArray[np.bool_]:
    """Which scans ``(n,)`` repeat the previous one exactly and have a return: nothing was measured.

    Parameters
    ----------
    ranges : (n, m)
        NaN: no reading; ≥ ``max_range``: no return.
    """
    out = np.zeros(len(ranges), dtype=np.bool_)
    if len(ranges) > 1:
        with np.errstate(invalid="ignore"):
            same = (ranges[1:] == ranges[:-1]) | (np.isnan(ranges[1:]) & np.isnan(ranges[:-1]))
            met = (ranges[1:] > 0) & (ranges[1:] < max_range)
        out[1:] = same.all(axis=1) & met.any(axis=1)
    return out


def repeated_clouds(clouds: Iterable[Array]) -> npt.NDArray[np.bool_]:
    """The same for clouds ``(m, 3)``."""
    out, before = [], None
    for cloud in clouds:
        out.append(before is not None and len(cloud) > 0 and np.array_equal(before, cloud))
        before = cloud
    return np.array(out, dtype=np.bool_)


def beam_source(
    stream: Scanner, name: str, *, min_range: float, range_sigma: float, cloud_range: float, drops: DropCounter
) -> BeamSource:
    """List the valid beams of a stream.

    Left out and counted: beams without a reading or nearer than ``min_range``, and scans that repeat the previous one
    exactly: a real sensor never does that, and a repeated scan would make the robot seem stationary. Scans without any
    return are kept, because they show free space, and counted.
    """
    if isinstance(stream, PointClouds):
        return _list_clouds(stream, name, min_range, range_sigma, cloud_range, drops)
    ranges = stream.ranges
    with np.errstate(invalid="ignore"):
        nothing = ranges >= stream.max_range
        good = nothing | (ranges >= min_range)
    unread = np.isnan(ranges)
    again = repeated_scans(ranges, stream.max_range)
    drops.drop(name, "scan equal to the one before", int(again.sum()))
    drops.drop(name, "beams without a reading", int(unread.sum()))
    drops.drop(name, f"nearer than {min_range:g} m", int(np.sum(~good & ~unread)))
    drops.drop(name, "scan without a reading", int(np.sum(~good.any(axis=1))))
    drops.drop(name, "scan without a hit (kept)", int(np.sum((nothing | ~good).all(axis=1) & good.any(axis=1))))
    record, beam = (a.astype(np.int64) for a in np.nonzero(good & ~again[:, None]))
    if isinstance(stream, RangeScans):
        times = stream.times[record] + stream.beam_times[beam]
        return _Spinning(stream, record, beam, times, stream.max_range, stream.sigma, stream.times[again])
    return _Planar(stream, record, beam, stream.times[record], stream.max_range, range_sigma, stream.times[again])


def _list_clouds(
    clouds: PointClouds, name: str, min_range: float, sigma: float, max_range: float, drops: DropCounter
) -> BeamSource:
    rows, near, empty = [], 0, 0
    again: list[int] = []
    before: Array | None = None
    for k in range(len(clouds)):
        cloud = clouds.cloud(k)
        length = np.linalg.norm(cloud - clouds.origin, axis=1)
        good = np.flatnonzero(length >= max(min_range, 1e-9))
        near += len(length) - len(good)
        empty += len(good) == 0
        if before is not None and len(cloud) and np.array_equal(before, cloud):
            again.append(k)
            good = good[:0]
        before = cloud
        rows.append(good)
    drops.drop(name, "scan equal to the one before", len(again))
    drops.drop(name, f"nearer than {min_range:g} m", near)
    drops.drop(name, "scan without a reading", empty)
    record = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    row = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
    return _Clouds(clouds, record, row.astype(np.int64), clouds.times[record], max_range, sigma, clouds.times[again])


def stratified_indices(n: int, most: int) -> Index:
    """``most`` of ``n`` numbers, increasing, one from each of as many equal intervals; all if there are no more.

    The offset in each interval follows the golden ratio, so that the choice is not in phase with the beams of a scan
    (not always every second beam).
    """
    if n <= most:
        return np.arange(n, dtype=np.int64)
    i = np.arange(most)
    offset = np.mod(i * 0.6180339887498949 + 0.5, 1.0)
    edges = (i * n) // most
    width = ((i + 1) * n) // most - edges
    return np.asarray(edges + (offset * width).astype(np.int64), dtype=np.int64)


def assign_steps(beam_times: Array, step_times: Array, begin: float) -> Index:
    """Step ``(q,)`` of each beam: the first that ends at its stamp or later; -1 outside.

    Parameters
    ----------
    beam_times : (q,)
    step_times : (n,)
    begin : float
        Start of the first step [s].
    """
    step = np.searchsorted(step_times, beam_times, side="left")
    return np.where((beam_times < begin) | (step == len(step_times)), -1, step).astype(np.int64)


def deskew_beams(
    path: Trajectory, step_poses: Array, step: Index, times: Array, origins: Array, ends: Array
) -> tuple[Array, Array]:
    """Transform beams from the base at their own time to the base at the end of their step.

    Parameters
    ----------
    path : Trajectory
        ``T_frame_base(t)``; covers ``times``.
    step_poses : (n, 7) or (n, 3)
        Same frame.
    step, times : (q,)
        Step and time of each beam, as of :func:`assign_steps`.
    origins, ends : (q, dim)

    Returns
    -------
    origins, ends : (q, dim)
    """
    out_origins, out_ends = np.empty_like(ends), np.empty_like(ends)
    group = group_of(step_poses)
    for a in range(0, len(times), _AT_ONCE):
        part = slice(a, min(a + _AT_ONCE, len(times)))
        # beams of one stamp share one transform (a cloud has thousands)
        stamps, first, which = np.unique(times[part], return_index=True, return_inverse=True)
        T = group.between(step_poses[step[part][first]], path.interpolate(stamps))[which]
        out_origins[part], out_ends[part] = group.transform(T, origins[part]), group.transform(T, ends[part])
    if not (np.all(np.isfinite(out_ends)) and np.all(np.isfinite(out_origins))):
        raise DataError("a beam has no finite position", got=f"beam {np.argwhere(~np.isfinite(out_ends))[:1]}")
    return out_origins, out_ends
