"""Scan-to-map LiDAR odometry: initial guess by search, coarse-to-fine matching, and a check before a scan is mapped.

The initial guess decides whether a match succeeds: a hand-held lidar may turn by 10° between scans, which moves points
at 20 m by metres, while a match converges only within about one cell. So rotations about the prediction and the last
mapped pose are tried on the coarse levels if the match from the prediction is worse than those of recent scans. If the
overlap is lower than usual, a wide range of rotations is searched first, because one misplaced scan corrupts the map
for all later scans. With an IMU, a match with a different rotation is rejected.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam_frontends.lidar_odometry.cell_kernels import deskew_points
from graphslam_frontends.lidar_odometry.cells import (
    CellMap,
    LevelConfig,
    NormalEquations,
    evenly_spaced_rows,
    first_rows_by_cube,
)
from graphslam_frontends.lidar_odometry.config import SPACING, LidarOdometryConfig
from graphslam_frontends.lidar_odometry.inertial import InertialPredictor
from graphslam_frontends.lidar_odometry.wheel_prior import WheelMotionPrior
from graphslam_frontends.lidar_odometry.window_covariance import WindowCovariance
from graphslam_frontends.scan_window.observability import direction_strengths

Index = npt.NDArray[np.int64]

MOST_STEPS = 12
"""Most Gauss–Newton steps on a level."""
SCALE = 2.0
"""Scale of the Geman–McClure kernel (a Mahalanobis distance)."""
STILL = (1e-4, 5e-4)
"""Convergence of a match: the last step is below this [rad], [m]."""
MOST_DESKEWED = 6
"""Most repetitions of deskewing and matching of a scan."""
COARSE_POINTS = 1000
"""Points matched on all but the finest level."""
COARSE = np.diag([1.0 / 0.05**2] * 3 + [1.0 / 0.2**2] * 3)
"""Information matrix of the result of the coarse levels, as a prior on the finest one (0.05 rad, 0.2 m)."""
SEARCHED = 300
"""Points used in a search over rotations."""
FINALISTS = 64
"""Rotations of a search that are compared with all of these points."""
SEARCH_STEP, SEARCH_SIDE = np.deg2rad(4.0), 3
"""Near search: ±3 steps of 4° about each axis."""
WIDE_STEP, WIDE_SIDE = np.deg2rad(8.0), 8
"""Wide search: ±8 steps of 8° about one axis, with ±1 step about the other two."""
LED_AWAY = 0.5
"""If the coarse levels move a match by more than this, in cells of the finest level, the prediction is tried as well.
"""
LIKELY = 0.85
"""No search over rotations if the coarse overlap is above this fraction of the running median …"""
NEAR = (np.deg2rad(4.0), 0.6)
"""… and the match is within this of the prediction [rad], [m]."""
FAR = 5.0
"""A scan with little overlap is lost if it is farther from the prediction than ``NEAR`` plus this many σ."""
LATE = 2.5
"""A scan later than this many median intervals after the last one is searched over a wide range of rotations."""
BETTER = 1.2
"""A pose found by the wide search is accepted if its overlap is larger by this factor."""
NEW = 0.5
"""Fraction of points without a cell on the finest level above which these points are matched on the next coarser level:
points between the rings of earlier scans only fall into wider cells."""
BEGUN = 3
"""Fully observable scans after which the velocity counts as known …"""
FASTEST = 10.0
"""… and σ of the velocity until then [m/s], for a car in a town; the predicted velocity is 0."""
LITTLE = 0.1
"""A match is not used if less than this fraction of the points has a cell on the finest level. The rings of a sparse
lidar form no surfaces in the first scans; cells of a few random points once moved the second scan of a standing car by
0.7 m."""
FEW = 100
"""Scans with fewer points are not matched."""
FITS = 0.75
"""A scan with little overlap is new space if its fit quality is above this fraction of the running median: its points
fit where the map has cells."""
REMEMBERED = 10
"""Number of scans in the running medians."""
NORMAL_SIGMA = 0.05
"""σ of the normals of cells [rad]."""
NOISE_INDUCED = 1.5
"""A direction is unobservable if its information is at most this multiple of the spurious information that noise of the
normals causes."""
MAPPED = ("first", "matched", "found again", "new space")
"""States of scans that enter the map."""
CORRELATION = 4.0
"""Factor on the variance of the gradient, because consecutive scans see the same surfaces and their errors are
correlated. Found on simulated lidars (`tests/frontends/lidar_odometry`)."""
ACCELERATION = (3.0, 2.0)
"""Lower bound of the acceleration noise [rad/s²], [m/s²]: a hand-held lidar, a car that brakes."""
LONGEST = 30.0
"""Longest time for which the motion covariance grows [s]."""
LONG_SWEEP = 10.0
"""Limit of point ages, in multiples of the motion interval."""
GIVEN_UP = 10
"""Consecutive lost scans after which a new map begins."""
MOST_KEPT = 8000
"""Most points of a scan in the map."""
FINEST_SIGMA = 0.05
"""σ added to the cells of the finest level [m]; on coarser levels it is a quarter of the edge."""
WINDOW_SCANS = 100
"""Cells of at least this many scans are kept, whatever the distance travelled."""
SUSPICIOUS = 0.7
"""A wide search starts if the overlap is below this fraction of the running median."""


MOST_WEAK = 3
"""Most of the weakest directions in which a match may be replaced by the IMU prediction."""
GYRO_OFF = 0.15
"""A match rotated by more than this from the IMU prediction is a false match [rad]: rooms look alike after a right
angle. A gyro bias of 0.005 rad/s, large for a cheap gyro, rotates by this in 30 s."""


@dataclass(frozen=True, slots=True)
class ScanResult:
    """Result of the match of one scan.

    Parameters
    ----------
    points : int
        Number of points matched.
    overlap : float
        Sum of the weights on the finest level, divided by the number of points; nan for the first scan of a map.
    unobservable : int
        Number of unobservable directions, of six; the prediction is used along them.
    state : str
        "first", "matched", "new space", "found again" (wide search), "lost" (predicted, not in the map), "empty".
    aided : bool
        The IMU predicted the pose or deskewed the points.
    watched : bool
        Odometry was available and useful.
    bridged : bool
        The pose, or its unobservable part, is that of odometry.
    """

    points: int
    overlap: float
    unobservable: int
    state: str
    searched: bool
    aided: bool = False
    watched: bool = False
    bridged: bool = False


def _spreads() -> tuple[Array, Array]:
    """Weighted mean squares of Gaussians under Geman–McClure weights, and the variances of these Gaussians."""
    variances = np.geomspace(1e-3, 30.0, 40)
    x = np.linspace(-6.0, 6.0, 2001)
    out = []
    for v in variances:
        m = v * x**2
        w = np.exp(-0.5 * x**2) / (1.0 + m / SCALE**2) ** 2
        out.append(float(np.sum(w * m) / np.sum(w)))
    return np.array(out), variances


SPREADS = _spreads()
"""Misfit against variance of the residuals relative to the cell model: a table for interpolation."""


@dataclass(frozen=True, slots=True)
class RawScan:
    """Points of a scan before deskewing.

    Parameters
    ----------
    points : (n, 3)
        In the body frame at the time of each point.
    ages : (n,) or None
        Time from each point to the stamp of the scan [s].
    straight : (n, 3), optional
        In the body frame at the stamp, deskewed by an IMU.
    """

    points: Array
    ages: Array | None
    straight: Array | None = None

    def at(self, motion: Array, dt: float) -> Array:
        """Points in the body frame at the stamp ``(n, 3)``; ``motion`` (7,) is uniform in the ``dt`` [s] before it."""
        if self.ages is None or dt <= 0:
            return self.points
        out = np.empty(self.points.shape)
        # ages in a wrong unit must not give unbounded points
        deskew_points(self.points, self.ages, np.asarray(se3.se3_log(motion)), dt, LONG_SWEEP, out)
        return out

    def some(self, rows: Index) -> RawScan:
        """Rows of the points."""
        parts = (None if a is None else a[rows] for a in (self.ages, self.straight))
        return RawScan(self.points[rows], *parts)


class LidarOdometry:
    """Track the scans of a lidar one by one.

    Parameters
    ----------
    inertial : InertialPredictor, optional
        Predicts poses and deskews scans while it is reliable; otherwise constant velocity does both.
    reckoned : WheelMotionPrior, optional
        Odometry: used for unmatched scans, and as the initial guess if there is no IMU prediction.

    Attributes
    ----------
    pose : (7,)
        ``T_first_now``.
    points : (n, 3)
        Of the last scan, subsampled, in the body frame at its stamp.
    spread : (6, 6)
        Covariance of the error of the last prediction, right tangent.
    errors : WindowCovariance
    """

    def __init__(
        self,
        config: LidarOdometryConfig,
        inertial: InertialPredictor | None = None,
        reckoned: WheelMotionPrior | None = None,
    ) -> None:
        self.config, self.inertial, self.reckoned = config, inertial, reckoned
        last = len(config.levels) - 1
        self.levels = [
            CellMap(LevelConfig(size, FINEST_SIGMA if k == last else 0.25 * size, k == last))
            for k, size in enumerate(config.levels)
        ]
        self.pose = np.array([0.0, 0, 0, 0, 0, 0, 1])
        self.anchor = self.pose
        self.twist, self.dt = np.zeros(6), 0.0
        self.time = -np.inf
        self.recent: deque[tuple[float, Array]] = deque(maxlen=50)
        self.scan = -1
        self.length, self.lengths = 0.0, [0.0]
        self.overlaps: deque[float] = deque(maxlen=REMEMBERED)
        self.coarse: deque[float] = deque(maxlen=REMEMBERED)
        self.qualities: deque[float] = deque(maxlen=REMEMBERED)
        self.agreeing: deque[float] = deque(maxlen=5 * REMEMBERED)
        self.points, self.spread = np.zeros((0, 3)), np.zeros((6, 6))
        self.changes: deque[tuple[float, float]] = deque(maxlen=2 * REMEMBERED)
        self.missed: deque[tuple[float, float]] = deque(maxlen=2 * REMEMBERED)
        self.errors, self.off = WindowCovariance(), np.zeros(6)
        self.lost, self.loose, self.held = 0, 1, 0
        self.first = 0
        side = range(-SEARCH_SIDE, SEARCH_SIDE + 1)
        self.near_rotations = _rotations(SEARCH_STEP * np.array(list(product(side, side, side)), dtype=np.float64))
        wide = {
            tuple(np.roll([far, a, b], axis))
            for axis in range(3)
            for far in range(-WIDE_SIDE, WIDE_SIDE + 1)
            for a in (-1, 0, 1)
            for b in (-1, 0, 1)
        }
        self.wide_rotations = _rotations(WIDE_STEP * np.array(sorted(wide), dtype=np.float64))

    # --- one scan ----------------------------------------------------------------------------------------------------

    def predict(self, time: float) -> Array:
        """Motion ``(7,)`` from the last scan to ``time`` at constant velocity, for at most two scan intervals."""
        dt = time - self.time
        ratio = min(dt / self.dt, 2.0) if self.dt > 0 and np.isfinite(dt) else 0.0
        return np.asarray(se3.se3_exp(self.twist * ratio))

    def step(self, cloud: Array, time: float, ages: Array | None = None) -> ScanResult:
        """Match the next scan and add it to the map.

        Parameters
        ----------
        cloud : (m, 3)
            In the body frame at ``time``, all finite.
        time : float
            [s]; not earlier than the previous scan.
        ages : (m,), optional
            Time from each point to ``time`` [s].
        """
        self.scan += 1
        c = self.config
        before = self.pose
        even = se3.se3_compose(before, self.predict(time))
        ahead = None if self.inertial is None else self.inertial.ahead(time)
        reckoned, bridge, Q, led = None, None, None, False
        if self.reckoned is not None and self.scan > 0:
            reckoned = self.reckoned.motion(self.time, time)
            if reckoned is not None and self.reckoned.useful:
                bridge = np.asarray(se3.se3_compose(before, reckoned[0]))
                Q = np.diag(np.repeat(self.reckoned.variances(reckoned[1]), 3))
                led = ahead is None and (self.lost > 0 or self.reckoned.better)
        predicted = ahead if ahead is not None else bridge if led and bridge is not None else even
        rows = first_rows_by_cube(np.ascontiguousarray(cloud), SPACING, (c.min_range, c.max_range))
        kept = rows[evenly_spaced_rows(len(rows), MOST_KEPT)]
        raw = self._raw(cloud[kept], None if ages is None or not c.deskew else ages[kept], time)
        dt = time - self.time if np.isfinite(self.time) else 0.0
        self._since(raw, time)
        chosen = evenly_spaced_rows(len(kept), c.most_points)
        if self.scan == self.first:
            seen = ScanResult(len(chosen), np.nan, 0, "first" if len(chosen) >= FEW else "empty", False)
            self.first += len(chosen) < FEW
            fit = None
            if bridge is not None:
                self.pose, seen = bridge, replace(seen, bridged=True)
        else:
            self.pose, fit, seen = self._match(raw.some(chosen), predicted, bridge, Q, time, ahead is not None)
            seen = replace(seen, watched=bridge is not None, bridged=bridge is not None and seen.unobservable > 0)
        if ahead is not None or raw.straight is not None:
            seen = replace(seen, aided=True)
        self.points = self._unbent(raw, self.pose, time)
        points = self.points[chosen]
        if seen.bridged and bridge is not None:
            predicted = bridge
        motion = np.asarray(se3.se3_between(before, predicted))
        self._doubt(raw, points, motion, even, dt, fit, seen, self._instead(seen, motion, Q))
        reliable = fit is not None and not seen.unobservable and not self.lost and seen.state in MAPPED
        if reliable and reckoned is not None and self.reckoned is not None:
            made, guess = (np.asarray(se3.se3_between(before, x)) for x in (self.pose, even))
            self.reckoned.learn(reckoned[0], made, guess)
        if self.inertial is not None and seen.state in MAPPED:
            self.inertial.learn(time, self.pose, even)
        if seen.state in MAPPED:
            self._add(self.points, alone=fit is None)
            self.lost, self.anchor = 0, self.pose
        else:
            self.lost += 1
            if self.lost >= GIVEN_UP and len(points) >= FEW:
                # the sensor has left the map: a new map begins with the next scan
                self.first = self.scan + 1
                self._begin()
        made = se3.se3_between(before, self.pose)
        if np.isfinite(dt) and dt > 0:
            if self.dt > 0 and not self.lost:
                change = np.asarray(se3.se3_log(made)) / dt - self.twist / self.dt
                self.changes.append((float(np.mean(change[:3] ** 2)), float(np.mean(change[3:] ** 2))))
            # the motion of a lost scan is unknown: the predicted velocity decays to zero
            self.twist, self.dt = (0.5 if self.lost else 1.0) * np.asarray(se3.se3_log(made)), dt
        self.time = time
        self.recent.append((time, self.pose))
        self.length += float(np.linalg.norm(made[:3]))
        self.lengths.append(self.length)
        if self.scan % 20 == 19:
            old = int(np.searchsorted(self.lengths, self.length - c.window)) - 1
            since = min(old, self.scan - WINDOW_SCANS)
            if since > 0:
                for level in self.levels:
                    level.keep_since(since)
        return seen

    def _instead(self, seen: ScanResult, motion: Array, Q: Array | None) -> Array | None:
        """Covariance ``(6, 6)`` of the motion if it is not that of constant velocity: the odometry's if ``bridged``."""
        return Q if seen.bridged else None

    def _bent(self, raw: RawScan) -> Array:
        """Covariance ``(6, 6)`` of the pose error caused by non-uniform motion within a scan.

        The mean velocity of an interval is off by half its change to the next one.
        """
        if raw.ages is None or not len(raw.ages):
            return np.zeros((6, 6))
        if raw.straight is not None and self.inertial is not None:
            turn2, shift2 = self.inertial.unsure(float(np.mean(raw.ages)))
            return np.diag([turn2] * 3 + [shift2] * 3)
        if not self.changes:
            return np.zeros((6, 6))
        turn2, shift2 = 0.25 * np.mean(self.changes, axis=0) * float(np.mean(raw.ages)) ** 2
        return np.diag([turn2] * 3 + [shift2] * 3)

    def _since(self, raw: RawScan, time: float) -> None:
        """Set the start of the constant-velocity interval: at least two sweeps back.

        With one sweep, if a scan lasts until the next, an error of the last pose would cause an error of the opposite
        sign and the same size in this pose, and so on without end.
        """
        if raw.ages is None or not len(raw.ages):
            return
        span = 2.0 * float(np.abs(raw.ages).max()) - 1e-6
        while len(self.recent) > 1 and time - self.recent[1][0] >= span:
            self.recent.popleft()

    def _raw(self, points: Array, ages: Array | None, time: float) -> RawScan:
        then = None if ages is None or self.inertial is None else self.inertial.within(time, ages)
        return RawScan(points, ages, None if then is None else np.asarray(se3.se3_transform(then, points)))

    def _unbent(self, raw: RawScan, pose: Array, time: float) -> Array:
        """Deskewed points of a scan, for the body at ``pose`` (7,) at its stamp."""
        if raw.straight is not None:
            return raw.straight
        if raw.ages is None or not self.recent or time <= self.recent[0][0]:
            return raw.points
        then, before = self.recent[0]
        return raw.at(se3.se3_between(before, pose), time - then)

    def _begin(self) -> None:
        self.levels = [CellMap(level.config) for level in self.levels]
        for memory in (self.overlaps, self.coarse, self.qualities):
            memory.clear()
        self.errors.forget()
        if self.inertial is not None:
            self.inertial.forget()

    def _doubt(
        self,
        raw: RawScan,
        points: Array,
        motion: Array,
        even: Array,
        dt: float,
        fit: NormalEquations | None,
        seen: ScanResult,
        reckoned: Array | None,
    ) -> None:
        """Update the joint covariance of the current pose and the window poses, after a predicted ``motion`` (7,).

        The motion covariance is that of constant velocity, also if an IMU predicted the pose: no IMU information
        enters, so that the graph may still use it. If odometry replaces a match, its covariance is ``reckoned`` (6, 6).
        """
        if seen.state in MAPPED and seen.state != "first":
            off = np.asarray(se3.se3_log(se3.se3_between(even, self.pose)))
            self.missed.append((float(np.mean(off[:3] ** 2)), float(np.mean(off[3:] ** 2))))
        if self.scan == 0:
            return
        self.loose = self.loose + 1 if fit is None or seen.unobservable else 1
        dt = min(dt, LONGEST)
        turn2, shift2 = np.mean(self.missed, axis=0) if self.missed else (0.0, 0.0)
        turn2 = max(turn2, (0.5 * ACCELERATION[0] * dt**2) ** 2, 1e-6)
        shift2 = max(shift2, (0.5 * ACCELERATION[1] * dt**2) ** 2, 1e-6)
        self.spread = np.diag([turn2] * 3 + [shift2] * 3)
        # an unobservable velocity stays wrong until it is observed
        Q = self.loose**2 * self.spread
        if self.held < BEGUN:
            # a constant velocity error: this step adds k² − (k − 1)² of its variance, also in `spread`
            unknown = np.diag([0.0] * 3 + [(2 * self.loose - 1) * (FASTEST * dt) ** 2] * 3)
            Q, self.spread = Q + unknown, self.spread + unknown
        self.held += fit is not None and not seen.unobservable
        if reckoned is not None:
            # a constant odometry error: σ grows linearly, so this step adds k² − (k − 1)² of the variance
            Q = self.spread = (2 * self.loose - 1) * reckoned
        H, M = np.zeros((max(len(self.errors.ends), 1), 6, 6)), np.zeros((6, 6))
        if fit is not None and self.errors.ends:
            H, M, G = self.levels[-1].by_slot(points, *split_pose(self.pose), SCALE, np.array(self.errors.ends))
        if fit is not None and M.any():
            M *= np.interp(fit.misfit, *SPREADS)
            # ratio of the gradient variance by parts of space to that by single cells
            E = M + 1e-6 * np.trace(M) / 6.0 * np.eye(6)
            self.agreeing.append(float(np.trace(np.linalg.solve(E, G.T @ G))) / 6.0)
            M *= CORRELATION * float(np.mean(self.agreeing))
            F = observable_gradient(fit.H, fit.every, seen.unobservable)
            H, M = F @ H, F @ M @ F.T
        self.errors.step(self.pose, motion, Q, H, M, self._bent(raw), self.off)

    def _add(self, points: Array, alone: bool) -> None:
        R, t = split_pose(self.pose)
        world = points @ R.T + t
        for level in self.levels:
            level.add(world, self.scan, None if level is self.levels[0] else self.levels[0])
        self.errors.lay(self.scan, alone)

    # --- matching ----------------------------------------------------------------------------------------------------

    def _match(
        self,
        raw: RawScan,
        predicted: Array,
        bridge: Array | None,
        reckoned: Array | None,
        time: float,
        by_imu: bool,
    ) -> tuple[Array, NormalEquations | None, ScanResult]:
        """Pose of a scan, the fit there, and the result.

        Parameters
        ----------
        predicted : (7,)
            Initial guess of the match.
        bridge : (7,) or None
            Pose by odometry; used along unobservable directions.
        reckoned : (6, 6) or None
            Covariance of that motion; None: that of constant velocity, estimated from recent scans.
        time : float
            [s]
        by_imu : bool
            ``predicted`` is from the IMU: matches with another rotation or far from it are rejected.
        """
        inertial = self.inertial if by_imu else None
        reach = np.inf if inertial is None else inertial.reach(time)

        def alike(pose: Array, reach: float = reach) -> bool:
            off = np.asarray(se3.se3_log(se3.se3_between(predicted, pose)))
            return inertial is None or bool(np.linalg.norm(off[:3]) < GYRO_OFF and np.linalg.norm(off[3:]) < reach)

        points = self._unbent(raw, predicted, time)
        stands = predicted if bridge is None else bridge
        if len(points) < FEW:
            return stands, None, ScanResult(len(points), 0.0, 6, "empty", False)
        few = points[evenly_spaced_rows(len(points), SEARCHED)]
        top = self.levels[:-1] or self.levels
        start, coarse = self._descend(points, predicted, top)
        searched = False
        if not self._likely(coarse.overlap, predicted, start):
            searched = True
            tried = [(coarse.overlap, start)]
            tried += self._search(points, few, (predicted, self.anchor), self.near_rotations, 2, top)
            near = [x for x in tried if alike(x[1])]
            start = max(near, key=lambda x: x[0])[1] if near else predicted
        start = start if alike(start) else predicted
        pose, points, fit = self._finish(raw, start, time)
        led = float(np.linalg.norm(se3.se3_between(predicted, start)[:3]))
        if self.held >= BEGUN and led > LED_AWAY * self.config.levels[-1]:
            # the coarse levels left the prediction's range of convergence: compare both on the finest level
            ahead = self._finish(raw, predicted, time)
            if ahead[2].overlap > fit.overlap:
                start, (pose, points, fit) = predicted, ahead
        state = "matched"
        few_of_it = len(self.overlaps) >= 3 and fit.overlap < SUSPICIOUS * np.median(self.overlaps)
        if few_of_it or self._late(time):
            searched = True
            found = self._search(points, few, (predicted, self.anchor), self.wide_rotations, 6, self.levels)
            near = [x for x in found if alike(x[1])]
            overlap, best = max(near, key=lambda x: x[0]) if near else (0.0, start)
            if overlap > BETTER * fit.overlap:
                start = best
                pose, points, fit = self._finish(raw, start, time)
                state = "found again"
            if few_of_it and fit.overlap < SUSPICIOUS * np.median(self.overlaps):
                # after lost scans, little overlap means a misplaced scan, not new space
                fits = fit.quality > FITS * np.median(self.qualities) and fit.known * len(points) > FEW
                spread = self.spread if reckoned is None else reckoned
                state = "new space" if fits and not self.lost and not _far(stands, pose, spread) else "lost"
        free, (pose, unobservable) = pose, self._hold(pose, stands, fit)
        if inertial is not None and state != "lost":
            inertial.shifts.append(float(np.linalg.norm(se3.se3_between(predicted, pose)[:3])))
            while not alike(pose) and alike(pose, np.inf) and unobservable < MOST_WEAK:
                # weak directions let a scan slide, for example along a wall: use the IMU along them
                pose, unobservable = self._hold(free, stands, fit, unobservable + 1)
                at_it = self.levels[-1].fit(self._unbent(raw, pose, time), *split_pose(pose), SCALE)
                state = "matched" if at_it.overlap > SUSPICIOUS * fit.overlap else "lost"
        if state == "lost" or not alike(pose):
            return stands, None, ScanResult(len(points), fit.overlap, 6, "lost", searched)
        if fit.known < LITTLE:
            return start if bridge is None else bridge, None, ScanResult(len(points), fit.overlap, 6, state, searched)
        if unobservable and bridge is None and len(self.missed) < 3:
            # the motion model is still unknown: zero velocity is used only if the scan fits there as well
            points = self._unbent(raw, pose, time)
            if self.levels[-1].fit(points, *split_pose(pose), SCALE).overlap < LIKELY * fit.overlap:
                pose = free
        if state != "new space":
            self.overlaps.append(fit.overlap)
            self.qualities.append(fit.quality)
            self.coarse.append(
                top[-1].fit(points[evenly_spaced_rows(len(points), COARSE_POINTS)], *split_pose(pose), SCALE).overlap
            )
        return pose, fit, ScanResult(len(points), fit.overlap, unobservable, state, searched)

    def _finish(self, raw: RawScan, pose: Array, time: float) -> tuple[Array, Array, NormalEquations]:
        """Match on the finest level: pose, points deskewed with it, fit."""
        prior = None
        for _ in range(MOST_DESKEWED):
            points = self._unbent(raw, pose, time)
            before = pose
            prior = COARSE + self._coarser(points, *split_pose(pose))
            pose, fit = self._descend(points, pose, self.levels[-1:], prior)
            moved = se3.se3_log(se3.se3_between(before, pose))
            # deskewing with a wrong motion shifts each pose a little, always to the same side: repeat until convergence
            stood = np.linalg.norm(moved[:3]) < STILL[0] and np.linalg.norm(moved[3:]) < STILL[1]
            if raw.ages is None or raw.straight is not None or stood:
                break
        return pose, points, fit

    def _late(self, time: float) -> bool:
        """Is the interval before this scan much longer than usual?"""
        usual = [b[0] - a[0] for a, b in zip(self.recent, list(self.recent)[1:])]
        return bool(usual) and time - self.time > LATE * float(np.median(usual))

    def _likely(self, overlap: float, predicted: Array, start: Array) -> bool:
        if len(self.coarse) < 3 or overlap < LIKELY * np.median(self.coarse):
            return False
        off = se3.se3_log(se3.se3_between(predicted, start))
        return bool(np.linalg.norm(off[:3]) < NEAR[0] and np.linalg.norm(off[3:]) < NEAR[1])

    def _descend(
        self, points: Array, pose: Array, levels: list[CellMap], prior: Array | None = None
    ) -> tuple[Array, NormalEquations]:
        """Gauss–Newton on one level after the other; on coarse ones the start is kept along unobservable directions.

        ``prior`` is the information of the coarse levels, ``(6, 6)``, for the finest one.
        """
        fit = None
        for level in levels:
            R, t = split_pose(pose.copy())
            if level is self.levels[-1]:
                prior = COARSE + self._coarser(points, R, t) if prior is None else prior
                fit = level.descend(points, R, t, SCALE, prior, STILL, MOST_STEPS)
                pose = np.concatenate([t, se3.matrix_to_quat(R)])
                continue
            some, size = points[evenly_spaced_rows(len(points), COARSE_POINTS)], level.config.size
            still = (0.002 * size, 0.01 * size)
            fit = level.descend(some, R, t, SCALE, 1e-3 * np.eye(6), still, MOST_STEPS)
            pose, _ = self._hold(np.concatenate([t, se3.matrix_to_quat(R)]), pose, fit)
        assert fit is not None
        return pose, fit

    def _coarser(self, points: Array, R: Array, t: Array) -> Array:
        """Information ``(6, 6)`` of the next coarser level, for the points without a cell on the finest level."""
        if len(self.levels) < 2:
            return np.zeros((6, 6))
        new = ~self.levels[-1].known(points @ R.T + t)
        if np.mean(new) < NEW:
            return np.zeros((6, 6))
        return self.levels[-2].fit(points[new], R, t, SCALE).H

    def _search(
        self, points: Array, few: Array, centres: tuple[Array, ...], rotations: Array, best: int, levels: list[CellMap]
    ) -> list[tuple[float, Array]]:
        """The best rotations about each centre on the coarsest level, matched on ``levels``: (overlap, pose)."""
        out = []
        for centre in centres:
            R, t = split_pose(centre)
            tries = R @ rotations
            # every fourth point selects the rotations that are compared with all points
            tries = tries[np.argsort(-self.levels[0].scores(few[::4], tries, t), kind="stable")[:FINALISTS]]
            scores = self.levels[0].scores(few, tries, t)
            for k in np.argsort(-scores, kind="stable")[:best]:
                start = np.concatenate([t, se3.matrix_to_quat(tries[k])])
                pose, fit = self._descend(points, start, levels)
                out.append((fit.overlap, pose))
        return out

    def _hold(self, pose: Array, predicted: Array, fit: NormalEquations, least: int = 0) -> tuple[Array, int]:
        """Use the prediction along unobservable directions, at least ``least`` of them; and their number."""
        if not least and all_observable(fit.H, fit.every):
            return pose, 0
        P = observable_projection(fit.H, fit.every, least)
        unobservable = 6 - round(float(np.trace(P)))
        if unobservable:
            xi = P @ np.asarray(se3.se3_log(se3.se3_between(predicted, pose)))
            pose = np.asarray(se3.se3_compose(predicted, se3.se3_exp(xi)))
        return pose, unobservable


def _far(predicted: Array, pose: Array, spread: Array) -> bool:
    """Is a pose farther from the prediction than its covariance allows?"""
    off = se3.se3_log(se3.se3_between(predicted, pose))
    turn, shift = (FAR * np.sqrt(np.trace(block)) for block in (spread[:3, :3], spread[3:, 3:]))
    return bool(np.linalg.norm(off[:3]) > NEAR[0] + turn or np.linalg.norm(off[3:]) > NEAR[1] + shift)


def all_observable(H: Array, every: Array) -> bool:
    """Are all directions observable? Much faster than :func:`observable_projection`, whose rank would be six."""
    _, B = _spurious(H, every)
    try:
        np.linalg.cholesky(H - NOISE_INDUCED * B)
    except np.linalg.LinAlgError:
        return False
    return True


def observable_projection(H: Array, every: Array, least: int = 0) -> Array:
    """Projection ``(6, 6)`` of motions onto the observable directions.

    Parameters
    ----------
    H : (6, 6)
        Information of a scan.
    every : (6, 6)
        Information of the same points if each constrained every direction.
    least : int
        Number of the weakest directions that are removed in any case.
    """
    values, V, B = _directions(H, every)
    U = V[:, max(int(np.sum(values <= NOISE_INDUCED)), least) :]
    return np.asarray(U @ U.T @ B)


def observable_gradient(H: Array, every: Array, least: int = 0) -> Array:
    """Matrix ``(6, 6)`` that removes from a gradient the spurious information caused by noise of the normals.

    The ``least`` weakest directions are removed completely.
    """
    values, V, B = _directions(H, every)
    share = np.maximum(1.0 - NOISE_INDUCED / np.maximum(values, 1e-9), 0.0)
    share[:least] = 0.0
    return np.asarray(B @ (V * share) @ V.T)


def _directions(H: Array, every: Array) -> tuple[Array, Array, Array]:
    every, B = _spurious(H, every)
    return *direction_strengths(H, every, NORMAL_SIGMA), B


def _spurious(H: Array, every: Array) -> tuple[Array, Array]:
    """Regularised ``every``, and the spurious information caused by noise of the normals."""
    every = 1.01 * every + np.eye(6)
    return every, NORMAL_SIGMA**2 * (every - H) + 1e-9 * every


def split_pose(pose: Array) -> tuple[Array, Array]:
    """Rotation ``(3, 3)`` and translation ``(3,)`` of a pose ``(7,)``."""
    return np.ascontiguousarray(se3.quat_to_matrix(pose[3:])), np.ascontiguousarray(pose[:3])


def _rotations(vectors: Array) -> npt.NDArray[np.float64]:
    return np.ascontiguousarray(se3.quat_to_matrix(se3.so3_exp(vectors)))
