"""Two front ends on one log: one maps intervals with landmarks, the other one the rest.

Both need the motion, so the log is cut into intervals, each mapped by one of them. A submap of the next interval begins
where the last one ended, and every record is used once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import LandmarkObservations, LaserScans, Odometry, SteeringControls, VelocityControls
from graphslam.core.submap import Submap
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.odometry.make_steps import scanner_names
from graphslam_frontends.stepwise import StepwiseFrontEnd

WINDOW = 5.0
"""Window length for the decision whether there are enough landmarks [s]."""
SHORTEST = 20.0
"""Shorter intervals of one front end are merged with their neighbours [s]."""
SEEN = 2
"""Least number of landmarks in a scan that determine a planar pose."""
SHARE = 0.5
"""Least share of the scans of a window with that many landmarks."""
SAME_TIME = 1e-6
"""Stamps that differ by less are equal [s]."""


@dataclass(frozen=True, slots=True)
class Interval:
    """An interval of the log and the front end that maps it.

    Parameters
    ----------
    begin, end : float
        Base of the first submap and end of the last one [s]; ``-inf`` and ``inf`` at the ends of the log.
    first, last : float
        Interval of the scans used [s]; its ends are included for beams, excluded for landmarks.
    """

    landmarks: bool
    begin: float
    end: float
    first: float
    last: float


@dataclass(frozen=True, slots=True)
class MixedFrontEnd(FrontEnd):
    """A front end for landmarks and one for planar scans, each in suitable intervals of the log.

    The front end for landmarks maps windows of :data:`WINDOW` seconds in which :data:`SHARE` of the scans have
    :data:`SEEN` landmarks or more; the other one maps the rest. Intervals shorter than :data:`SHORTEST` are merged with
    their neighbours.

    Parameters
    ----------
    parts : (front end, front end)
        In any order.
    """

    parts: tuple[FrontEnd, ...]
    name: ClassVar[str] = "mixed"
    draws: ClassVar[bool] = True

    @property
    def config(self) -> dict[str, Any]:  # type: ignore[override]
        """Configuration of each front end by its name."""
        return {p.name: p.config for p in self.parts}

    @property
    def calibrated_part(self) -> FrontEnd:
        """The front end for the calibration: the motion is common to both, and landmarks show its errors better."""
        return min(self.parts, key=lambda p: p.calibrates != "observations")

    def with_calibration(self, log: SensorLog, asked: Mapping[str, Any], *, corrected: bool, drift: bool) -> FrontEnd:
        """See :class:`~graphslam_frontends.base.FrontEnd`; for each front end."""
        return MixedFrontEnd(
            tuple(p.with_calibration(log, asked.get(p.name, {}), corrected=corrected, drift=drift) for p in self.parts)
        )

    def split(self, log: SensorLog) -> tuple[FrontEnd, StepwiseFrontEnd]:
        """The front ends for landmarks and for scans."""
        scans = [p for p in self.parts if isinstance(p, StepwiseFrontEnd)]
        seen = [p for p in self.parts if not isinstance(p, StepwiseFrontEnd) and p.observations(log) is not None]
        names = ", ".join(p.name for p in self.parts)
        if len(self.parts) != 2 or len(scans) != 1 or len(seen) != 1:
            raise ConfigError(
                f"front ends {names} cannot share a log; wanted one of landmarks (rbpf-ekf, ekf) and one of planar "
                "scans (segslam, rbpf-grid, scan-window). To do: run the others by themselves"
            )
        if not isinstance(log[_scanner(log, scans[0])], LaserScans):
            raise ConfigError(
                f"front ends of two dimensions in one run: {seen[0].name} maps in the plane, {scans[0].name} maps "
                f"{_scanner(log, scans[0])!r} in space. To do: run them one by one, or name a planar scanner "
                f"(--set 'frontend.{scans[0].name}.steps.scanners=[\"laser\"]')"
            )
        return seen[0], scans[0]

    def intervals(self, log: SensorLog) -> list[Interval]:
        """Intervals of a log and their front ends, in order of time."""
        seen, scans = self.split(log)
        observed = seen.observations(log)
        assert observed is not None
        stamps = log[_scanner(log, scans)].times
        runs = _runs(observed[1], stamps)
        wait = scans.config.steps.period or 0.0  # the end of the first step is this much later than its first scan
        out: list[Interval] = []
        begin = first = -np.inf
        for (_, landmarks), later in zip(runs, [*runs[1:], None]):
            if later is None:
                out.append(Interval(landmarks, begin, np.inf, first, np.inf))
            elif landmarks:
                last = float(stamps[np.searchsorted(stamps, later[0])])
                out.append(Interval(True, begin, last + wait, first, last))
                begin, first = last + wait, last
            else:
                last = float(stamps[np.searchsorted(stamps, later[0], side="right") - 1])
                out.append(Interval(False, begin, last, first, last))
                begin = first = last
        return out

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :class:`~graphslam_frontends.base.FrontEnd`. Keys increase over all intervals; matches are within one."""
        seen, scans = self.split(log)
        intervals, count = self.intervals(log), drops if drops is not None else DropCounter()
        _count_left_out(log, seen, scans, intervals, count)
        key, begin, first = 0, 0, 0  # of the next submap, its interval, and the first submap of that
        if after is not None:
            row = after.report["interval"]
            key, begin, first = after.key + 1, int(row["number"]), int(row["first"])
        before = after
        for k, part in enumerate(intervals):
            if k < begin:
                continue
            front: FrontEnd = seen if part.landmarks else scans
            cut, offset = (_landmark_log if part.landmarks else _scan_log)(log, front, part)
            resumed = after is not None and k == begin
            if not resumed:
                first = key
            start = None
            if resumed and before is not None:
                start = replace(before, key=before.key - first)
            elif part.landmarks and np.isfinite(part.begin):  # only its end is used
                span = part.begin - 1.0, part.begin
                start = Submap(key=-1, interval=span, exit_pose=np.zeros(3), exit_covariance=np.eye(3))
            for made in front.submaps(cut, seed=seed.child("interval", k), after=start, drops=count, watch=watch):
                submap = _renumbered(made, first, offset)
                report = {**submap.report, "front_end": front.name, "interval": {"number": k, "first": first}}
                if report.get("ended") == "end-of-log" and k + 1 < len(intervals):
                    report["ended"] = "end-of-interval"
                if submap.key == 0:
                    report["findings"] = [*report.get("findings", []), *_idle(intervals, seen, scans)]
                submap = replace(submap, report=report)
                _check_chain(before, submap, front)
                yield submap
                before, key = submap, submap.key + 1
            front.forget()

    def observations(self, log: SensorLog) -> tuple[str, LandmarkObservations] | None:
        """See :class:`~graphslam_frontends.base.FrontEnd`."""
        return self.split(log)[0].observations(log)

    def forget(self) -> None:
        """See :class:`~graphslam_frontends.base.FrontEnd`."""
        for p in self.parts:
            p.forget()


def _scanner(log: SensorLog, front: StepwiseFrontEnd) -> str:
    """Name of the stream of beams that a front end uses."""
    named: tuple[str, ...] = front.config.steps.scanners or scanner_names(log)
    return named[0]


def _runs(seen: LandmarkObservations, stamps: Array) -> list[tuple[float, bool]]:
    """Start of each interval [s], and whether landmarks are mapped in it."""
    begin = float(min(stamps[0], seen.times[0] if len(seen.times) else np.inf))
    end = float(max(stamps[-1], seen.times[-1] if len(seen.times) else -np.inf))
    n = max(int(np.ceil((end - begin) / WINDOW)), 1)
    rate = 1.0 / float(np.median(np.diff(seen.times))) if len(seen.times) > 1 else np.inf
    good = seen.times[np.diff(seen.offsets) >= SEEN]
    count = np.bincount(np.minimum(((good - begin) / WINDOW).astype(int), n - 1), minlength=n)
    rows = _long_runs(count >= SHARE * rate * WINDOW, max(int(np.ceil(SHORTEST / WINDOW)), 1))
    return [(begin + WINDOW * k, landmarks) for k, landmarks in rows]


def _long_runs(flags: npt.NDArray[np.bool_], shortest: int) -> list[tuple[int, bool]]:
    """Runs ``(first, value)`` of equal flags; the shortest is merged with its neighbours until none is too short."""
    flags = flags.copy()
    while True:
        edges = [0, *(np.flatnonzero(np.diff(flags)) + 1).tolist(), len(flags)]
        runs = list(pairwise(edges))
        a, b = min(runs, key=lambda r: r[1] - r[0])
        if len(runs) == 1 or b - a >= shortest:
            return [(a, bool(flags[a])) for a, _ in runs]
        flags[a:b] = ~flags[a]


def _motion_around(log: SensorLog, part: Interval) -> dict[str, Any]:
    """Streams of a log, with the motion cut to an interval plus one record on either side."""
    streams: dict[str, Any] = dict(log.streams)
    for name, s in log.streams.items():
        if isinstance(s, (Odometry, SteeringControls, VelocityControls)):
            i = int(np.searchsorted(s.times, min(part.begin, part.first), side="right")) - 2
            j = int(np.searchsorted(s.times, max(part.end, part.last), side="left")) + 1
            streams[name] = s.take(slice(max(i, 0), j))
    return streams


def _scan_log(log: SensorLog, front: FrontEnd, part: Interval) -> tuple[SensorLog, int]:
    """The log for a front end of scans in an interval."""
    assert isinstance(front, StepwiseFrontEnd)
    streams = _motion_around(log, part)
    for name in front.config.steps.scanners or scanner_names(log):
        times = log[name].times
        streams[name] = log[name].take(slice(*_between(times, part.first, part.last, both=True)))
    return replace(log, streams=streams, read={}), 0


def _landmark_log(log: SensorLog, front: FrontEnd, part: Interval) -> tuple[SensorLog, int]:
    """The log for a front end of landmarks in an interval, and the number of observations before it.

    Empty scans are added at its begin and end, so that the motion is that of the whole interval.
    """
    found = front.observations(log)
    assert found is not None
    name, seen = found
    i, j = _between(seen.times, part.first, part.last, both=False)
    cut = seen.take(slice(i, j))
    ends = [t for t in (part.begin, part.end) if np.isfinite(t)]
    rows = np.searchsorted(cut.times, ends)
    cut = replace(
        cut,
        times=np.insert(cut.times, rows, ends),
        offsets=np.insert(cut.offsets, rows, cut.offsets[rows]),
    )
    return replace(log, streams={**_motion_around(log, part), name: cut}, read={}), int(seen.offsets[i])


def _between(times: Array, first: float, last: float, *, both: bool) -> tuple[int, int]:
    """Rows from ``first`` to ``last``, with (``both``) or without records at exactly these times."""
    sides = ("left", "right") if both else ("right", "left")
    i, j = np.searchsorted(times, first, side=sides[0]), np.searchsorted(times, last, side=sides[1])  # type: ignore[call-overload]
    return int(i), max(int(i), int(j))


def _count_left_out(
    log: SensorLog, seen: FrontEnd, scans: StepwiseFrontEnd, intervals: list[Interval], drops: DropCounter
) -> None:
    """Count the records in intervals of the other front end."""
    found = seen.observations(log)
    assert found is not None
    beams = _scanner(log, scans)
    for name, times, own, other in (
        (found[0], found[1].times, True, scans.name),
        (beams, log[beams].times, False, seen.name),
    ):
        used = 0
        for part in intervals:
            if part.landmarks == own:
                i, j = _between(times, part.first, part.last, both=not own)
                used += j - i
        drops.drop(name, f"scans in intervals mapped by {other}", len(times) - used)


def _idle(intervals: list[Interval], seen: FrontEnd, scans: FrontEnd) -> list[dict[str, Any]]:
    """A finding if one of the front ends maps no interval."""
    kinds = {part.landmarks for part in intervals}
    if len(kinds) == 2:
        return []
    idle, share = (scans, "everywhere") if kinds == {True} else (seen, "nowhere")
    text = (
        f"{idle.name} maps no interval of this log: {100 * SHARE:.0f} % of the scans see {SEEN} landmarks or more "
        f"{share} for {SHORTEST:.0f} s."
    )
    return [Finding("look", "front-end-idle", text).as_row()]


def _renumbered(submap: Submap, first: int, offset: int) -> Submap:
    """A submap with its key in the whole run, and its observation indices in the whole log."""
    landmarks = submap.landmarks
    if landmarks is not None and landmarks.detections is not None:
        landmarks = replace(landmarks, detections=landmarks.detections + np.array([offset, 0]))
    matches = tuple(replace(m, target=m.target + first) for m in submap.matches)
    report = dict(submap.report)
    if "holds" in report:
        report["holds"] = [int(key) + first for key in report["holds"]]
    return replace(submap, key=submap.key + first, landmarks=landmarks, matches=matches, report=report)


def _check_chain(before: Submap | None, submap: Submap, front: FrontEnd) -> None:
    if before is not None and abs(before.interval[1] - submap.interval[0]) > SAME_TIME:
        raise DataError(
            f"submap {submap.key} of {front.name} does not begin where submap {before.key} ends",
            got=f"{submap.interval[0]:.6f} s",
            wanted=f"{before.interval[1]:.6f} s",
        )
