"""IMU prediction of the motion from scan to scan and within a scan, for initial guesses and deskewing.

Preintegrated rates and forces give rotation and velocity change between two scans, except for gyro bias, velocity and
gravity. These three are estimated from the matched poses: the bias from the rotation difference, velocity and gravity
from a fit to the positions of the last seconds. In the body frame at the last scan, at time τ since::

    R(τ) = ΔR(τ)        p(τ) = v τ + ½ g τ² + Δp(τ)

It adds no information to a pose covariance: it gives initial guesses and deskews points. It is used only while it
predicts rotations within a few milliradians, or far better than constant velocity, so that wrong axes, stamps or units
do no harm.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu

USUAL = 20
"""Number of readings for the estimate of the sampling interval."""
WINDOW = 5.0
"""Length of the window of positions for a fit [s]."""
LONGEST = 3.0
"""Longest prediction after the last matched scan [s]."""
FEWEST = 5
"""Least number of scans for the comparison with constant velocity."""
COMPARED = 20
"""Most scans for the comparison."""
CLEARLY = 0.25
"""Largest ratio of the squared rotation errors of IMU and constant velocity, to count as far better."""
PLACED = 0.01
"""σ of a matched position [m] …"""
TURNED = 2e-3
"""… and of the rotation between two matched poses [rad]."""
FASTEST = 3.0
"""Prior σ of the velocity [m/s]."""
MOSTLY = 0.8
"""Least share of scans with a gravity fit, for gravity along a path."""
FARTHEST = 5.0
"""A match is rejected if it is farther from the IMU prediction than this many σ (or median distances of matches) plus …
"""
MISSED_FORCE = 0.5
"""… the effect of this acceleration error [m/s²]: a lever arm error of 0.1 m at 2 rad/s gives 0.4 m/s²."""
ON_ITS_SIDE = np.deg2rad(60.0)
"""Pitch above which roll is ill-defined."""
GRAVITY_SIGMA = (1.0, 0.2)
"""σ of gravity by the mean force at first, and by the previous fit later [m/s²]."""


@dataclass(frozen=True, slots=True)
class InertialMotion:
    """Preintegrated motion from readings, relative to the body at an anchor time.

    Parameters
    ----------
    seconds : (m,)
        Since the anchor; negative before it.
    q : (m, 4)
        ΔR.
    v, p : (m, 3)
        Δv, Δp.
    """

    seconds: Array
    q: Array
    v: Array
    p: Array

    def poses(self, velocity: Array, gravity: Array) -> Array:
        """``T_anchor_body`` ``(m, 7)`` for a velocity and a gravity, both in the body frame at the anchor."""
        t = self.seconds[:, None]
        return np.concatenate([t * velocity + 0.5 * t**2 * gravity + self.p, self.q], axis=1)


class ImuReadings:
    """Readings of an IMU, rotated to the base frame."""

    def __init__(self, imu: Imu) -> None:
        self.noise = imu.noise
        self.lever = imu.T_base_imu[:3]
        self.times, self.rate, self.force = _turned(imu)
        self.usual = float(np.median(np.diff(self.times[:USUAL]))) if len(self.times) > 1 else 0.0
        self.pause = max(0.1, 5.0 * self.usual)

    def more(self, imu: Imu, since: float) -> None:
        """Append later readings; those before ``since`` [s] are no longer needed."""
        a = int(np.searchsorted(self.times, since))
        t, w, f = _turned(imu)
        self.times = np.concatenate([self.times[a:], t])
        self.rate, self.force = np.concatenate([self.rate[a:], w]), np.concatenate([self.force[a:], f])

    def motion(self, anchor: float, at: Array, bias: Array) -> InertialMotion | None:
        """Preintegrated motion at times ``(m,)``, relative to the body at ``anchor``; None: readings are missing."""
        first, last = min(anchor, float(at.min())), max(anchor, float(at.max()))
        t = self.times
        # the first and the last reading may be extrapolated by half an interval and more
        if len(t) < 2 or first < t[0] - 1.5 * self.usual or last > t[-1] + 1.5 * self.usual:
            return None
        a, b = int(np.searchsorted(t, first, side="right")), int(np.searchsorted(t, last, side="left"))
        some = slice(max(a - 1, 0), b + 1)
        if np.max(np.diff(t[some]), initial=0.0) > self.pause:
            return None
        knots = np.unique(np.concatenate([t[a:b], at, [anchor]]))
        rate = np.stack([np.interp(knots, t[some], x) for x in self.rate[some].T], axis=1) - bias
        force = np.stack([np.interp(knots, t[some], x) for x in self._at_base(some).T], axis=1)
        dt = np.diff(knots)[:, None]
        turn = 0.5 * (rate[1:] + rate[:-1]) * dt
        q = cumulative_products(se3.so3_exp(turn))
        # mean force, rotated by the attitude in the middle of the interval
        f = se3.quat_rotate(se3.quat_multiply(q[:-1], se3.so3_exp(0.5 * turn)), 0.5 * (force[1:] + force[:-1]))
        v = np.concatenate([np.zeros((1, 3)), np.cumsum(f * dt, axis=0)])
        p = np.concatenate([np.zeros((1, 3)), np.cumsum(v[:-1] * dt + 0.5 * f * dt**2, axis=0)])
        j, k = int(np.searchsorted(knots, anchor)), np.searchsorted(knots, at)
        back = q[j] * [-1.0, -1.0, -1.0, 1.0]
        since = (knots[k] - knots[j])[:, None]
        return InertialMotion(
            since[:, 0],
            se3.quat_multiply(back, q[k]),
            se3.quat_rotate(back, v[k] - v[j]),
            se3.quat_rotate(back, p[k] - p[j] - v[j] * since),
        )

    def _at_base(self, some: slice) -> Array:
        """Specific force at the base: without the accelerations of the lever arm."""
        force, rate = self.force[some], self.rate[some]
        if not np.any(self.lever) or len(rate) < 2:
            return force
        turning = np.gradient(rate, self.times[some], axis=0)
        return np.asarray(force - np.cross(turning, self.lever) - np.cross(rate, np.cross(rate, self.lever)))

    def doubt(self, seconds: Array, bias_sigma: float) -> Array:
        """Variance ``(m,)`` [m²] of a fitted position at times from the anchor, by match and IMU noise."""
        s, n = np.abs(seconds), self.noise
        turned = (GRAVITY * n.gyro) ** 2 * s**5 / 20.0 + (GRAVITY * bias_sigma * s**3 / 6.0) ** 2
        return np.asarray(PLACED**2 + turned + n.accelerometer**2 * s**3 / 3.0)


def _turned(imu: Imu) -> tuple[Array, Array, Array]:
    """Stamps, rates and forces in the axes of the base."""
    q = imu.T_base_imu[3:]
    return imu.times, se3.quat_rotate(q, imu.angular_rate), se3.quat_rotate(q, imu.specific_force)


def cumulative_products(turns: Array) -> Array:
    """Products ``(n + 1, 4)`` of the first 0, 1, 2 … of n rotations ``(n, 4)``."""
    q, step = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], turns]), 1
    while step < len(q):
        q = np.concatenate([q[:step], se3.quat_multiply(q[:-step], q[step:])])
        step *= 2
    return np.asarray(se3.quat_normalize(q))


def fit_velocity_gravity(
    motion: InertialMotion, positions: Array, variance: Array, gravity: Array, sigma: float
) -> tuple[Array, Array, Array]:
    """Least-squares velocity and gravity in the body frame at the anchor, from positions ``(m, 3)``.

    Parameters
    ----------
    motion : InertialMotion
        At the times of the positions.
    positions : (m, 3)
    variance : (m,)
    gravity : (3,)
        Prior, with σ ``sigma``.

    Returns
    -------
    velocity, gravity : (3,)
    covariance : (3, 3)
        Of position, velocity and gravity along any axis.
    """
    A = np.stack([np.ones_like(motion.seconds), motion.seconds, 0.5 * motion.seconds**2], axis=1)
    W = A / variance[:, None]
    N = A.T @ W + np.diag([0.0, FASTEST**-2, sigma**-2])
    b = W.T @ (positions - motion.p)
    b[2] += gravity / sigma**2
    C = np.linalg.inv(N)
    x = C @ b
    return np.asarray(x[1]), np.asarray(x[2]), np.asarray(C)


class InertialPredictor:
    """Estimate gyro bias, velocity and gravity from matched scans, and predict motions.

    Parameters
    ----------
    trusted : bool
        Use the IMU whatever the scans show, until this is set to False.

    Attributes
    ----------
    bias : (3,)
        Of the gyro [rad/s], base frame.
    velocity, gravity : (3,)
        In the body frame at the last matched scan [m/s], [m/s²].
    """

    def __init__(self, imu: Imu, *, trusted: bool = False) -> None:
        self.readings, self.trusted = ImuReadings(imu), trusted
        n = imu.noise
        self._bias_var = max(n.gyro_bias, 1e-6) ** 2
        self.bias, self.bias_var = np.zeros(3), self._bias_var
        self.velocity, self.gravity = np.zeros(3), np.zeros(3)
        self.cov = np.diag([0.0, FASTEST**2, GRAVITY_SIGMA[0] ** 2])
        self.kept: deque[tuple[float, Array]] = deque()
        self.missed: deque[tuple[float, float]] = deque(maxlen=COMPARED)
        self.shifts: deque[float] = deque(maxlen=COMPARED)
        self.known = False
        self._up: Array | None = None

    @property
    def up(self) -> Array | None:
        """Unit vector ``(3,)`` in the frame of the path, latest estimate; None: not available."""
        return self._up if self.believed else None

    @property
    def believed(self) -> bool:
        """Does it predict rotations as well as scans, or far better than constant velocity?"""
        if self.trusted:
            return True
        if len(self.missed) < FEWEST:
            return False
        own, even = np.median(self.missed, axis=0)  # the median, because the first matches of a map may be poor
        return bool(own <= (3.0 * TURNED) ** 2 or own <= CLEARLY * even)

    def ahead(self, time: float) -> Array | None:
        """``T_first_body`` ``(7,)`` at a time after the last matched scan; None: not available."""
        if not (self.believed and self.known) or not 0.0 < time - self.kept[-1][0] <= LONGEST:
            return None
        last, pose = self.kept[-1]
        step = self.readings.motion(last, np.array([time]), self.bias)
        return None if step is None else np.asarray(se3.se3_compose(pose, step.poses(self.velocity, self.gravity)[0]))

    def reach(self, time: float) -> float:
        """Largest accepted distance of a match from :meth:`ahead` [m]: several σ plus an acceleration error.

        If most matches are farther away, the forces are assumed wrong, so the median distance replaces σ.
        """
        dt = time - self.kept[-1][0]
        moved = np.array([0.0, dt, 0.5 * dt**2])
        own = self.readings.doubt(np.array([dt]), float(np.sqrt(self.bias_var)))[0]
        sigma = np.sqrt(3.0 * (own + moved @ self.cov @ moved))
        return FARTHEST * max(float(sigma), float(np.median(self.shifts or 0.0))) + 0.5 * MISSED_FORCE * dt**2

    def within(self, time: float, ages: Array) -> Array | None:
        """``T_now_then`` ``(m, 7)`` of the body at ``time`` and ``ages`` ``(m,)`` [s] before; None: not available."""
        if not (self.believed and self.known and len(ages)) or not 0.0 <= time - self.kept[-1][0] <= LONGEST:
            return None
        last = self.kept[-1][0]
        t = self.readings.times
        # readings are interpolated linearly, and so are the motions between them
        knots = time - np.array([ages.max(), ages.min()])
        at = np.concatenate([knots[:1], t[(t > knots[0]) & (t < knots[1])], knots[1:]])
        motion = self.readings.motion(last, np.append(at, time), self.bias)
        if motion is None:
            return None
        T = motion.poses(self.velocity, self.gravity)
        T = se3.se3_between(np.broadcast_to(T[-1], T[:-1].shape), T[:-1])
        xi = np.concatenate([se3.so3_log(T[:, 3:]), T[:, :3]], axis=1)
        x = np.stack([np.interp(time - ages, at, column) for column in xi.T], axis=1)
        return np.concatenate([x[:, 3:], se3.so3_exp(x[:, :3])], axis=1)

    def unsure(self, age: float) -> tuple[float, float]:
        """Variance by axis, rotation and translation, of the pose error by deskewing with a mean age ``age``.

        A scan may be stamped at its begin: points are measured later, and their ages are negative.
        """
        n, age = self.readings.noise, abs(age)
        turn2 = n.gyro**2 * 2.0 * age / 3.0 + self.bias_var * age**2
        return float(turn2), float(self.cov[1, 1] * age**2)

    def learn(self, time: float, pose: Array, even: Array) -> None:
        """Update with a scan matched at ``pose``; constant velocity predicted ``even`` (both ``T_first_body``)."""
        if self.kept and time > self.kept[-1][0]:
            before, last = self.kept[-1]
            motion = self.readings.motion(before, np.array([time]), self.bias)
            if motion is None:
                self.forget()
            else:
                self._compare(time - before, se3.se3_between(last, pose), motion, se3.se3_between(last, even))
        elif self.kept:
            return  # same time stamp
        self.kept.append((time, pose))
        while time - self.kept[0][0] > WINDOW:
            self.kept.popleft()
        self._place()

    @property
    def rehearsed(self) -> bool:
        """Is enough estimated to start again from the first scan?"""
        return self.believed and self.known and self.kept[-1][0] - self.kept[0][0] >= 0.6 * WINDOW

    def rewind(self) -> None:
        """Go back to the first scan of the window; estimates are kept as the initial guess."""
        if self.known:
            self._place(0)
            self.bias_var = self._bias_var
            first = self.kept[0]
            self.kept.clear()
            self.kept.append(first)

    def forget(self) -> None:
        """Discard the matched poses, because a new map begins."""
        self.kept.clear()
        self.known = False

    def _compare(self, dt: float, made: Array, motion: InertialMotion, even: Array) -> None:
        """Kalman update of the gyro bias by a matched rotation, and comparison of the rotation errors."""
        off = np.asarray(se3.so3_log(se3.quat_multiply(made[3:] * [-1.0, -1.0, -1.0, 1.0], motion.q[0])))
        worse = np.asarray(se3.so3_log(se3.quat_multiply(made[3:] * [-1.0, -1.0, -1.0, 1.0], even[3:])))
        self.missed.append((float(off @ off), float(worse @ worse)))
        n = self.readings.noise
        self.bias_var += n.gyro_walk**2 * dt
        # rotations of distorted scans are noisier
        turned = max(TURNED**2, float(np.median(self.missed, axis=0)[0]) / 3.0)
        noise = (turned + n.gyro**2 * dt) / dt**2
        gain = self.bias_var / (self.bias_var + noise)
        self.bias = self.bias + gain * off / dt
        self.bias_var *= 1.0 - gain

    def _place(self, k: int = -1) -> None:
        """Velocity and gravity in the body frame at scan k of the window (default: the last), from all positions."""
        anchor, pose = self.kept[k]
        at = np.array([t for t, _ in self.kept])
        motion = self.readings.motion(anchor, at, self.bias)
        if motion is None or len(at) < (2 if self.known else 3):
            self.known = False
            return
        if self.known:
            # the previous fit, rotated from the body frame of the last scan it used
            then = self.kept[-1 if k == 0 else -2][1]
            turn = se3.se3_between(pose, then)[3:]
            guess, sigma = se3.quat_rotate(turn, self.gravity), GRAVITY_SIGMA[1]
        else:
            # the mean specific force, neglecting the acceleration of the body
            guess, sigma = -motion.v[0] / motion.seconds[0], GRAVITY_SIGMA[0]
        there = se3.se3_between(np.broadcast_to(pose, (len(at), 7)), np.array([p for _, p in self.kept]))[:, :3]
        variance = self.readings.doubt(motion.seconds, float(np.sqrt(self.bias_var)))
        self.velocity, self.gravity, self.cov = fit_velocity_gravity(motion, there, variance, guess, sigma)
        self.known = True
        self._up = se3.quat_rotate(pose[3:], -self.gravity / np.linalg.norm(self.gravity))


def align_with_gravity(pose: Array, up: Array | None) -> Array:
    """Align a pose ``(7,)`` with gravity, if ``up`` ``(3,)`` is known in its frame: position and heading are kept."""
    if up is None:
        return pose
    x, y, z = se3.quat_rotate(pose[3:] * [-1.0, -1.0, -1.0, 1.0], up)
    roll, pitch = np.arctan2(y, z), -np.arcsin(np.clip(x, -1.0, 1.0))
    leaning = se3.quat_multiply(se3.so3_exp(np.array([0.0, pitch, 0.0])), se3.so3_exp(np.array([roll, 0.0, 0.0])))
    return np.concatenate([pose[:3], se3.quat_multiply(pose[3:], leaning * [-1.0, -1.0, -1.0, 1.0])])


@dataclass(frozen=True, slots=True)
class PathGravity:
    """Gravity along a path.

    Parameters
    ----------
    times : (n,)
    up : (n, 3)
        In the frame of the path, at these times.
    sigma : float
        Of roll and pitch [rad].
    time : float
        Correlation time of their errors [s].
    """

    times: Array
    up: Array
    sigma: float
    time: float

    def at(self, times: Array, poses: Array) -> Array:
        """Roll and pitch ``(m, 2)`` of poses ``(m, 7)`` of the path [rad]."""
        up = np.stack([np.interp(times, self.times, x) for x in self.up.T], axis=1)
        x, y, z = se3.quat_rotate(poses[:, 3:] * [-1.0, -1.0, -1.0, 1.0], up / np.linalg.norm(up, axis=1)[:, None]).T
        return np.stack([np.arctan2(y, z), -np.arcsin(np.clip(x, -1.0, 1.0))], axis=1)


def gravity_along_path(inertial: InertialPredictor, times: Array, poses: Array) -> PathGravity | None:
    """Gravity along a path, from positions and readings half a window before and after each scan.

    Parameters
    ----------
    inertial : InertialPredictor
        After it processed the path.
    times : (n,)
        Of matched scans.
    poses : (n, 7)

    Returns
    -------
    PathGravity or None
        None: the IMU is not reliable, too few scans have a fit, or the pitch is above ``ON_ITS_SIDE``, where roll is
        ill-defined.
    """
    readings, noise = inertial.readings, inertial.readings.noise
    if not inertial.believed:
        return None
    at: list[float] = []
    ups, variances = [], []
    for k, t in enumerate(times.tolist()):
        a, b = np.searchsorted(times, [t - 0.5 * WINDOW, t + 0.5 * WINDOW], side="left")
        if b - a < 3 or (at and t <= at[-1]):
            continue
        some = np.arange(a, b)
        motion = readings.motion(t, times[some], inertial.bias)
        if motion is None:
            continue
        span = motion.seconds[-1] - motion.seconds[0]
        guess = -(motion.v[-1] - motion.v[0]) / span
        there = se3.se3_between(np.broadcast_to(poses[k], (len(some), 7)), poses[some])[:, :3]
        variance = readings.doubt(motion.seconds, float(np.sqrt(inertial.bias_var)))
        _, gravity, C = fit_velocity_gravity(motion, there, variance, guess, GRAVITY_SIGMA[0])
        at.append(t)
        ups.append(se3.quat_rotate(poses[k, 3:], -gravity / np.linalg.norm(gravity)))
        variances.append(C[2, 2] + noise.accelerometer**2 / span)
    if len(at) < MOSTLY * len(times):
        return None
    constant = noise.accelerometer_bias
    sigma = float(np.sqrt(np.median(variances) + constant**2)) / GRAVITY
    out = PathGravity(np.array(at), np.array(ups), sigma, 0.5 * WINDOW)
    return None if np.abs(out.at(times, poses)[:, 1]).max() > ON_ITS_SIDE else out
