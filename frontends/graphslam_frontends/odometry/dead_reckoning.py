"""3-D dead reckoning from an IMU and wheels, with a covariance that includes systematic errors.

Heading is from the gyro; roll and pitch are from the attitude of the IMU or, without one, from gyro and gravity by a
complementary filter; distance is from the wheels. The base moves along its x axis.

Gaps in the records are bridged up to a limit, with a growing covariance, and counted; longer gaps are an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.errors import DataError, GeometryError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.log import DropCounter
from graphslam.core.records import Odometry, VelocityControls, check_times
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.dead_reckoning_kernels import complementary_kernel
from graphslam_frontends.odometry.gaps import Gaps, find_gaps
from graphslam_frontends.odometry.inertial_biases import (
    CONSTANT,
    FADING,
    GYRO,
    POS,
    PSI,
    SCALE,
    STATES,
    DeadReckoningErrorModel,
    InertialBiases,
    euler_quat,
    tangent_of_state,
)
from graphslam_frontends.odometry.motion_prior import MotionPrior

__all__ = ["DeadReckoningNoise", "integrate_imu_and_wheels"]

_STEEPEST = float(np.deg2rad(80.0))  # heading is undefined near 90°
FILTER_TIME = 5.0
"""Time constant of the complementary filter, if the IMU has no attitude [s]."""
GAP_SPEED = 0.5
"""Least σ of the speed in a gap of the wheels, constant in the gap [m/s]; larger if the speeds of the log deviate more
from the last speed before the gap."""
GAP_RATE = 0.3
"""σ of the yaw rate in a gap of the IMU, constant in the gap [rad/s], if the wheels do not measure it."""
GAP_TILT = 0.1
"""σ of roll and pitch in a gap of the IMU [rad]."""
AT_ONCE = 1024
"""Fine steps whose transitions are computed and kept at once; more would need too much memory."""
FLOOR_ANGLE = 1e-5
"""Least σ of the angles of an increment [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoningNoise:
    """Noise parameters of dead reckoning that are not in the IMU stream."""

    wheel: float = 0.02
    """σ of one speed reading, held until the next [m/s]."""
    wheel_scale: float = 0.005
    """σ of the scale of the wheels, constant."""
    lateral: float = 0.002
    """σ of side slip after one metre, growing with the root of the distance [m/√m]."""
    vertical: float = 0.002
    """The same for vertical motion [m/√m]."""
    attitude_bias: float = float(np.deg2rad(0.1))
    """Constant part of the σ of the IMU's roll and pitch [rad]; the rest is time-correlated."""
    floor_position: float = 1e-4
    """Least σ of the position of an increment [m]."""

    def __post_init__(self) -> None:
        check_options(self, "dead reckoning: ", {"> 0": "floor_position", "≥ 0": "*"})


def integrate_imu_and_wheels(
    imu: Imu,
    wheels: VelocityControls,
    times: npt.ArrayLike,
    noise: DeadReckoningNoise | None = None,
    *,
    since: float | None = None,
    longest: float = 20.0,
    where: str = "log",
    drops: DropCounter | None = None,
) -> MotionPrior:
    """Dead-reckon a base at ``times``.

    Parameters
    ----------
    imu : Imu
        Has its own noise. The rotation of T_base_imu is applied to rates and attitude; its lever arm only if gravity is
        estimated from the accelerometer.
    wheels : VelocityControls
        Only the speed is used.
    times : (n,)
        Strictly increasing, within the IMU records; none before the first speed. The last speed is held.
    since : float, optional
        Start of the path and its frame [s]; default ``times[0]``, and not later.
    longest : float
        Longest gap in the records that is bridged [s]. In a gap of the wheels the last speed is held; σ is the RMS
        difference of the speeds of the log from it. In a gap of the IMU the yaw rate of the wheels is used if it agrees
        with the gyro elsewhere, with the RMS difference as σ; otherwise the rate is interpolated.
    where : str
        Name of the log, for messages.
    drops : DropCounter, optional
        Counts bridged gaps.
    """
    noise = noise or DeadReckoningNoise()
    t, begin = _checked_span(imu, wheels, times, since, where)
    span = (begin, float(t[-1]))
    imu_gaps = find_gaps(imu.times, *span, longest, where=f"{where}/imu", drops=drops)
    wheel_gaps = find_gaps(wheels.times, *span, longest, where=f"{where}/wheels", drops=drops)

    stamps = np.concatenate([imu.times, wheels.times])
    knots = np.union1d(stamps[(stamps > begin) & (stamps < t[-1])], np.append(t, begin))
    middle = 0.5 * (knots[1:] + knots[:-1])
    active = np.searchsorted(wheels.times, middle, side="right") - 1
    speed = wheels.speed[active]
    to_base = se3.quat_rotate(imu.T_base_imu[3:], imu.angular_rate)
    up, error_model = _up(imu, wheels, to_base, noise)
    tilt = _tilt(_interpolate(knots, imu.times, up))
    if np.abs(tilt[:, 1]).max() > _STEEPEST:
        raise GeometryError(
            f"base stands on a wall at {knots[np.argmax(np.abs(tilt[:, 1]))]:.3f} s",
            where=f"{where}/imu",
            got=f"pitch {np.rad2deg(np.abs(tilt[:, 1]).max()):.0f}°",
            wanted="a ground vehicle; is T_base_imu right?",
        )
    rates = _interpolate(knots, imu.times, to_base)
    gap_rate = GAP_RATE
    wheel_turn = _turn_of_wheels(imu.times, to_base[:, 2], wheels, imu_gaps) if len(imu_gaps.begin) else None
    if wheel_turn is not None:
        inside = imu_gaps.length_at(knots) > 0
        latest = np.searchsorted(wheels.times, knots[inside], side="right") - 1
        rates[inside, 2] = wheel_turn[0] * wheels.yaw_rate[latest]
        gap_rate = wheel_turn[1]
    fine = _fine_steps(knots, tilt, rates, speed)

    # variances per second of the white noise: heading, distance, and along the axes of the base
    held = np.append(np.diff(wheels.times), 0.0)[active]
    held = np.where(held > 0, held, fine.h)
    in_wheels, in_imu = wheel_gaps.length_at(middle), imu_gaps.length_at(middle)
    gap_speed = np.full(len(speed), GAP_SPEED)
    for k in np.flatnonzero(in_wheels):
        gap_speed[k] = max(GAP_SPEED, float(np.sqrt(np.mean((wheels.speed - speed[k]) ** 2))))
    fine.rates = np.column_stack(
        [
            imu.noise.gyro**2 * np.sum(fine.g**2, axis=1) + gap_rate**2 * in_imu,
            np.where(speed != 0.0, noise.wheel**2 * held, 0.0) + gap_speed**2 * in_wheels,
            noise.lateral**2 * np.abs(speed) + (GAP_TILT * speed) ** 2 * in_imu,
            noise.vertical**2 * np.abs(speed) + (GAP_TILT * speed) ** 2 * in_imu,
        ]
    )
    at = np.searchsorted(knots, t)
    F, Q = _transitions(fine, at, error_model)
    path = Trajectory(knots, fine.poses)
    poses = fine.poses[at]
    floor = np.repeat([FLOOR_ANGLE, noise.floor_position], 3)
    increments = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(t), 1))
    increments[1:] = se3.se3_between(poses[:-1], poses[1:])
    covariances = np.tile(np.diag(floor**2), (len(t), 1, 1))
    covariances[1:] += _white(poses, F, Q, error_model)
    return MotionPrior(
        odometry=Odometry(times=t, increments=increments, covariances=covariances),
        poses=poses,
        path=path,
        biases=InertialBiases(times=t, poses=poses, model=error_model, transitions=F, noises=Q, floor=floor),
        tilt=tilt[at],
        tilt_sigma=float(np.hypot(error_model.attitude, error_model.attitude_bias)),
        tilt_time=error_model.attitude_time,
        gaps=Gaps(np.concatenate([imu_gaps.begin, wheel_gaps.begin]), np.concatenate([imu_gaps.end, wheel_gaps.end])),
    )


def _checked_span(
    imu: Imu, wheels: VelocityControls, times: npt.ArrayLike, since: float | None, where: str
) -> tuple[Array, float]:
    """Times within the records, and the start of the path [s]."""
    t = check_times(times, where=where)
    for name, stream in (("imu", imu), ("wheels", wheels)):
        if len(stream.times) == 0:
            raise MissingDataError("stream is empty", where=f"{where}/{name}")
    if len(t) == 0:
        raise DataError("no time to dead-reckon at", where=where, wanted="at least one")
    least = max(imu.times[0], wheels.times[0])
    begin = float(t[0]) if since is None else float(since)
    if not (least <= begin <= t[0] and t[-1] <= imu.times[-1]):
        raise DataError(
            "times outside the records",
            where=where,
            got=f"[{begin:.3f}, {t[-1]:.3f}] s",
            wanted=f"[{least:.3f}, {imu.times[-1]:.3f}] s",
        )
    return t, begin


_TURN_WINDOW = 1.0
"""Averaging time for the comparison of wheels and gyro [s]."""


def _turn_of_wheels(times: Array, rate: Array, wheels: VelocityControls, gaps: Gaps) -> tuple[float, float] | None:
    """Scale from the yaw rate of the wheels to that of the gyro, and σ of the residual [rad/s]; None: not usable.

    Means over 1 s outside the gaps; wheels are usable if they explain 80 % of the variance of the gyro.
    """
    n = int((times[-1] - times[0]) // _TURN_WINDOW)
    if n < 10 or np.ptp(wheels.yaw_rate) == 0.0:
        return None
    edges = times[0] + _TURN_WINDOW * np.arange(n + 1)
    turn = [np.concatenate([[0.0], np.cumsum(r[:-1] * np.diff(t))]) for t, r in
            ((times, rate), (wheels.times, wheels.yaw_rate))]  # fmt: skip
    gyro = np.diff(np.interp(edges, times, turn[0])) / _TURN_WINDOW
    wheel = np.diff(np.interp(edges, wheels.times, turn[1])) / _TURN_WINDOW
    free = np.ones(n, dtype=np.bool_)
    for a, b in zip(gaps.begin, gaps.end):
        free &= (edges[1:] <= a) | (edges[:-1] >= b)
    free &= (edges[:-1] >= wheels.times[0]) & (edges[1:] <= wheels.times[-1])
    x, y = wheel[free], gyro[free]
    if len(x) < 10 or not np.any(x):
        return None
    slope = float(x @ y / (x @ x))
    left = float(np.mean((y - slope * x) ** 2))
    return None if left > 0.2 * float(np.mean(y**2)) else (slope, float(np.sqrt(left)))


def _interpolate(times: Array, stamps: Array, values: Array) -> Array:
    return np.column_stack([np.interp(times, stamps, v) for v in values.T])


def _tilt(up: Array) -> Array:
    """Roll and pitch ``(n, 2)`` from the up vector in the base ``(n, 3)``: up = (-sin p, sin r cos p, cos r cos p)."""
    u = up / np.linalg.norm(up, axis=1, keepdims=True)
    return np.column_stack([np.arctan2(u[:, 1], u[:, 2]), -np.arcsin(np.clip(u[:, 0], -1.0, 1.0))])


def _up(
    imu: Imu, wheels: VelocityControls, rate: Array, noise: DeadReckoningNoise
) -> tuple[Array, DeadReckoningErrorModel]:
    """Up vector in the base frame at the IMU records ``(n, 3)``, and the systematic errors; ``rate``: base frame."""
    n = imu.noise
    common: dict[str, Any] = {
        "gyro_bias": n.gyro_bias,
        "gyro_walk": n.gyro_walk,
        "wheel_scale": noise.wheel_scale,
        "epoch": float(imu.times[0]),
    }
    if imu.attitude is not None:
        r, p = imu.attitude.T
        up = np.column_stack([-np.sin(p), np.sin(r) * np.cos(p), np.cos(r) * np.cos(p)])
        lasts = min(noise.attitude_bias, n.attitude)
        error_model = DeadReckoningErrorModel(
            **common,
            attitude=float(np.sqrt(n.attitude**2 - lasts**2)),
            attitude_time=max(n.attitude_time, 1e-3),
            attitude_bias=lasts,
            attitude_walk=0.0,
        )
        return se3.quat_rotate(imu.T_base_imu[3:], up), error_model
    # gravity = specific force minus the acceleration of the base (forward and centripetal) and that of the lever arm
    lever = imu.T_base_imu[:3]
    force = se3.quat_rotate(imu.T_base_imu[3:], imu.specific_force)
    if len(imu.times) > 1:
        force = force - np.cross(np.gradient(rate, imu.times, axis=0), lever)
    force = force - np.cross(rate, np.cross(rate, lever))
    v = np.interp(imu.times, wheels.times, wheels.speed)
    forward = np.gradient(v, imu.times) if len(imu.times) > 1 else np.zeros_like(v)
    seen = force - np.column_stack([forward, v * rate[:, 2], -v * rate[:, 1]])
    length = np.linalg.norm(seen, axis=1, keepdims=True)
    if np.any(length < 0.1 * GRAVITY):
        k = int(np.argmin(length))
        raise DataError(
            f"no gravity in the specific force of record {k}", where="imu", got=float(length[k, 0]), wanted="about 9.8"
        )
    seen = seen / length
    # the filter is first run backwards over 3 time constants, for a good initial state
    m = int(np.searchsorted(imu.times, imu.times[0] + 3.0 * FILTER_TIME, side="right"))
    back, up = np.empty((m, 3)), np.empty_like(seen)
    complementary_kernel(-imu.times[:m][::-1], -rate[:m][::-1], seen[:m][::-1], FILTER_TIME, seen[m - 1], back)
    complementary_kernel(imu.times, rate, seen, FILTER_TIME, back[-1], up)
    # errors of the filter: gyro noise integrated over its time constant, accelerometer noise averaged over it; the
    # accelerometer bias is constant; the effect of the gyro bias is in the transition
    T = FILTER_TIME
    fading = n.gyro**2 * T / 2.0 + (n.accelerometer / GRAVITY) ** 2 / (2.0 * T) + (noise.wheel / (GRAVITY * T)) ** 2
    return up, DeadReckoningErrorModel(
        **common,
        attitude=float(np.sqrt(fading)),
        attitude_time=T,
        attitude_bias=n.accelerometer_bias / GRAVITY,
        attitude_walk=n.accelerometer_walk / GRAVITY,
        filtered=True,
    )


@dataclass(slots=True)
class _Fine:
    """Steps between neighbouring records ``(s, ...)`` and the poses ``(s + 1, 7)`` at their ends."""

    h: Array
    g: Array  # heading's rate per rate of the base
    g_tilt: Array  # heading's rate per error of roll and of pitch [1/s]
    moved: Array  # (s, 3)
    pitched: Array  # (s, 3) metres per radian of pitch
    axes: Array  # (s, 3, 3) of the base in the middle of the step
    turn: Array  # rate of the base about its z axis [rad/s]
    poses: Array
    rates: Array


def _fine_steps(knots: Array, tilt: Array, rate: Array, speed: Array) -> _Fine:
    """Poses at ``knots`` ``(s + 1,)`` from tilt ``(s + 1, 2)``, rates ``(s + 1, 3)`` and speeds ``(s,)``."""
    h = np.diff(knots)
    (roll, pitch), w = 0.5 * (tilt[1:] + tilt[:-1]).T, 0.5 * (rate[1:] + rate[:-1])
    zero = np.zeros_like(h)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    g = np.column_stack([zero, sr / cp, cr / cp])  # dψ/dt = (ω_y sin φ + ω_z cos φ) / cos θ
    turn = h * np.sum(g * w, axis=1)
    g_tilt = np.column_stack([(cr * w[:, 1] - sr * w[:, 2]) / cp, (sr * w[:, 1] + cr * w[:, 2]) * sp / cp**2])
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    psi = 0.5 * (heading[1:] + heading[:-1])
    chord = speed * h * np.sinc(turn / (2.0 * np.pi))  # an arc is longer than its chord: sin(x)/x at half the rotation
    moved = chord[:, None] * np.column_stack([np.cos(psi) * cp, np.sin(psi) * cp, -sp])
    pitched = chord[:, None] * np.column_stack([-np.cos(psi) * sp, -np.sin(psi) * sp, -cp])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    poses = np.concatenate([position, euler_quat(tilt[:, 0], tilt[:, 1], heading)], axis=1)
    axes = se3.quat_to_matrix(euler_quat(roll, pitch, psi))
    return _Fine(h, g, g_tilt, moved, pitched, axes, w[:, 2], poses, np.zeros((len(h), 4)))


def _transitions(fine: _Fine, at: npt.NDArray[np.intp], error_model: DeadReckoningErrorModel) -> tuple[Array, Array]:
    """Transition and noise ``(n, 12, 12)`` of the error state between the knots ``at`` ``(n,)``.

    All intervals advance together, one fine step of each at a time; a few fine steps are computed at once.
    """
    n = len(at)
    F, Q = np.tile(np.eye(STATES), (n, 1, 1)), np.zeros((n, STATES, STATES))
    counts = np.diff(at)
    few = _fine_transition(fine, np.arange(len(fine.h)), error_model) if len(fine.h) <= AT_ONCE else None
    for m in range(int(counts.max(initial=0))):
        live = np.flatnonzero(counts > m)
        i = at[live] + m
        A, N = _fine_transition(fine, i, error_model) if few is None else (few[0][i], few[1][i])
        F[live + 1] = A @ F[live + 1]
        Q[live + 1] = A @ Q[live + 1] @ np.swapaxes(A, -1, -2) + N
    return F, Q


def _fine_transition(fine: _Fine, i: npt.NDArray[np.intp], error_model: DeadReckoningErrorModel) -> tuple[Array, Array]:
    """Transition and noise ``(k, 12, 12)`` of the fine steps ``i`` ``(k,)``, first order about the middle."""
    h = fine.h[i]
    A, N = np.tile(np.eye(STATES), (len(i), 1, 1)), np.zeros((len(i), STATES, STATES))
    A[:, PSI, GYRO] = h[:, None] * fine.g[i]
    A[:, PSI, FADING] = A[:, PSI, CONSTANT] = h[:, None] * fine.g_tilt[i]
    turned = np.column_stack([-fine.moved[i, 1], fine.moved[i, 0], np.zeros(len(i))])  # e_z × moved
    # on average over the step, an error of the rate has half its final effect
    A[:, POS, 4:] = 0.5 * turned[:, :, None] * A[:, PSI, None, 4:]
    A[:, POS, PSI] = turned
    A[:, POS, SCALE] = fine.moved[i]
    A[:, POS, FADING.stop - 1] += fine.pitched[i]
    A[:, POS, CONSTANT.stop - 1] += fine.pitched[i]
    fade = np.exp(-h / error_model.attitude_time)
    A[:, 8, 8] = A[:, 9, 9] = fade
    if error_model.filtered:  # de/dt = β - e/T in the body frame, which rotates
        roll, pitch = FADING.start, FADING.start + 1
        A[:, roll, GYRO.start] = A[:, pitch, GYRO.start + 1] = h
        A[:, roll, pitch] = A[:, roll, CONSTANT.start + 1] = h * fine.turn[i]
        A[:, pitch, roll] = A[:, pitch, CONSTANT.start] = -h * fine.turn[i]
    N[:, PSI, PSI] = h * fine.rates[i, 0]
    R = fine.axes[i]
    N[:, POS, POS] = (R * (h[:, None] * fine.rates[i, 1:])[:, None, :]) @ np.swapaxes(R, -1, -2)
    j = np.arange(4, STATES)
    walk = np.array([error_model.gyro_walk**2] * 3 + [0.0] * 3 + [error_model.attitude_walk**2] * 2)
    N[:, j, j] = h[:, None] * walk
    N[:, 8, 8] = N[:, 9, 9] = error_model.attitude**2 * (1.0 - fade**2)
    return A, N


def _white(poses: Array, F: Array, Q: Array, error_model: DeadReckoningErrorModel) -> Array:
    """Covariances ``(n - 1, 6, 6)`` of increments from body to body, without systematic errors."""
    P = np.zeros((len(F) - 1, STATES + 2, STATES + 2))
    pick = np.vstack([np.eye(STATES), np.eye(STATES)[FADING]])[:, FADING]
    P[:] = error_model.attitude**2 * pick @ pick.T
    A = np.tile(np.eye(STATES + 2), (len(P), 1, 1))
    A[:, :STATES, :STATES] = F[1:]
    P = A @ P @ np.swapaxes(A, -1, -2)
    P[:, :STATES, :STATES] += Q[1:]
    G = tangent_of_state(poses[:-1], poses[1:], level_start=False, level_end=False)
    C = G @ P @ np.swapaxes(G, -1, -2)
    return 0.5 * (C + np.swapaxes(C, -1, -2))
