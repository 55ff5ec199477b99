"""Steps while records arrive: each is cut from the records around it, and does not depend on later ones.

A step is made as :func:`~graphslam_frontends.odometry.make_steps.make_steps` makes it from a whole log, but from the
records of its own time and a few before and after it, in the frame of the previous step. So the work for a step does
not grow with the log, and steps do not depend on the portions in which records arrive. Against the steps of a whole log
numbers differ by rounding; in gaps of the motion the covariances also depend on the speeds before the gap only.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.poses import group_of, heading_of, remove_roll_pitch
from graphslam.core.range_scans import RangeScans
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LaserScans, Odometry, SteeringControls, VelocityControls
from graphslam_frontends.odometry.gaps import Gaps
from graphslam_frontends.odometry.inertial_biases import POS, InertialBiases
from graphslam_frontends.odometry.make_steps import BeamSources, cut_steps, scanner_names
from graphslam_frontends.odometry.motion_prior import BiasStates, motion_between
from graphslam_frontends.odometry.motion_source import motion_source
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import IntervalCovariance, Steps

SCANNERS = (RangeScans, PointClouds, LaserScans)
MOTION = (Odometry, VelocityControls, SteeringControls)
LATE = 2.0
"""Streams that begin later than this after the first scanner and the first motion are not used [s]."""
SLACK = 1e-6
"""Rounding of stamps [s]."""
BEFORE, AFTER = 20, 2
"""Records of the motion before and after a step that are used for it …"""
LONG_BEFORE = 400
"""… and before it if there is a gap, to know the usual motion."""
BLOCK, BLOCK_SECONDS = 5, 2.0
"""Most steps that are made at once, and their duration [s]: one call for several steps takes little more time."""
LAST = 50
"""Records of a scanner among which its last beam is searched at the end of the log."""


class _Stamps:
    """Stamps of the records of a stream so far; old ones are dropped."""

    def __init__(self, feed: RecordSource, name: str) -> None:
        self.feed, self.name = feed, name
        self.first, self.times = 0, list[float]()

    def read(self, before: float = -np.inf) -> int:
        """Read the new stamps; returns how many of them are not after a time [s]."""
        count = self.feed.count(self.name)
        known = self.first + len(self.times)
        if count <= known:
            return 0
        new = self.feed.part(self.name, known, count).times.tolist()
        self.times.extend(new)
        return bisect_right(new, before)

    def index(self, time: float, *, after: bool) -> int:
        """Number of records before a time [s]; ``after``: or at it."""
        return self.first + (bisect_right if after else bisect_left)(self.times, time)

    def forget(self, before: int) -> None:
        if before - self.first > 4096:
            del self.times[: before - self.first]
            self.first = before


class Column:
    """An array that grows by rows."""

    def __init__(self, *shape: int) -> None:
        self._data, self.count = np.empty((256, *shape)), 0

    def append(self, row: Any) -> None:
        """Add a row."""
        if self.count == len(self._data):
            self._data = np.concatenate([self._data, np.empty_like(self._data)])
        self._data[self.count] = row
        self.count += 1

    @property
    def rows(self) -> Array:
        """All rows, as a view."""
        return self._data[: self.count]


@dataclass(slots=True)
class _Motion:
    """Increments so far: the members of `Odometry` that filters read."""

    times: Array
    increments: Array
    covariances: Array


@dataclass(slots=True)
class _Errors:
    """Covariance of dead reckoning over any interval so far (`IntervalCovariance`)."""

    poses: Array
    biases: BiasStates

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        return motion_between(self.poses, self.biases, start, end, level_start=level_start, level_end=level_end)


Scan = tuple[Array, Array, npt.NDArray[np.bool_]]


@dataclass(slots=True)
class _Columns:
    times: Column = field(default_factory=Column)
    length: Column = field(default_factory=Column)
    returned: Column = field(default_factory=Column)
    increments: Column = field(default_factory=Column)
    covariances: Column = field(default_factory=Column)
    poses: Column = field(default_factory=Column)
    tilt: Column = field(default_factory=lambda: Column(2))
    transitions: Column = field(default_factory=Column)
    noises: Column = field(default_factory=Column)


class GrowingSteps:
    """Steps made while records arrive, with the members of :class:`~graphslam_frontends.odometry.steps.Steps` that a
    filter reads. Scans are kept until :meth:`forget_before`.

    Parameters
    ----------
    feed : RecordSource
    config : StepConfig
        Without the options that need the whole log: see :func:`needs_whole_log`.
    """

    def __init__(self, feed: RecordSource, config: StepConfig) -> None:
        self.feed, self.config = feed, config
        self.name, self.uses, self.gaps = feed.name, frozenset[str](), Gaps()
        self.scanners: tuple[str, ...] = ()
        self.whole_log = ""
        """Reason why the steps of this log can only be made from the whole log; empty if there is none."""
        self.dim, self.max_range = 3, 0.0
        self.tilt: Array | None = None
        self.tilt_sigma, self.tilt_time = 0.0, 1.0
        self.errors: _Errors | None = None
        self._stamps: dict[str, _Stamps] = {}
        self._scans: deque[Scan] = deque()
        self._dropped, self._ended = 0, False
        self.drops = DropCounter()
        """Records that came too late for their step."""
        self._begin, self._gaps = 0.0, dict[float, float]()
        self._last: float | None = None
        self._first_record = 0
        self._model: Any = None
        self.times = np.zeros(0)

    def __len__(self) -> int:
        """Number of steps that are shown."""
        return len(self.times)

    @property
    def made(self) -> int:
        """Number of steps so far."""
        return self._dropped + len(self._scans)

    @property
    def latest(self) -> float:
        """Stamp of the last record of scanners and motion so far [s]."""
        return max((self.feed.until(n) for n in self._stamps), default=-np.inf)

    @property
    def complete(self) -> bool:
        """Have all steps been made?"""
        return self._ended

    def cover(self, k: int, seconds: float) -> bool:
        """Show the steps up to ``seconds`` after step k, if they are all there."""
        if k >= self.made:
            return False
        times = self._columns.times.rows
        n = int(np.searchsorted(times, times[k] + seconds - SLACK)) + 1
        if n > self.made and not self._ended:
            return False
        self.show(min(n, self.made))
        return True

    def scan(self, k: int) -> Scan:
        """Points, origins and returns of step k, as `Steps.scan`."""
        return self._scans[k - self._dropped]

    def all_times(self) -> Array:
        """Stamps of all steps so far, also of those that are not shown [s]."""
        return self._columns.times.rows

    def all_errors(self) -> IntervalCovariance:
        """Covariance of dead reckoning over all steps so far."""
        return self._errors(self.made)[1]

    def motion_to_now(self) -> tuple[float, Array, Array] | None:
        """Dead reckoning from the last step to the last record of the motion: stamp [s], pose, covariance (right
        tangent); None: there is no later record."""
        for s in self._stamps.values():
            s.read()
        begin = float(self.all_times()[-1])
        part = self._motion_around(begin, np.inf)
        source = motion_source(part, replace(self.config, motion=self.motion), self.dim)
        now = min(source.end, self.latest)
        if now <= begin + SLACK:
            return None
        motion = source.solve(np.array([begin, now]), np.zeros(0), None)
        return now, *motion.between(0, 1)

    def forget_before(self, k: int) -> None:
        """Free the scans of the steps before k."""
        while self._dropped < k:
            self._scans.popleft()
            self._dropped += 1

    def more(self) -> bool:
        """Make the next steps if their records have arrived; False: there are none yet, or the log has ended."""
        if self._ended or self.whole_log or not (self.scanners or self._start()):
            return False
        before = float(self.all_times()[-1]) if self.made else -np.inf
        for s in self._stamps.values():
            self.drops.drop(s.name, "records that came after their step was made", s.read(before))
        stamps = self._next_stamps()
        if not stamps:
            return False
        begin = float(self._columns.times.rows[-1]) if self.made else self._begin
        part = self._around(begin, stamps[-1])
        known = [begin] if self.made else []
        made = cut_steps(part, self._sources(part), np.array([*known, *stamps]), begin, self.config)
        self._append(made, len(known))
        return True

    # --- start -----------------------------------------------------------------------------------------------

    def _start(self) -> bool:
        """Choose the streams, once all that begin in time have arrived."""
        feed, names = self.feed, self.feed.names(object)
        begin = {n: float(feed.part(n, 0, 1).times[0]) for n in names if feed.count(n)}
        asked = (*self.config.scanners, *self.config.motion)
        scans = [t for n, t in begin.items() if n in feed.names(SCANNERS)]  # type: ignore[arg-type]
        moves = [t for n, t in begin.items() if n in feed.names(MOTION)]  # type: ignore[arg-type]
        latest = max((feed.until(n) for n in begin), default=-np.inf)
        known = bool(scans and moves) and all(n in begin for n in asked)
        ready = max(min(scans), min(moves), *(begin[n] for n in asked)) + LATE if known else np.inf
        if not feed.ended and latest <= ready:
            return False
        chosen = [n for n, t in begin.items() if t <= ready or n in asked]
        log = SensorLog(name=feed.name, streams={n: self._up_to(n, ready) for n in chosen})
        self.scanners = self.config.scanners or scanner_names(log)
        self.dim = 2 if isinstance(log[self.scanners[0]], LaserScans) else 3
        source = motion_source(log, self.config, self.dim)
        self.motion, self.dim = source.names, source.dim
        self.whole_log = _needs_whole_streams(log, self.motion)
        if self.whole_log:
            return False
        sources = BeamSources(log, self.scanners, source, self.config, DropCounter())
        at = sources.times_with_skipped()
        at = at[at >= source.begin]
        self._begin = float(at.min()) if len(at) else source.begin
        if self.config.period is None:  # the first whole record of the first scanner
            times = log[self.scanners[0]].times
            self._first_record = int(np.searchsorted(times, source.begin))
            self._begin = float(times[min(self._first_record, len(times) - 1)])
        self._stamps = {n: _Stamps(feed, n) for n in (*self.scanners, *self.motion)}
        return True

    def _up_to(self, name: str, time: float) -> Any:
        """The records of a stream up to a time [s], and some more of a motion."""
        part = self.feed.part(name)
        n = int(np.searchsorted(part.times, time, side="right"))
        return part.take(slice(0, max(n, 1)))

    # --- one step --------------------------------------------------------------------------------------------

    def _next_stamps(self) -> list[float]:
        """Stamps of the next steps; none: their records have not arrived, or the log has ended."""
        period = self.config.period
        most = BLOCK if period is None else max(1, min(BLOCK, int(BLOCK_SECONDS / period)))
        end = self._end() if self.feed.ended else np.inf
        stamps: list[float] = []
        for k in range(self.made, self.made + most):
            until = self._record_end(k) if period is None else self._begin + period * (k + 1)
            if until is None or until >= (end - 1e-6 if period else np.nextafter(end, np.inf)):
                break
            stamps.append(until)
        if not self.feed.ended:
            return stamps if len(stamps) == most and self._arrived(stamps[-1]) else []
        if len(stamps) < most:
            self._ended = True
            before = stamps[-1] if stamps else float(self._columns.times.rows[-1]) if self.made else -np.inf
            if period is not None and end > before + 1e-6:
                stamps.append(end)
        return stamps

    def _record_end(self, k: int) -> float | None:
        """Stamp of the k-th record of the first scanner that lies in the motion: that of its last beam [s]."""
        first, record = self._stamps[self.scanners[0]], self._first_record + k
        if record >= first.first + len(first.times):
            return None
        scans = self.feed.part(first.name, record, record + 1)
        last = scans.beam_times[-1] if isinstance(scans, RangeScans) and len(scans.beam_times) else 0.0
        return float(scans.times[0] + last)

    def _arrived(self, until: float) -> bool:
        """Have all records of a step arrived? A scanner without records is not waited for longer than `LATE`."""
        latest = max(self.feed.until(n) for n in self._stamps)
        if any(self.feed.until(n) <= until + 1e-6 for n in self.scanners) and latest <= until + LATE:
            return False
        after = (
            s.first + len(s.times) - s.index(until, after=True) for n, s in self._stamps.items() if n in self.motion
        )
        return all(n >= AFTER for n in after)

    def _end(self) -> float:
        """Stamp of the last beam within the motion, or of the last beams if there are no scans at the end [s]."""
        if self._last is None:
            feed, streams = self.feed, {}
            for names, most in ((self.motion, BEFORE), (self.scanners, LAST)):
                for n in names:
                    streams[n] = feed.part(n, max(feed.count(n) - most, 0), feed.count(n))
            sources = self._sources(SensorLog(name=self.name, streams=streams))
            at, motion = sources.times_with_skipped(), sources.motion
            at = at[at <= motion.end]
            self._last = max(float(at.max()) if len(at) else motion.end, self._begin)
        return self._last

    def _sources(self, part: SensorLog) -> BeamSources:
        config = replace(self.config, scanners=self.scanners, motion=self.motion)
        return BeamSources(part, self.scanners, motion_source(part, config, self.dim), config, DropCounter())

    def _around(self, begin: float, until: float) -> SensorLog:
        """The records for steps between two times [s]; earlier scans are freed."""
        streams = dict(self._motion_around(begin, until).streams)
        for name in self.scanners:
            s = self._stamps[name]
            at, last = s.index(begin, after=True), s.index(until, after=True)
            one = self.feed.part(name, max(at - 1, 0), max(at, 1))
            span = float(one.beam_times[-1]) if isinstance(one, RangeScans) and len(one.beam_times) else 0.0
            at = min(s.index(begin - span, after=False), at) - 1  # one more, to find repeated scans
            at = max(at, s.first, 0)
            streams[name] = self.feed.part(name, at, last)
            self.feed.discard_before(name, max(at - LAST, 0))
            s.forget(at - LAST - 1)
        return SensorLog(name=self.name, streams=streams)

    def _motion_around(self, begin: float, until: float) -> SensorLog:
        streams = {}
        for name in self.motion:
            s = self._stamps[name]
            at = s.index(begin, after=True)
            last = s.index(until, after=True) + AFTER
            streams[name] = part = self.feed.part(name, max(at - BEFORE, 0), last)
            if _has_gap(part.times):
                streams[name] = self.feed.part(name, max(at - LONG_BEFORE, 0), last)
            s.forget(at - LONG_BEFORE - 1)
        return SensorLog(name=self.name, streams=streams)

    def _append(self, made: Steps, known: int) -> None:
        """Add the steps of a part but the first ``known``; its motion is in the frame of its first step."""
        motion: Any = made.errors
        inertial = isinstance(motion.biases, InertialBiases)
        if not known:
            self._prepare(made)
        c, g = self._columns, group_of(made.odometry.increments)
        frame = remove_roll_pitch(c.poses.rows[-1]) if inertial and known else g.identity
        turn = np.eye(len(motion.biases.transitions[0])) if inertial else np.zeros((0, 0))
        if inertial:
            angle = 0.5 * float(heading_of(frame))
            turn[POS, POS] = se3.quat_to_matrix(np.array([0.0, 0.0, np.sin(angle), np.cos(angle)]))
        for k in range(known, len(made)):
            increment, first = made.odometry.increments[k], not c.times.count
            c.times.append(made.times[k])
            c.length.append(0.0 if first else c.length.rows[-1] + np.linalg.norm(increment[: g.dim]))
            c.increments.append(increment)
            c.covariances.append(made.odometry.covariances[k])
            if inertial:
                c.poses.append(g.compose(frame, motion.poses[k]))
                c.transitions.append(turn @ motion.biases.transitions[k] @ turn.T)
                c.noises.append(turn @ motion.biases.noises[k] @ turn.T)
            else:
                c.poses.append(motion.poses[k] if first else g.compose(c.poses.rows[-1], increment))
            if made.tilt is not None:
                c.tilt.append(made.tilt[k])
            points, origins, returns = made.scan(k)
            c.returned.append(np.count_nonzero(returns))
            self._scans.append((points, origins, returns))
        self._gaps.update(zip(made.gaps.begin.tolist(), made.gaps.end.tolist()))

    def _prepare(self, made: Steps) -> None:
        """Columns and constants, from the first step."""
        motion: Any = made.errors
        d, w = made.odometry.covariances.shape[1], made.odometry.increments.shape[1]
        self._columns = _Columns(
            increments=Column(w), covariances=Column(d, d), poses=Column(w),
            **({n: Column(*motion.biases.transitions.shape[1:]) for n in ("transitions", "noises")}
               if isinstance(motion.biases, InertialBiases) else {}),
        )  # fmt: skip
        self.max_range, self.range_sigma = made.max_range, made.range_sigma
        self.tilt_sigma, self.tilt_time = made.tilt_sigma, made.tilt_time
        self.uses, self.name = made.uses, made.name
        self._model = motion.biases

    def show(self, n: int) -> None:
        """Show the first n steps: a filter sees the same of them, however many records have arrived."""
        c = self._columns
        self.times, self.path_length, self.returned = c.times.rows[:n], c.length.rows[:n], c.returned.rows[:n]
        self.odometry = _Motion(self.times, c.increments.rows[:n], c.covariances.rows[:n])
        self.tilt = c.tilt.rows[:n] if c.tilt.count else None
        gaps = [(a, b) for a, b in self._gaps.items() if a < self.times[-1]]
        self.gaps = Gaps(*np.array(gaps).reshape(-1, 2).T)
        self._model, self.errors = self._errors(n)

    def _errors(self, n: int) -> tuple[Any, _Errors]:
        c, poses = self._columns, self._columns.poses.rows[:n]
        if isinstance(self._model, InertialBiases):
            model: Any = replace(
                self._model, times=c.times.rows[:n], poses=poses,
                transitions=c.transitions.rows[:n], noises=c.noises.rows[:n],
            )  # fmt: skip
        else:
            motion = _Motion(c.times.rows[:n], c.increments.rows[:n], c.covariances.rows[:n])
            model = replace(self._model, odometry=motion)
        return model, _Errors(poses, model)


def needs_whole_log(config: StepConfig) -> str:
    """The option of the steps that needs the whole log; empty if there is none."""
    if config.level_floors:
        return "steps.level_floors: the median of roll and pitch"
    if config.match_scans:
        return "steps.match_scans"
    return "steps.odometry_tilt_sigma" if config.odometry_tilt_sigma else ""


def _needs_whole_streams(log: SensorLog, motion: tuple[str, ...]) -> str:
    imu = next((log[n] for n in motion if isinstance(log[n], Imu)), None)
    if imu is not None and imu.attitude is None:
        return "roll and pitch of an IMU without attitude: they are filtered over the whole log"
    return ""


def _has_gap(times: Array) -> bool:
    spacing = np.diff(times)
    return bool(len(spacing) and spacing.max() > max(3.0 * float(np.median(spacing)), 0.05))
