"""Scan after scan against the map of those before it: start by search, coarse to fine, and a check before it is kept.

What decides is the start of each match. A hand-held lidar turns by ten degrees between scans, which moves things at
20 m by metres, while a match sees no farther than a cell. So rotations about the prediction and about the last pose are
tried on the coarsest cells, wherever the prediction's own match is not as good as the scans before it. A scan that
finds less of itself in the map than usual is looked for far and wide before it enters the map: a lost scan in the map
spoils all that come after. Where a gyro says how the sensor turned, a match that is turned otherwise is refused.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.geometry import Array
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
"""Gauss–Newton steps on a level."""
SCALE = 2.0
"""Mahalanobis distance of Geman and McClure's kernel."""
STILL = (1e-4, 5e-4)
"""A match stands still below this [rad], [m]."""
MOST_DESKEWED = 6
"""Times that a scan is unbent by the motion found."""
COARSE_POINTS = 1000
"""Points matched on all but the finest level."""
COARSE = np.diag([1.0 / 0.05**2] * 3 + [1.0 / 0.2**2] * 3)
"""Information of what a coarse match says [rad], [m]."""
SEARCHED = 300
"""Points of a search over rotations."""
SEARCH_STEP, SEARCH_SIDE = np.deg2rad(4.0), 3
"""Rotations are tried ±3 steps of 4° about every axis …"""
WIDE_STEP, WIDE_SIDE = np.deg2rad(8.0), 8
"""… and, where a scan is looked for far and wide, ±8 steps of 8° about one with ±1 about the others."""
LED_AWAY = 0.5
"""Cells of the finest level by which coarse levels may move a match before it is compared with the prediction."""
LIKELY = 0.85
"""Overlap of the prediction's match beside the running median above which rotations are not searched …"""
NEAR = (np.deg2rad(4.0), 0.6)
"""… if it corrects the prediction by less than this [rad], [m]."""
FAR = 5.0
"""What overlaps little is no new space where it corrects the prediction by so many of its σ more than that."""
LATE = 2.5
"""Time since the last scan, in usual ones, from which a scan is looked for far and wide anyhow."""
BETTER = 1.2
"""A place found far and wide must overlap so many times as much."""
NEW = 0.5
"""Share of the points of a scan without a cell on the finest level from which on the level above speaks for them: what
lies between the rings of the scans so far is seen by wider cells alone."""
BEGUN = 3
"""Scans that surfaces held in every direction before the speed is known …"""
FASTEST = 10.0
"""… and its σ until then [m/s]: a car in a town. Rest is the prediction, and stands for what nothing holds."""
LITTLE = 0.1
"""Share of the points of a scan that have a cell on the finest level below which that level says nothing of the scan.
The rings of a sparse lidar make no surfaces before several scans are laid on each other: cells of a few chance points
once pulled the second scan of a standing car down by 0.7 m."""
FEW = 100
"""Points below which a scan is not matched."""
FITS = 0.75
"""Quality of the fit beside the running median from which on a scan with little overlap is one of new space: where
there is something to fit to, it fits."""
REMEMBERED = 10
"""Scans of the running medians."""
NORMAL_SIGMA = 0.05
"""σ of the normals of cells [rad]."""
PRETENDED = 1.5
"""What surfaces hold a body by, in multiples of what such noise of their normals would pretend to, up to which nothing
is known."""
MAPPED = ("first", "matched", "found again", "new space")
"""States of scans that enter the map."""
LASTING = 4.0
"""Variance of what surfaces do to the poses of a window, which see them again and again, beside that of one scan's
residuals. Found on simulated lidars (`tests/frontends/lidar_odometry`)."""
ACCELERATION = (3.0, 2.0)
"""What speeds may change by, beside what was seen lately [rad/s²], [m/s²]: a hand-held lidar, a car that brakes."""
LONGEST = 30.0
"""Of a longer time nothing less is known than of this [s]: a kilometre either way."""
LONG_SWEEP = 10.0
"""Points are no older than so many times the motion that they are moved by."""
GIVEN_UP = 10
"""Scans lost in a row after which a new map begins."""
MOST_KEPT = 8000
"""Points of a scan that enter the map at most."""
FINEST_SIGMA = 0.05
"""σ added to the cells of the finest level [m]; coarser ones: a quarter of their edge."""
WINDOW_SCANS = 100
"""Cells of so many scans are kept at least, however far the sensor has moved since."""
SUSPICIOUS = 0.7
"""Share of the running median of the overlap below which a scan is looked for far and wide."""


MOST_WEAK = 3
"""Directions, of those that surfaces hold least, along which a match gives way to an IMU."""
GYRO_OFF = 0.15
"""A match that is turned further than this from what a gyro says [rad] is another place that looks alike: rooms look
alike when turned by a right angle. A bias of 0.005 rad/s, large for a cheap gyro, turns by this in 30 s."""


@dataclass(frozen=True, slots=True)
class ScanResult:
    """What came of a scan.

    Parameters
    ----------
    points : int
        Matched.
    overlap : float
        Share of them on the finest cells; nan for the first scan of a map.
    unheld : int
        Number of directions, of six, that no surface holds: the prediction stands there.
    state : str
        "first", "matched", "new space", "found again" (far and wide), "lost" (predicted, not in the map), "empty".
    aided : bool
        An IMU told where the match began, or unbent the points.
    watched : bool
        Odometry told the motion, and was of use so far: it leads if it is better, stands where nothing is matched.
    bridged : bool
        The pose, or what of it no surface holds, is that of odometry.
    """

    points: int
    overlap: float
    unheld: int
    state: str
    searched: bool
    aided: bool = False
    watched: bool = False
    bridged: bool = False


def _spreads() -> tuple[Array, Array]:
    """Weighted mean of squares under Geman and McClure's weights, of Gaussians of so much variance."""
    variances = np.geomspace(1e-3, 30.0, 40)
    x = np.linspace(-6.0, 6.0, 2001)
    out = []
    for v in variances:
        m = v * x**2
        w = np.exp(-0.5 * x**2) / (1.0 + m / SCALE**2) ** 2
        out.append(float(np.sum(w * m) / np.sum(w)))
    return np.array(out), variances


SPREADS = _spreads()
"""Misfit, and the variance of residuals beside what the cells say that it tells of."""


@dataclass(frozen=True, slots=True)
class RawScan:
    """Points as they were measured while the body moved.

    Parameters
    ----------
    points : (n, 3)
        In the body at its time of each.
    ages : (n,) or None
        Time from each to the stamp of the scan [s].
    straight : (n, 3), optional
        In the body at the stamp, by an IMU.
    """

    points: Array
    ages: Array | None
    straight: Array | None = None

    def at(self, motion: Array, dt: float) -> Array:
        """In the body at the stamp ``(n, 3)``, where it moved by ``motion`` (7,) evenly in the ``dt`` [s] before."""
        if self.ages is None or dt <= 0:
            return self.points
        # times in another unit must not throw points out of the world
        ages = np.clip(self.ages / dt, -LONG_SWEEP, LONG_SWEEP)
        steps = -ages[:, None] * np.asarray(se3.se3_log(motion))
        return np.asarray(se3.se3_transform(se3.se3_exp(steps), self.points))


class LidarOdometry:
    """Follows the scans of a lidar one by one.

    Parameters
    ----------
    inertial : InertialPredictor, optional
        Tells where a match begins and how a scan is bent, as long as it is believed; an even motion does otherwise.
    reckoned : WheelMotionPrior, optional
        Odometry: where nothing is matched, and where a match begins if no IMU tells it.

    Attributes
    ----------
    pose : (7,)
        ``T_first_now``.
    points : (n, 3)
        Of the last scan, thinned, in the body at its stamp.
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
        self.way, self.ways = 0.0, [0.0]
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
        """Motion ``(7,)`` from the last scan to ``time`` at constant velocity."""
        dt = time - self.time
        ratio = min(dt / self.dt, 2.0) if self.dt > 0 and np.isfinite(dt) else 0.0
        return np.asarray(se3.se3_exp(self.twist * ratio))

    def step(self, cloud: Array, time: float, ages: Array | None = None) -> ScanResult:
        """Match the next scan, and put it into the map.

        Parameters
        ----------
        cloud : (m, 3)
            In the body at ``time``, all finite.
        time : float
            [s]; not before the scan before.
        ages : (m,), optional
            Time from each point to ``time`` [s].
        """
        self.scan += 1
        c = self.config
        before = self.pose
        even = se3.se3_compose(before, self.predict(time))
        ahead = None if self.inertial is None else self.inertial.ahead(time)
        told, bridge, Q, led = None, None, None, False
        if self.reckoned is not None and self.scan > 0:
            told = self.reckoned.motion(self.time, time)
            if told is not None and self.reckoned.useful:
                bridge = np.asarray(se3.se3_compose(before, told[0]))
                Q = np.diag(np.repeat(self.reckoned.variances(told[1]), 3))
                led = ahead is None and (self.lost > 0 or self.reckoned.better)
        predicted = ahead if ahead is not None else bridge if led and bridge is not None else even
        rows = first_rows_by_cube(np.ascontiguousarray(cloud), SPACING, (c.min_range, c.max_range))
        kept = rows[evenly_spaced_rows(len(rows), MOST_KEPT)]
        raw = self._raw(cloud[kept], None if ages is None or not c.deskew else ages[kept], time)
        dt = time - self.time if np.isfinite(self.time) else 0.0
        self._since(raw, time)
        chosen = evenly_spaced_rows(len(kept), c.most_points)
        points = self._unbent(raw, predicted, time)[chosen]
        if self.scan == self.first:
            seen = ScanResult(len(points), np.nan, 0, "first" if len(points) >= FEW else "empty", False)
            self.first += len(points) < FEW
            fit = None
            if bridge is not None:
                self.pose, seen = bridge, replace(seen, bridged=True)
        else:
            self.pose, fit, seen = self._match(raw, chosen, predicted, bridge, Q, time, ahead is not None)
            seen = replace(seen, watched=bridge is not None, bridged=bridge is not None and seen.unheld > 0)
        if ahead is not None or raw.straight is not None:
            seen = replace(seen, aided=True)
        self.points = self._unbent(raw, self.pose, time)
        points = self.points[chosen]
        if seen.bridged and bridge is not None:
            predicted = bridge
        motion = np.asarray(se3.se3_between(before, predicted))
        self._doubt(raw, points, motion, even, dt, fit, seen, self._instead(seen, motion, Q))
        sure = fit is not None and not seen.unheld and not self.lost and seen.state in MAPPED
        if sure and told is not None and self.reckoned is not None:
            made, guess = (np.asarray(se3.se3_between(before, x)) for x in (self.pose, even))
            self.reckoned.learn(told[0], made, guess)
        if self.inertial is not None and seen.state in MAPPED:
            self.inertial.learn(time, self.pose, even)
        if seen.state in MAPPED:
            self._add(self.points, alone=fit is None)
            self.lost, self.anchor = 0, self.pose
        else:
            self.lost += 1
            if self.lost >= GIVEN_UP and len(points) >= FEW:
                # nothing of the map is here any more: what comes is matched to what comes
                self.first = self.scan + 1
                self._begin()
        made = se3.se3_between(before, self.pose)
        if np.isfinite(dt) and dt > 0:
            if self.dt > 0 and not self.lost:
                change = np.asarray(se3.se3_log(made)) / dt - self.twist / self.dt
                self.changes.append((float(np.mean(change[:3] ** 2)), float(np.mean(change[3:] ** 2))))
            # nobody knows how a body moves that is not seen: the guess is that it comes to rest
            self.twist, self.dt = (0.5 if self.lost else 1.0) * np.asarray(se3.se3_log(made)), dt
        self.time = time
        self.recent.append((time, self.pose))
        self.way += float(np.linalg.norm(made[:3]))
        self.ways.append(self.way)
        if self.scan % 20 == 19:
            old = int(np.searchsorted(self.ways, self.way - c.window)) - 1
            since = min(old, self.scan - WINDOW_SCANS)
            if since > 0:
                for level in self.levels:
                    level.keep_since(since)
        return seen

    def _instead(self, seen: ScanResult, motion: Array, Q: Array | None) -> Array | None:
        """Covariance ``(6, 6)`` of the motion where that of an even one is not enough: of odometry in its place."""
        return Q if seen.bridged else None

    def _bent(self, raw: RawScan) -> Array:
        """Covariance of what an uneven motion within a scan does to its pose.

        The motion within a scan is off the mean one by half of what it changes by from one interval to the next.
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
        """Since when the motion is taken to be even: over two sweeps or more.

        If a scan lasts until the next, an even motion from the last pose alone would answer an error of that pose by
        one of the other sign, as large, in this one, and so on for ever.
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
        """Points of a scan where the body stands at ``pose`` (7,), at its stamp."""
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
        """How far the pose of now is off after an expected ``motion``, jointly with those of the window.

        What is expected of a motion is what an even one would miss, also where an IMU predicted it: nothing of what
        that tells is in the covariance, so that a graph may still count it. Where odometry stands for scans, what it
        may miss is: ``reckoned`` (6, 6).
        """
        if seen.state in MAPPED and seen.state != "first":
            off = np.asarray(se3.se3_log(se3.se3_between(even, self.pose)))
            self.missed.append((float(np.mean(off[:3] ** 2)), float(np.mean(off[3:] ** 2))))
        if self.scan == 0:
            return
        self.loose = self.loose + 1 if fit is None or seen.unheld else 1
        dt = min(dt, LONGEST)
        turn2, shift2 = np.mean(self.missed, axis=0) if self.missed else (0.0, 0.0)
        turn2 = max(turn2, (0.5 * ACCELERATION[0] * dt**2) ** 2, 1e-6)
        shift2 = max(shift2, (0.5 * ACCELERATION[1] * dt**2) ** 2, 1e-6)
        self.spread = np.diag([turn2] * 3 + [shift2] * 3)
        # a speed that nothing holds is off for as long as nothing holds it
        Q = self.loose**2 * self.spread
        if self.held < BEGUN:
            # one speed all along: k² − (k − 1)² of its way's variance are of this step, also in what a refinement gets
            unknown = np.diag([0.0] * 3 + [(2 * self.loose - 1) * (FASTEST * dt) ** 2] * 3)
            Q, self.spread = Q + unknown, self.spread + unknown
        self.held += fit is not None and not seen.unheld
        if reckoned is not None:
            # as far as it is off in one way all along, σ grows with the time: k² − (k − 1)² of it are of this step
            Q = self.spread = (2 * self.loose - 1) * reckoned
        H, M = np.zeros((max(len(self.errors.ends), 1), 6, 6)), np.zeros((6, 6))
        if fit is not None and self.errors.ends:
            H, M, G = self.levels[-1].by_slot(points, *split_pose(self.pose), SCALE, np.array(self.errors.ends))
        if fit is not None and M.any():
            M *= np.interp(fit.misfit, *SPREADS)
            # how far residuals of a whole part of the scan agree, beside what those of one cell would
            E = M + 1e-6 * np.trace(M) / 6.0 * np.eye(6)
            self.agreeing.append(float(np.trace(np.linalg.solve(E, G.T @ G))) / 6.0)
            M *= LASTING * float(np.mean(self.agreeing))
            F = observable_gradient(fit.H, fit.every, seen.unheld)
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
        chosen: Index,
        predicted: Array,
        bridge: Array | None,
        told: Array | None,
        time: float,
        by_imu: bool,
    ) -> tuple[Array, NormalEquations | None, ScanResult]:
        """Pose of a scan, the fit there, and what came of it.

        Parameters
        ----------
        chosen : (k,) int
        predicted : (7,)
            Where the match begins.
        bridge : (7,) or None
            Where odometry puts it; stands where no surface does.
        told : (6, 6) or None
            Covariance of that motion; None: of an even one, as scans saw it lately.
        time : float
            [s]
        by_imu : bool
            An IMU says where ``predicted`` is and how it is turned: matches elsewhere are refused.
        """
        inertial = self.inertial if by_imu else None
        reach = np.inf if inertial is None else inertial.reach(time)

        def alike(pose: Array, reach: float = reach) -> bool:
            off = np.asarray(se3.se3_log(se3.se3_between(predicted, pose)))
            return inertial is None or bool(np.linalg.norm(off[:3]) < GYRO_OFF and np.linalg.norm(off[3:]) < reach)

        points = self._unbent(raw, predicted, time)[chosen]
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
        pose, points, fit = self._finish(raw, chosen, start, time)
        led = float(np.linalg.norm(se3.se3_between(predicted, start)[:3]))
        if self.held >= BEGUN and led > LED_AWAY * self.config.levels[-1]:
            # coarse cells moved it out of reach of the prediction: the finest ones decide
            ahead = self._finish(raw, chosen, predicted, time)
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
                pose, points, fit = self._finish(raw, chosen, start, time)
                state = "found again"
            if few_of_it and fit.overlap < SUSPICIOUS * np.median(self.overlaps):
                # after scans that were lost, what overlaps little is not new but elsewhere
                fits = fit.quality > FITS * np.median(self.qualities) and fit.known * len(points) > FEW
                spread = self.spread if told is None else told
                state = "new space" if fits and not self.lost and not _far(stands, pose, spread) else "lost"
        free, (pose, unheld) = pose, self._hold(pose, stands, fit)
        if inertial is not None and state != "lost":
            inertial.shifts.append(float(np.linalg.norm(se3.se3_between(predicted, pose)[:3])))
            while not alike(pose) and alike(pose, np.inf) and unheld < MOST_WEAK:
                # what holds a scan least lets it slide: along a wall, say
                pose, unheld = self._hold(free, stands, fit, unheld + 1)
                at_it = self.levels[-1].fit(self._unbent(raw, pose, time)[chosen], *split_pose(pose), SCALE)
                state = "matched" if at_it.overlap > SUSPICIOUS * fit.overlap else "lost"
        if state == "lost" or not alike(pose):
            return stands, None, ScanResult(len(points), fit.overlap, 6, "lost", searched)
        if fit.known < LITTLE:
            return start if bridge is None else bridge, None, ScanResult(len(points), fit.overlap, 6, state, searched)
        if unheld and bridge is None and len(self.missed) < 3:
            # nobody knows yet how it moves: rest is believed where the scan fits there as well
            points = self._unbent(raw, pose, time)[chosen]
            if self.levels[-1].fit(points, *split_pose(pose), SCALE).overlap < LIKELY * fit.overlap:
                pose = free
        if state != "new space":
            self.overlaps.append(fit.overlap)
            self.qualities.append(fit.quality)
            self.coarse.append(
                top[-1].fit(points[evenly_spaced_rows(len(points), COARSE_POINTS)], *split_pose(pose), SCALE).overlap
            )
        return pose, fit, ScanResult(len(points), fit.overlap, unheld, state, searched)

    def _finish(self, raw: RawScan, chosen: Index, pose: Array, time: float) -> tuple[Array, Array, NormalEquations]:
        """Match on the finest level: pose, points of the scan where that pose says they were measured, fit."""
        for _ in range(MOST_DESKEWED):
            points = self._unbent(raw, pose, time)[chosen]
            before = pose
            pose, fit = self._descend(points, pose, self.levels[-1:])
            moved = se3.se3_log(se3.se3_between(before, pose))
            # a scan that is bent by a motion that is off pulls each pose a little, and always to the same side
            stood = np.linalg.norm(moved[:3]) < STILL[0] and np.linalg.norm(moved[3:]) < STILL[1]
            if raw.ages is None or raw.straight is not None or stood:
                break
        return pose, points, fit

    def _late(self, time: float) -> bool:
        """Is this scan later than scans use to be, so that nothing is known of the motion before it?"""
        usual = [b[0] - a[0] for a, b in zip(self.recent, list(self.recent)[1:])]
        return bool(usual) and time - self.time > LATE * float(np.median(usual))

    def _likely(self, overlap: float, predicted: Array, start: Array) -> bool:
        if len(self.coarse) < 3 or overlap < LIKELY * np.median(self.coarse):
            return False
        off = se3.se3_log(se3.se3_between(predicted, start))
        return bool(np.linalg.norm(off[:3]) < NEAR[0] and np.linalg.norm(off[3:]) < NEAR[1])

    def _descend(self, points: Array, pose: Array, levels: list[CellMap]) -> tuple[Array, NormalEquations]:
        """Gauss–Newton on one level after the other; on coarse ones the start stands along what no surface holds."""
        fit = None
        for level in levels:
            R, t = split_pose(pose.copy())
            if level is self.levels[-1]:
                prior = COARSE + self._coarser(points, R, t)
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
        """Information ``(6, 6)`` that the level above the finest has of points that the finest does not know."""
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
            scores = self.levels[0].scores(few, tries, t)
            for k in np.argsort(-scores, kind="stable")[:best]:
                start = np.concatenate([t, se3.matrix_to_quat(tries[k])])
                pose, fit = self._descend(points, start, levels)
                out.append((fit.overlap, pose))
        return out

    def _hold(self, pose: Array, predicted: Array, fit: NormalEquations, least: int = 0) -> tuple[Array, int]:
        """Take the prediction along directions that no surface holds, ``least`` of them or more; and their number."""
        P = observable_projection(fit.H, fit.every, least)
        unheld = 6 - round(float(np.trace(P)))
        if unheld:
            xi = P @ np.asarray(se3.se3_log(se3.se3_between(predicted, pose)))
            pose = np.asarray(se3.se3_compose(predicted, se3.se3_exp(xi)))
        return pose, unheld


def _far(predicted: Array, pose: Array, spread: Array) -> bool:
    """Is a pose farther from the prediction than that may be off?"""
    off = se3.se3_log(se3.se3_between(predicted, pose))
    turn, shift = (FAR * np.sqrt(np.trace(block)) for block in (spread[:3, :3], spread[3:, 3:]))
    return bool(np.linalg.norm(off[:3]) > NEAR[0] + turn or np.linalg.norm(off[3:]) > NEAR[1] + shift)


def observable_projection(H: Array, every: Array, least: int = 0) -> Array:
    """Projection ``(6, 6)`` of motions onto the directions that surfaces hold.

    Parameters
    ----------
    H : (6, 6)
        Information of a scan.
    every : (6, 6)
        What the same points would say with surfaces turned anyhow.
    least : int
        Number of the weakest directions that are left out anyhow.
    """
    values, V, B = _directions(H, every)
    U = V[:, max(int(np.sum(values <= PRETENDED)), least) :]
    return np.asarray(U @ U.T @ B)


def observable_gradient(H: Array, every: Array, least: int = 0) -> Array:
    """What ``(6, 6)`` takes a gradient to that part of it that is not pretended by noise of the normals.

    Nothing is left of it along the ``least`` weakest directions.
    """
    values, V, B = _directions(H, every)
    share = np.maximum(1.0 - PRETENDED / np.maximum(values, 1e-9), 0.0)
    share[:least] = 0.0
    return np.asarray(B @ (V * share) @ V.T)


def _directions(H: Array, every: Array) -> tuple[Array, Array, Array]:
    every = 1.01 * every + np.eye(6)
    B = NORMAL_SIGMA**2 * (every - H) + 1e-9 * every
    return *direction_strengths(H, every, NORMAL_SIGMA), B


def split_pose(pose: Array) -> tuple[Array, Array]:
    """Rotation ``(3, 3)`` and translation ``(3,)`` of a pose ``(7,)``."""
    return np.ascontiguousarray(se3.quat_to_matrix(pose[3:])), np.ascontiguousarray(pose[:3])


def _rotations(vectors: Array) -> npt.NDArray[np.float64]:
    return np.ascontiguousarray(se3.quat_to_matrix(se3.so3_exp(vectors)))
