"""A log made ready for a landmark filter: which observations count, their variances, and the motion between scans.

Every landmark front end starts here, so that all of them work on the same observations and the same increments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.records import LandmarkObservations, LaserScans, Odometry
from graphslam.frontends.detectors.trees import TreeDetectorConfig, detect_trees
from graphslam.frontends.landmarks.config import RangeBearingNoise
from graphslam.frontends.odometry.motion import MotionNoise, motion_stream
from graphslam.frontends.odometry.motion_gaps import SHORTEST, MotionGap, bridged_reckoning

Ints = npt.NDArray[np.int64]


class PrepareConfig(Protocol):
    """What :func:`prepare` reads of a front end's configuration."""

    @property
    def association(self) -> str:
        """``known`` uses the identities in the log and nothing without one; any other word ignores them."""

    @property
    def max_range(self) -> float:
        """Observations beyond are not used [m]."""

    @property
    def control_hold(self) -> float:
        """Scans up to this long before the first control are used, with that control held backwards [s]."""

    @property
    def longest_gap(self) -> float:
        """Longest time without a record of the motion that is bridged [s]."""

    @property
    def motion(self) -> MotionNoise:
        """Noise of the dead-reckoning increments."""

    @property
    def noise(self) -> RangeBearingNoise | None:
        """Observation noise in the filter; None: the log's sigmas."""

    @property
    def smoothing_noise(self) -> RangeBearingNoise | None:
        """Observation noise in the smoothing; None: as in the filter."""

    @property
    def detector(self) -> TreeDetectorConfig:
        """Used where the log holds raw scans."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A log made ready for a filter.

    Parameters
    ----------
    observations : LandmarkObservations
        Those that count; all scans stay, also empty ones.
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
        Names of the streams worked on.
    """

    observations: LandmarkObservations
    original: Ints
    rows: Array
    smoothing_variances: Array
    odometry: Odometry
    t_start: float
    uses: frozenset[str]
    gaps: tuple[MotionGap, ...] = ()
    """Gaps of the motion that were bridged."""

    def unseen_gap(self, scan: int) -> bool:
        """Does a gap of the motion end at a scan, with no scan in it? Then nothing tells where the robot went."""
        t0 = self.observations.times[scan - 1] if scan else self.t_start
        t1 = self.observations.times[scan]
        return any(min(g.end, t1) - max(g.begin, t0) > SHORTEST for g in self.gaps)

    def scan(self, scan: int) -> slice:
        """Rows of a scan that a submap can use: none after an unseen gap, for the base is no longer near them."""
        rows = self.observations.scan(scan)
        return slice(rows.start, rows.start) if self.unseen_gap(scan) else rows

    def splits(self, scan: int) -> bool:
        """Does a submap end before a scan? The motion over an unseen gap is a submap by itself: its uncertainty is too
        large for a map to be linear in it.
        """
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
        """Which observations have a bearing that is used ``(q,)``."""
        return np.asarray(np.isfinite(self.rows[:, 3]))


def landmark_stream(log: SensorLog, detector: TreeDetectorConfig) -> tuple[str, LandmarkObservations]:
    """Name of the stream to work on, and the landmark observations in it (detected, where it holds raw scans).

    Raises
    ------
    MissingDataError
        If the log has neither landmark observations nor laser scans.
    """
    stream = log.of_type(LandmarkObservations)
    if stream is not None:
        return stream, log[stream]
    stream = log.of_type(LaserScans)
    if stream is None:
        raise MissingDataError("no landmarks to map", where=log.name, wanted="LandmarkObservations or LaserScans")
    return stream, detect_trees(log[stream], detector)


def prepare(log: SensorLog, config: PrepareConfig, drops: DropCounter) -> Prepared:
    """Detect, drop what cannot be used (counted), and integrate the motion between scans.

    Parameters
    ----------
    log : SensorLog
        With a stream of controls or odometry, and one of landmark observations or laser scans.
    config : PrepareConfig
    drops : DropCounter
        Where scans and observations that are not used are counted.

    Raises
    ------
    MissingDataError
        If a stream is missing, identities are asked for and not there, or no scan is left; also where ranges without
        bearings are to be associated by likelihood alone, since a range cannot found a landmark without an identity.
    """
    _, motion = motion_stream(log)
    stream, observations = landmark_stream(log, config.detector)
    where = f"{log.name}/{stream}"
    if len(motion.times) == 0:
        raise MissingDataError("motion stream is empty", where=log.name)
    early = int(np.searchsorted(observations.times, motion.times[0] - config.control_hold, side="left"))
    late = len(observations.times)
    if isinstance(motion, Odometry):  # controls are held to the end; recorded odometry ends where it ends
        late = int(np.searchsorted(observations.times, motion.times[-1] + config.control_hold, side="right"))
    drops.drop(stream, "before the first control", early)
    drops.drop(stream, "after the last odometry", len(observations.times) - late)
    scans = observations.take(slice(early, late))
    first_row = int(observations.offsets[early])
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
        drops.drop(stream, "observations without identity", int(unknown.sum()))
        usable &= ~unknown
    scans, kept = _only(scans, usable)
    if len(scans.times) == 0:
        raise MissingDataError("no scan to work on", where=where)
    filter_var = _variances(scans, config.noise)
    if config.association != "known" and len(filter_var) and np.all(np.isinf(filter_var[:, 1])):
        raise MissingDataError(
            "ranges alone cannot be associated by likelihood", where=where, wanted='association = "known"'
        )
    smooth_var = filter_var.copy() if config.smoothing_noise is None else _variances(scans, config.smoothing_noise)
    smooth_var[np.isinf(filter_var[:, 1]), 1] = np.inf  # the map is made of what the filter saw
    t_start = float(min(motion.times[0], scans.times[0]))
    stamps = scans.times if t_start == scans.times[0] else np.concatenate([[t_start], scans.times])
    odometry, motion_name, gaps = bridged_reckoning(
        log, stamps, config.motion, hold=config.control_hold, limit=config.longest_gap, drops=drops
    )
    if t_start < scans.times[0]:  # record k of the odometry is then the motion into scan k
        odometry = odometry.take(slice(1, None))
    rows = np.column_stack([scans.ranges, scans.bearings, filter_var])
    uses = frozenset({motion_name, stream})
    return Prepared(scans, kept + first_row, rows, smooth_var, odometry, t_start, uses, tuple(gaps))


def _variances(scans: LandmarkObservations, noise: RangeBearingNoise | None) -> Array:
    """``(q, 2)`` variances of range and bearing, from the model or the log; an absent bearing stays absent."""
    if noise is None:
        return np.asarray(scans.sigmas**2)
    return np.where(scans.has_bearing[:, None] | [True, False], noise.variances(scans.ranges), np.inf)


def known_slots(observations: LandmarkObservations, rows: slice, slots: dict[int, int]) -> Ints:
    """Slot of every observation ``rows`` by its identity; the first sighting of an identity opens the next slot.

    Parameters
    ----------
    observations : LandmarkObservations
        With identities.
    slots : dict
        Identity to slot; grows.

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
