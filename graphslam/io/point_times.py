"""Times of the points of a scan: their unit, and whether they are offsets from the scan or stamps on its clock.

Files and messages have a field of times, but not its unit. The unit is chosen once for the whole log, such that the
duration of a scan is close to the time between scans, and never much longer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array

UNITS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
TICKS = {"ticks of 100 µs": 1e-4, "ticks of 10 µs": 1e-5, "ticks of 100 ns": 1e-7}
"""Units [s] of some drivers; used only if the duration of a scan then equals the time between scans (FULL)."""
SWEEP = (0.005, 2.0)
"""Plausible durations of a scan [s]."""
FULL = (0.8, 1.05)
"""Duration of a scan divided by the time between scans, if scans are contiguous."""
LONGEST = 1.25
"""Maximal duration of a scan divided by the time between scans."""
SAME_CLOCK = 5.0
"""If the median time of points is this close to the stamp of the scan, the times are stamps on its clock [s]."""


@dataclass(frozen=True, slots=True)
class PointClock:
    """Unit of the times of points.

    Parameters
    ----------
    unit : float
        Unit of the field [s].
    name : str
        Name of the unit.
    lasts : float
        Median duration of a scan [s].
    """

    unit: float
    name: str
    lasts: float

    def ages(self, times: Array | None, stamp: float) -> Array | None:
        """Stamp of the scan minus time of each point ``(m,)`` [s]; None without times, or if all are equal.

        Times with a median within 5 s of the stamp are stamps on its clock, others are offsets from it.
        """
        if times is None or len(times) < 2 or np.ptp(times) == 0.0:
            return None
        seconds = times * self.unit
        if abs(stamp) > SAME_CLOCK and abs(float(np.median(seconds)) - stamp) <= SAME_CLOCK:
            return np.asarray(stamp - seconds)
        offset = seconds if float(np.abs(seconds).min()) <= SWEEP[1] else seconds - seconds.min()
        return np.asarray(-offset)


@dataclass(frozen=True, slots=True)
class PointTimes:
    """Use of the point times of a log.

    Parameters
    ----------
    state : {"used", "none", "constant", "unclear"}
    note : str
        The state as text.
    clock : PointClock or None
        Unit of the times; None: they are not used.
    doubtful : bool
        The unit is unusual, or none fits: the note becomes a line of the verdict.
    """

    state: str
    note: str
    clock: PointClock | None = None
    doubtful: bool = False

    def assumed(self) -> list[tuple[str, str]]:
        """Level and text of a line of the verdict, if doubtful."""
        return [("look", f"{self.note}. Write them in s, ms, µs or ns.")] if self.doubtful else []


def choose_point_times(spans: Iterable[float], stamps: Array | None) -> PointTimes:
    """Choose the unit of the point times of a log.

    Parameters
    ----------
    spans : iterable of float
        Latest minus earliest time of each scan with times, in the unit of the field.
    stamps : (n,) or None
        Stamps of the scans [s]; None if the log has none.
    """
    found = np.array([s for s in spans if np.isfinite(s)])
    if not len(found):
        return PointTimes("none", "points without times")
    span = float(np.median(found[found > 0])) if np.any(found > 0) else 0.0
    if span == 0.0:
        return PointTimes("constant", "times of points say nothing: as good as one time for all")
    apart = _spacing(stamps)
    clock = _by_spacing(span, apart) if apart is not None else _by_sweep(span, SWEEP[1])
    if clock is None:
        of = "" if apart is None else f" of scans that are {apart:.3g} s apart"
        note = f"times of points{of} span {span:.6g}: no unit fits; they are not used, scans are not deskewed"
        return PointTimes("unclear", note, doubtful=True)
    usual = clock.name in UNITS
    how = "" if usual else f", read as {clock.name} because a scan then lasts as long as scans are apart"
    return PointTimes("used", f"times of points{how}: a scan lasts {clock.lasts:.3f} s", clock, doubtful=not usual)


def _spacing(stamps: Array | None) -> float | None:
    steps = np.diff(stamps) if stamps is not None else np.zeros(0)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else None


def _by_spacing(span: float, apart: float) -> PointClock | None:
    units = UNITS | TICKS
    if 0.9 <= span <= 1.001:
        units = units | {"shares of the scan": apart}
    for name, unit in units.items():
        if FULL[0] * apart <= span * unit <= FULL[1] * apart:
            return PointClock(unit, name, span * unit)
    return _by_sweep(span, min(SWEEP[1], LONGEST * apart))


def _by_sweep(span: float, longest: float) -> PointClock | None:
    for name, unit in UNITS.items():
        if SWEEP[0] <= span * unit <= longest:
            return PointClock(unit, name, span * unit)
    return None
