"""Preparation of a log for a landmark filter: usable observations, their variances, and the motion between scans.

All landmark front ends use this, so they have the same observations and increments. A log that is still being recorded
is prepared scan by scan, as soon as the motion up to a scan has arrived.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LandmarkObservations, LaserScans, Odometry
from graphslam.core.submap import Submap
from graphslam_frontends.detectors.trees import TreeDetectorConfig, detect_trees
from graphslam_frontends.landmarks.config import RangeBearingNoise
from graphslam_frontends.odometry.motion import Motion, MotionNoise, motion_stream, motion_stream_name
from graphslam_frontends.odometry.motion_gaps import SHORTEST, MotionGap, dead_reckon_over_gaps, final_until

Ints = npt.NDArray[np.int64]
CONTROL_HOLD = 0.5
"""Longest time of scans before the first control; that control is held backwards [s]."""


class PrepareConfig(Protocol):
    """The part of a front end's configuration that :func:`prepare_log` reads."""

    @property
    def association(self) -> str:
        """``known`` uses the identities in the log, and only observations with one; other values ignore them."""

    @property
    def max_range(self) -> float:
        """Observations beyond this range are not used [m]."""

    @property
    def longest_gap(self) -> float:
        """Longest gap in the records of the motion that is bridged [s]."""

    @property
    def motion(self) -> MotionNoise:
        """Noise of the dead-reckoning increments."""

    @property
    def noise(self) -> RangeBearingNoise | None:
        """Observation noise in the filter; None: the sigmas of the log."""

    @property
    def smoothing_noise(self) -> RangeBearingNoise | None:
        """Observation noise in the smoothing; None: as in the filter."""

    @property
    def detector(self) -> TreeDetectorConfig:
        """Used if the log has raw scans."""


@dataclass(frozen=True, slots=True)
class PreparedLog:
    """A log prepared for a filter.

    Parameters
    ----------
    observations : LandmarkObservations
        Usable ones; all scans stay, including empty ones.
    original : (q,) int64
        Index of each observation in the log's stream, before the unused ones were dropped.
    rows : (q, 4)
        Range, bearing, and their variances in the filter.
    smoothing_variances : (q, 2)
        Variances of range and bearing in the smoothing.
    odometry : Odometry
        Record k is the motion into scan k (the first from ``t_start``).
    t_start : float
        Stamp of the first base [s].
    uses : frozenset of str
        Names of the streams used.
    """

    observations: LandmarkObservations
    original: Ints
    rows: Array
    smoothing_variances: Array
    odometry: Odometry
    t_start: float
    uses: frozenset[str]
    gaps: tuple[MotionGap, ...] = ()
    """Bridged gaps of the motion."""
    noise: Array = field(default_factory=lambda: np.zeros((1, 3)))
    """Cumulative sums until each scan ``(n + 1, 3)``: variances of ranges [m²] and bearings [rad²], number of bearings.
    """

    def usual_sigma(self, scan: int) -> Array:
        """Mean measurement noise up to and including a scan, as x, y [m] and heading [rad]."""
        n, (ranges, bearings, count) = int(self.observations.offsets[scan + 1]), self.noise[scan + 1]
        if not n:
            return np.ones(3)
        along = np.sqrt(ranges / n)
        return np.array([along, along, np.sqrt(bearings / count) if count else np.inf])

    def unseen_gap(self, scan: int) -> bool:
        """Does a gap of the motion without scans end at this scan? Then the motion in it is unknown."""
        t0 = self.observations.times[scan - 1] if scan else self.t_start
        t1 = self.observations.times[scan]
        return any(min(g.end, t1) - max(g.begin, t0) > SHORTEST for g in self.gaps)

    def scan(self, scan: int) -> slice:
        """Usable rows of a scan; none after an unseen gap, because its motion is too uncertain."""
        rows = self.observations.scan(scan)
        return slice(rows.start, rows.start) if self.unseen_gap(scan) else rows

    def splits(self, scan: int) -> bool:
        """Does a submap end before a scan? The motion over an unseen gap is a submap of its own: its uncertainty is too
        large for a linearised map."""
        return scan < len(self) and (self.unseen_gap(scan) or (scan > 0 and self.unseen_gap(scan - 1)))

    def gaps_in(self, first: int, last: int) -> list[dict[str, float]]:
        """Gaps that end in the scans ``first … last - 1``, for the report of a submap."""
        begin = self.observations.times[first - 1] if first else -np.inf
        end = self.observations.times[last - 1] if last < len(self) else np.inf
        unseen = [k for k in range(first, last) if self.unseen_gap(k)]
        return [g.as_row() | {"unseen": float(bool(unseen))} for g in self.gaps if begin < g.end <= end]

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.observations.times)

    @property
    def has_bearing(self) -> npt.NDArray[np.bool_]:
        """Which observations have a usable bearing ``(q,)``."""
        return np.asarray(np.isfinite(self.rows[:, 3]))


def landmark_stream(log: SensorLog, detector: TreeDetectorConfig) -> tuple[str, LandmarkObservations]:
    """Name of the stream to use, and the landmark observations in it (detected from raw scans if necessary)."""
    stream = log.of_type(LandmarkObservations)
    if stream is not None:
        return stream, log[stream]
    stream = log.of_type(LaserScans)
    if stream is None:
        raise MissingDataError("no landmarks to map", where=log.name, wanted="LandmarkObservations or LaserScans")
    return stream, detect_trees(log[stream], detector)


def prepare_log(log: SensorLog, config: PrepareConfig, drops: DropCounter) -> PreparedLog:
    """Detect landmarks, drop and count unusable observations, and integrate the motion between scans.

    Parameters
    ----------
    log : SensorLog
        With a stream of controls or odometry, and one of landmark observations or laser scans.
    drops : DropCounter
        Counts unused scans and observations.
    """
    made = LogPreparation(RecordSource(log), config, drops)
    made.advance()
    return made.prepared


class LogPreparation:
    """Incremental version of :func:`prepare_log`, while records arrive.

    The streams are chosen when the first scan can be prepared.

    Parameters
    ----------
    config, drops
        As in :func:`prepare_log`.
    """

    def __init__(self, feed: RecordSource, config: PrepareConfig, drops: DropCounter) -> None:
        self.feed, self.config, self.drops = feed, config, drops
        self.made: PreparedLog | None = None
        self.done = False
        """Is the log at its end, and prepared completely?"""
        self._streams: tuple[str, str] | None = None
        self._scans, self._rows = 0, 0  # scans and observations of the stream

    @property
    def prepared(self) -> PreparedLog:
        """All prepared scans; at least one."""
        assert self.made is not None
        return self.made

    def reach(self, scan: int) -> Generator[None, None, bool]:
        """Wait until a scan has arrived and it is known whether it is the last; False: the log ended before it."""
        while not self.done and (self.made is None or len(self.made) <= scan + 1):
            if not self.advance():
                yield None
        return scan < len(self.prepared)

    def resume(self, after: Submap | None) -> Generator[None, None, tuple[int, int, float]]:
        """Key, first scan and start [s] of the submap after ``after``; None: of the first one."""
        yield from self.reach(0)
        if after is None:
            return 0, 0, self.prepared.t_start
        scan, t_start = 0, after.interval[1]
        while (yield from self.reach(scan)) and self.prepared.observations.times[scan] <= t_start:
            scan += 1
        return after.key + 1, scan, t_start

    def advance(self) -> bool:
        """Prepare the records that have arrived; False: there were none."""
        if self.done or not (self._named() or self.feed.ended):
            return False
        ended = self.feed.ended
        motion_name, stream = self._streams or self._missing()
        if not ended and self.feed.count(stream) == self._scans:
            return False
        part: Any = self.feed.part(stream, self._scans)
        motion: Any = self.feed.part(motion_name)
        if len(motion.times) == 0:
            raise MissingDataError("motion stream is empty", where=self.feed.name)
        if not ended:
            n = int(np.searchsorted(part.times, final_until(motion), side="right"))
            if n == 0:
                return False
            part = part if n == len(part.times) else part.take(slice(0, n))
        self._scans += len(part.times)
        self._take(part, motion_name, motion, stream, ended)
        self.feed.discard_before(stream, self._scans)
        self.done = ended
        return True

    def _named(self) -> bool:
        """Have the streams been found?"""
        if self._streams is None:
            motion = motion_stream_name(self.feed)
            stream = self.feed.of_type(LandmarkObservations) or self.feed.of_type(LaserScans)
            if motion is None or stream is None or not (self.feed.count(motion) > 1 and self.feed.count(stream)):
                return False
            self._streams = motion, stream
        return True

    def _missing(self) -> tuple[str, str]:
        """The streams of a log that ended with few records; raises if one is missing."""
        motion, _ = motion_stream(self.feed.log)
        stream = self.feed.of_type(LandmarkObservations) or self.feed.of_type(LaserScans)
        if stream is None:
            raise MissingDataError(
                "no landmarks to map", where=self.feed.name, wanted="LandmarkObservations or LaserScans"
            )
        return motion, stream

    def _take(self, part: Any, motion_name: str, motion: Motion, stream: str, last: bool) -> None:
        """Append the scans of a part of the stream."""
        config, drops, where = self.config, self.drops, f"{self.feed.name}/{stream}"
        observations = part if isinstance(part, LandmarkObservations) else detect_trees(part, config.detector)
        early = int(np.searchsorted(observations.times, motion.times[0] - CONTROL_HOLD, side="left"))
        late = len(observations.times)
        if last and isinstance(motion, Odometry):  # controls are held to the end; recorded odometry is not
            late = int(np.searchsorted(observations.times, motion.times[-1] + CONTROL_HOLD, side="right"))
            late = max(late, early)
        drops.drop(stream, "before the first control", early)
        drops.drop(stream, "after the last odometry", len(observations.times) - late)
        scans = observations.take(slice(early, late))
        first_row = self._rows + int(observations.offsets[early])
        self._rows += int(observations.offsets[-1])
        if config.noise is not None:
            scans = replace(scans, ranges=config.noise.distances(scans.ranges))
        positive = scans.ranges > 0.0
        drops.drop(stream, "ranges not positive", int((~positive).sum()))
        usable = positive & (scans.ranges <= config.max_range)
        drops.drop(stream, f"observations beyond {config.max_range:g} m", int((positive & ~usable).sum()))
        if config.association == "known":
            if scans.ids is None:
                raise MissingDataError("known association needs identities", where=where, wanted="ids")
            unknown = usable & (scans.ids < 0)
            drops.drop(stream, "observations without an id", int(unknown.sum()))
            usable &= ~unknown
        scans, kept = _only(scans, usable)
        if len(scans.times):
            self._append(scans, kept + first_row, motion_name, motion, stream)
        if not last:
            return
        if self.made is None:
            raise MissingDataError("no scan to work on", where=where)
        variances = self.made.rows[:, 2:]
        if config.association != "known" and len(variances) and np.all(np.isinf(variances[:, 1])):
            raise MissingDataError(
                "ranges alone cannot be associated by likelihood", where=where, wanted='association = "known"'
            )

    def _append(
        self, scans: LandmarkObservations, original: Ints, motion_name: str, motion: Motion, stream: str
    ) -> None:
        """Append usable scans, with their variances and the motion into them."""
        config, before, count = self.config, self.made, DropCounter()
        filter_var = _variances(scans, config.noise)
        smooth_var = filter_var.copy() if config.smoothing_noise is None else _variances(scans, config.smoothing_noise)
        smooth_var[np.isinf(filter_var[:, 1]), 1] = np.inf  # only bearings that the filter used
        t_start = (
            float(min(motion.times[0], scans.times[0])) if before is None else float(before.observations.times[-1])
        )
        stamps = scans.times if t_start == scans.times[0] else np.concatenate([[t_start], scans.times])
        odometry, _, gaps = dead_reckon_over_gaps(
            SensorLog(name=self.feed.name, streams={motion_name: motion}),
            stamps,
            config.motion,
            hold=CONTROL_HOLD,
            limit=config.longest_gap,
            drops=count,
        )
        if t_start < scans.times[0]:  # record k of the odometry is then the motion into scan k
            odometry = odometry.take(slice(1, None))
        rows = np.column_stack([scans.ranges, scans.bearings, filter_var])
        finite = np.isfinite(filter_var[:, 1])
        each = np.column_stack([filter_var[:, 0], np.where(finite, filter_var[:, 1], 0.0), finite])
        sums = np.cumsum(np.concatenate([np.zeros((1, 3)) if before is None else before.noise[-1:], each]), axis=0)
        new = PreparedLog(
            scans,
            original,
            rows,
            smooth_var,
            odometry,
            t_start,
            frozenset({motion_name, stream}),
            tuple(gaps),
            sums[scans.offsets],
        )
        known = set() if before is None else {g.begin for g in before.gaps}
        self.drops.drop(motion_name, "gaps bridged", len({g.begin for g in gaps} - known))
        self.made = new if before is None else _behind(before, new)


def _behind(a: PreparedLog, b: PreparedLog) -> PreparedLog:
    """Concatenate the scans of two prepared logs."""
    x, y = a.observations, b.observations
    observations = replace(
        x,
        times=np.concatenate([x.times, y.times]),
        offsets=np.concatenate([x.offsets, x.offsets[-1] + y.offsets[1:]]),
        ranges=np.concatenate([x.ranges, y.ranges]),
        bearings=np.concatenate([x.bearings, y.bearings]),
        sigmas=np.concatenate([x.sigmas, y.sigmas]),
        ids=None if x.ids is None or y.ids is None else np.concatenate([x.ids, y.ids]),
    )
    odometry = Odometry(
        times=np.concatenate([a.odometry.times, b.odometry.times]),
        increments=np.concatenate([a.odometry.increments, b.odometry.increments]),
        covariances=np.concatenate([a.odometry.covariances, b.odometry.covariances]),
    )
    known = {g.begin for g in a.gaps}
    return PreparedLog(
        observations,
        np.concatenate([a.original, b.original]),
        np.concatenate([a.rows, b.rows]),
        np.concatenate([a.smoothing_variances, b.smoothing_variances]),
        odometry,
        a.t_start,
        a.uses,
        (*a.gaps, *(g for g in b.gaps if g.begin not in known)),
        np.concatenate([a.noise, b.noise[1:]]),
    )


def _variances(scans: LandmarkObservations, noise: RangeBearingNoise | None) -> Array:
    """``(q, 2)`` variances of range and bearing, from the model or the log; missing bearings stay missing."""
    if noise is None:
        return np.asarray(scans.sigmas**2)
    return np.where(scans.has_bearing[:, None] | [True, False], noise.variances(scans.ranges), np.inf)


def known_slots(observations: LandmarkObservations, rows: slice, slots: dict[int, int]) -> Ints:
    """Slot of every observation ``rows`` by its identity; the first observation of an identity opens the next slot.

    Parameters
    ----------
    observations : LandmarkObservations
        With identities.
    slots : dict
        Identity to slot; new ones are added.

    Returns
    -------
    (k,) int64
    """
    assert observations.ids is not None
    return np.array([slots.setdefault(int(i), len(slots)) for i in observations.ids[rows]], dtype=np.int64)


def _only(scans: LandmarkObservations, keep: npt.NDArray[np.bool_]) -> tuple[LandmarkObservations, Ints]:
    """The observations ``keep`` (all scans stay) and their indices."""
    rows = np.flatnonzero(keep)
    before = np.concatenate([[0], np.cumsum(keep)]).astype(np.int64)
    cut = replace(
        scans,
        offsets=before[scans.offsets],
        ranges=scans.ranges[rows],
        bearings=scans.bearings[rows],
        sigmas=scans.sigmas[rows],
        ids=None if scans.ids is None else scans.ids[rows],
    )
    return cut, rows.astype(np.int64)
