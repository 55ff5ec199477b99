"""Windows of a log: motion between the stamps of observations, and landmark tracks within each window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.calibrate import kernels as K
from graphslam.calibrate.corrections import (
    Corrections,
    apply_corrections,
    corrected_observations,
    slip_noise,
    visits_of,
)
from graphslam.calibrate.smoothing import Ints, SmoothingWindow, rebuild_window, renumber_slots
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_compose, se2_transform
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations, Odometry, VelocityControls
from graphslam_frontends.odometry.motion import Motion, MotionNoise, dead_reckoned_increments, motion_stream

LONGEST = 1.0
"""A gap between motion records longer than this and than three times the median period ends a window [s]."""
_HOLD = 0.5
HELD, EVERY = 2.5, 20.0
"""Observations of the last HELD of every EVERY seconds are withheld for cross-validation [s]; this is shorter than the
gap that ends a visit."""


@dataclass(frozen=True, slots=True)
class ObservationLog:
    """Motion and observations of a log, to be cut into windows.

    Parameters
    ----------
    name : str
        Name of the stream of observations.
    clock : (3, r)
        Stamps of the motion records [s], with accumulated seconds in motion and metres driven.
    withheld : (q,) bool, optional
        Observations that are excluded from the windows; None: no observation is excluded.
    stated : MotionNoise, optional
        If given, windows have the motion variances of the log, computed with this noise for controls.
    slips : tuple of (float, float)
        Intervals of wheel slip, in the clock of the motion [s].
    """

    log: SensorLog
    name: str
    detections: LandmarkObservations
    clock: Array
    withheld: npt.NDArray[np.bool_] | None = None
    stated: MotionNoise | None = None
    slips: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, log: SensorLog, name: str, detections: LandmarkObservations) -> ObservationLog:
        """From a log whose observations are in the stream ``name``, or were detected in it."""
        _, motion = motion_stream(log)
        return cls(log, name, detections, cumulative_motion(motion))

    def corrected(self, c: Corrections) -> ObservationLog:
        """Copy with corrections applied; the same observations are withheld."""
        made = ObservationLog.of(apply_corrections(self.log, c), self.name, corrected_observations(self.detections, c))
        return replace(made, withheld=self.withheld, stated=self.stated)

    def with_withheld(self) -> ObservationLog:
        """Copy with some observations withheld: the last :data:`HELD` of every :data:`EVERY` seconds."""
        s = self.detections
        times = np.repeat(s.times, np.diff(s.offsets))
        return replace(self, withheld=np.mod(times - self.span[0], EVERY) > EVERY - HELD)

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp of the motion [s]."""
        return float(self.clock[0, 0]), float(self.clock[0, -1])

    @property
    def period(self) -> float:
        """Median time between motion records [s]."""
        return float(np.median(np.diff(self.clock[0])))

    @property
    def spacing(self) -> float:
        """Median time between scans with observations [s]; infinite with fewer than two."""
        times = np.unique(self.detections.times[np.diff(self.detections.offsets) > 0])
        return float(np.median(np.diff(times))) if len(times) > 1 else np.inf

    def steps(self, stamps: Array, shift: float = 0.0) -> Array:
        """Motion between stamps ``(n, 8)``: dx, dy, turn, seconds in motion, metres, variances; row 0 is zero.

        Parameters
        ----------
        stamps : (n,)
            Stamps of the observations [s].
        shift : float
            Clock of the motion minus clock of the observations [s].
        """
        t = np.asarray(stamps) + shift
        odometry, _ = dead_reckoned_increments(self.log, t, self.stated or MotionNoise(), hold=_HOLD + abs(shift))
        out = np.zeros((len(t), 8))
        if self.stated is not None:
            out[1:, 5:] = np.diagonal(odometry.covariances[1:], axis1=1, axis2=2)
        out[1:, :3] = odometry.increments[1:]
        for column in (1, 2):
            out[1:, 2 + column] = np.diff(np.interp(t, self.clock[0], self.clock[column]))
        if self.slips:
            out[:, 5] = np.maximum(out[:, 5], slip_noise(t, out[:, 4], self.slips))
        return out

    def breaks(self) -> Array:
        """Begin and end of the gaps in the motion ``(k, 2)`` [s]."""
        dt = np.diff(self.clock[0])
        k = np.flatnonzero(dt > max(3.0 * float(np.median(dt)), LONGEST))
        return np.column_stack([self.clock[0, k], self.clock[0, k + 1]])


def cumulative_motion(motion: Motion) -> Array:
    """Stamps of the motion records, with accumulated seconds in motion and metres driven ``(3, r)``."""
    t = motion.times
    dt = np.diff(t)
    if isinstance(motion, Odometry):
        if motion.increments.shape[1] != 3:
            raise DataError("the odometry is not planar", got=motion.increments.shape, wanted="(n, 3)")
        metres = np.hypot(motion.increments[1:, 0], motion.increments[1:, 1])
        turned = np.abs(motion.increments[1:, 2])
    else:
        metres = np.abs(motion.speed[:-1]) * dt
        rate = motion.yaw_rate if isinstance(motion, VelocityControls) else motion.speed * motion.steering
        turned = np.abs(rate[:-1]) * dt
    moved = (metres > 1e-3 * dt) | (turned > 1e-3 * dt)
    total = [np.concatenate([[0.0], np.cumsum(x)]) for x in (dt * moved, metres)]
    return np.stack([t, *total])


def cut_windows(
    seen: ObservationLog, seconds: float, count: int | None = None, *, visits: bool = False
) -> list[SmoothingWindow]:
    """Cut a log into windows of ``seconds``.

    Parameters
    ----------
    count : int, optional
        Maximal number of windows, spread over the log; default: all.
    visits : bool
        Add a constant for each visit of a landmark.
    """
    made = (make_window(seen, scans, visits=visits) for scans in window_scans(seen, seconds, count))
    return [w for w in made if w is not None]


def window_scans(seen: ObservationLog, seconds: float, count: int | None = None) -> list[Ints]:
    """Indices of the scans in each window of :func:`cut_windows`."""
    s, (begin, end) = seen.detections, seen.span
    used = np.flatnonzero((np.diff(s.offsets) > 0) & (s.times >= begin - _HOLD) & (s.times <= end + _HOLD))
    if len(used) < 5:
        return []
    t = s.times[used]
    seconds = min(seconds, float(t[-1] - t[0]))
    gaps = seen.breaks()
    piece = np.searchsorted(gaps[:, 0], t) if len(gaps) else np.zeros(len(t), dtype=np.int64)
    starts, k = [], 0
    while k < len(t):
        last = int(np.searchsorted(t, t[k] + seconds, side="right"))
        last = min(last, int(np.searchsorted(piece, piece[k], side="right")))
        if last - k >= 5 and t[last - 1] - t[k] > 0.3 * seconds:
            starts.append((k, last))
        k = max(last, k + 1)
    metres = np.interp(t, seen.clock[0], seen.clock[2])
    if count is not None and len(starts) > count:
        moved = [i for i, (a, b) in enumerate(starts) if metres[b - 1] - metres[a] > 0.1]
        moved = moved or list(range(len(starts)))
        chosen = np.unique(np.linspace(0, len(moved) - 1, min(count, len(moved))).round().astype(int))
        starts = [starts[moved[i]] for i in chosen]
    return [used[a:b] for a, b in starts]


def make_window(seen: ObservationLog, scans: Ints, *, visits: bool) -> SmoothingWindow | None:
    """Window of these scans with landmarks initialised by odometry; None with fewer than 4 usable observations."""
    s = seen.detections
    steps = seen.steps(s.times[scans])
    poses = np.zeros((len(scans), 3))
    K.compose_steps(steps, np.zeros(3), poses)
    rows = np.concatenate([np.arange(s.offsets[k], s.offsets[k + 1]) for k in scans])
    k = np.repeat(np.arange(len(scans)), np.diff(s.offsets)[scans])
    bearing = s.has_bearing[rows]
    z = np.column_stack([s.ranges[rows], np.where(bearing, s.bearings[rows], np.nan)])
    points = observation_points(z, se2_compose(poses, np.broadcast_to(s.T_base_sensor, poses.shape))[k])
    if s.ids is not None and np.any(s.ids[rows] >= 0):
        track = s.ids[rows].astype(np.int64)
    else:
        track = track_points(points, k)
    good = track >= 0 if seen.withheld is None else (track >= 0) & ~seen.withheld[rows]
    names, landmark = np.unique(track[good], return_inverse=True)
    rows, k, z, points = rows[good], k[good], z[good], points[good]
    if not len(rows):
        return None
    visit = visits_of(landmark, s.times[scans][k]) + len(names) if visits else np.full(len(rows), -1)
    slots, order = renumber_slots(np.column_stack([landmark, visit]).astype(np.int64))
    kinds = (order >= len(names)).astype(np.int64)
    nuisance = np.zeros((len(order), 2))
    for j in np.flatnonzero(kinds == 0):
        mine = points[landmark == order[j]]
        nuisance[j] = np.median(mine[np.isfinite(mine[:, 0])], axis=0) if np.isfinite(mine[:, 0]).any() else np.nan
    w = SmoothingWindow(
        times=s.times[scans],
        steps=steps,
        first=np.searchsorted(k, np.arange(len(scans) + 1)).astype(np.int64),
        detections=z,
        slots=slots,
        kinds=kinds,
        rows=rows,
        poses=poses,
        nuisance=nuisance,
    )
    w = rebuild_window(w, np.ones(len(rows), dtype=np.bool_))
    return w if len(w.detections) > 3 else None


def observation_points(z: Array, sensor: Array) -> Array:
    """Points ``(q, 2)`` of observations (range, bearing) from sensor poses ``(q, 3)``; NaN without a bearing."""
    local = np.column_stack([z[:, 0] * np.cos(z[:, 1]), z[:, 0] * np.sin(z[:, 1])])
    return np.asarray(se2_transform(sensor, local))


def track_points(points: Array, k: Ints, *, gate: float = 1.0, ratio: float = 1.5, lost: int = 10) -> Ints:
    """Track indices ``(q,)`` of points seen from poses ``k``, -1: none; mutual nearest neighbours with a ratio test.

    The position of a landmark is that of its last observation, so that only the odometry error between consecutive
    observations matters.
    """
    track = np.full(len(points), -1, dtype=np.int64)
    place = np.zeros((0, 2))
    last = np.zeros(0, dtype=np.int64)
    for pose in np.unique(k):
        rows = np.flatnonzero(k == pose)
        rows = rows[np.isfinite(points[rows, 0])]
        live = np.flatnonzero(pose - last <= lost)
        new = rows
        if len(live) and len(rows):
            d = np.linalg.norm(points[rows, None] - place[live][None], axis=2)
            best, mine = d.argmin(axis=1), d.argmin(axis=0)
            second = np.partition(np.column_stack([d, np.full((len(rows), 2), np.inf)]), 1, axis=1)[:, 1]
            i = np.arange(len(rows))
            mutual = (mine[best] == i) & (d[i, best] < gate) & (second > ratio * d[i, best])
            track[rows[mutual]] = live[best[mutual]]
            place[live[best[mutual]]] = points[rows[mutual]]
            last[live[best[mutual]]] = pose
            new = rows[~mutual & (d.min(axis=1) > gate)]
        track[new] = len(place) + np.arange(len(new))
        place = np.concatenate([place, points[new]])
        last = np.concatenate([last, np.full(len(new), pose, dtype=np.int64)])
    return track
