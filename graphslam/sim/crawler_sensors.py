"""Simulated measurements of the crawler's sensors along a true motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from scipy.signal import lfilter

from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.progress import Bar
from graphslam.core.random import SeedTree
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import VelocityControls
from graphslam.core.se3 import quat_multiply, quat_rotate, se3_transform
from graphslam.sim.crawler_config import CrawlerConfig, Pose
from graphslam.sim.drive import RouteMotion
from graphslam.sim.raycast import RayCaster

_BEAMS_AT_ONCE = 1 << 18
Nearer: TypeAlias = Callable[[int, Array, Array, Array], Array]


class PoseSource(Protocol):
    """A source of world poses at any time."""

    def poses(self, t: ArrayLike) -> Array:
        """``(n, 7)`` at times ``(n,)``."""
        ...


def scan_world(
    motion: RouteMotion,
    caster: RayCaster,
    config: CrawlerConfig,
    mount: Pose,
    seeds: SeedTree,
    *,
    progress: bool = False,
) -> RangeScans:
    """Scans of a spinning head: each beam starts from the pose of the robot at its own time.

    Parameters
    ----------
    mount : (7,)
        T_base_mount.
    progress : bool
        Show a progress bar on stderr.
    """
    c = config
    bearings = np.linspace(-0.5 * c.fan, 0.5 * c.fan, c.beams)
    n = int(np.floor((motion.duration - c.sweep_time) * c.scan_rate + 1e-9)) + 1
    times = np.arange(max(n, 0)) / c.scan_rate
    turn = 2.0 * np.pi * c.spin_rate
    scans = RangeScans(
        times=times,
        ranges=np.zeros((len(times), c.beams), np.float32),
        directions=np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(c.beams)]),
        beam_times=np.linspace(0.0, c.sweep_time, c.beams),
        max_range=c.max_range,
        sigma=c.range_sigma,
        T_base_mount=np.array(mount),
        spin=np.mod(turn * times, 2.0 * np.pi),
        spin_rate=np.full(len(times), turn),
    )
    return cast_scans(scans, motion, caster, config, seeds, progress=progress)


def cast_scans(
    scans: RangeScans,
    motion: PoseSource,
    caster: RayCaster,
    config: CrawlerConfig,
    seeds: SeedTree,
    *,
    nearer: Nearer | None = None,
    progress: bool = False,
) -> RangeScans:
    """Scans with simulated ranges, including the noise, losses and limits of a configuration.

    Parameters
    ----------
    scans : RangeScans
        Stamps, directions and angles of the head; its ranges are ignored.
    nearer : callable, optional
        Given the first scan of a part, its rays ``(k · m, 6)``, their times and their exact ranges, both ``(k · m,)``
        (NaN: no hit), returns the ranges with moving objects in front taken into account.
    progress : bool
        Show a progress bar on stderr.
    """
    c, n, m = config, len(scans.times), len(scans.beam_times)
    exact = np.empty((n, m))
    chunk = max(_BEAMS_AT_ONCE // m, 1)
    with Bar(total=n, name="casting beams", unit="scan", shown=progress) as bar:
        for k in range(0, n, chunk):
            part = slice(k, min(k + chunk, n))
            rays = scan_rays(scans, motion, part)
            found = caster.ranges(rays)
            if nearer is not None:
                found = nearer(k, rays, (scans.times[part, None] + scans.beam_times).ravel(), found)
            exact[part] = found.reshape(-1, m)
            bar.update(part.stop - part.start)

    rng = seeds.generator()
    measured = exact + c.noise_scale * c.range_sigma * rng.standard_normal(exact.shape)
    lost = rng.random(exact.shape) < c.drop_out
    nothing = np.isnan(exact) | (measured >= c.max_range)
    far = np.float32(c.max_range)
    far = far if float(far) >= c.max_range else np.nextafter(far, np.float32(np.inf))  # not less by rounding
    ranges = np.where(nothing, far, measured.astype(np.float32))
    ranges[lost | (~nothing & (measured < c.min_range))] = np.nan
    return dataclasses.replace(scans, ranges=ranges)


def scan_rays(scans: RangeScans, motion: PoseSource, part: slice = slice(None)) -> Array:
    """Beams of scans in the world ``(k · m, 6)``: origins [m] and unit directions, each at its own time."""
    origin, directions = scans.head_rays(part)
    flat = directions.reshape(-1, 3)
    poses = motion.poses((scans.times[part, None] + scans.beam_times).ravel())
    begin = se3_transform(poses, np.broadcast_to(origin, flat.shape))
    return np.hstack([begin, quat_rotate(poses[:, 3:], flat)])


def measure_imu(
    motion: RouteMotion, config: CrawlerConfig, yaw_bias: float, nominal_bias: float, seeds: SeedTree
) -> tuple[Imu, dict[str, list[float]]]:
    """Rates, forces, roll and pitch, with bias, walk and noise.

    Parameters
    ----------
    yaw_bias : float
        Constant bias of the rate about the unit's z axis [rad/s].
    nominal_bias : float
        Nominal σ of it, as in a data sheet [rad/s].

    Returns
    -------
    dict
        The realised constant biases.
    """
    c = config
    n = int(np.floor(motion.duration * c.imu_rate + 1e-9)) + 1
    t = np.arange(n) / c.imu_rate
    rate, force, attitude = true_inertia(motion, t, c.imu_mount)

    scale, dt = c.noise_scale, 1.0 / c.imu_rate
    draw = {k: seeds.child(k).generator() for k in ("bias", "gyro", "accelerometer", "attitude")}
    gyro_bias = scale * c.gyro_bias_across * draw["bias"].standard_normal(3)
    gyro_bias[2] = scale * yaw_bias
    force_bias = scale * c.accelerometer_bias * draw["bias"].standard_normal(3)
    tilt_bias = scale * c.attitude_bias * draw["bias"].standard_normal(2)

    def errors(rng: np.random.Generator, density: float, walk: float) -> Array:
        steps = np.sqrt(dt) * walk * rng.standard_normal((n, 3))
        steps[0] = 0.0
        return scale * (density * np.sqrt(c.imu_rate) * rng.standard_normal((n, 3)) + np.cumsum(steps, axis=0))

    imu = Imu(
        times=t,
        angular_rate=rate + gyro_bias + errors(draw["gyro"], c.gyro, c.gyro_walk),
        specific_force=force + force_bias + errors(draw["accelerometer"], c.accelerometer, c.accelerometer_walk),
        attitude=attitude
        + tilt_bias
        + scale * ornstein_uhlenbeck(draw["attitude"], (n, 2), c.attitude_sigma, c.attitude_time, dt),
        noise=ImuNoise(
            gyro=c.gyro,
            gyro_bias=max(nominal_bias, c.gyro_bias_across),
            gyro_walk=c.gyro_walk,
            accelerometer=c.accelerometer,
            accelerometer_bias=c.accelerometer_bias,
            accelerometer_walk=c.accelerometer_walk,
            attitude=float(np.hypot(c.attitude_sigma, c.attitude_bias)),
            attitude_time=c.attitude_time,
        ),
        T_base_imu=np.array(c.imu_mount),
    )
    drawn = {"gyro_bias": gyro_bias, "accelerometer_bias": force_bias, "attitude_bias": tilt_bias}
    return imu, {k: v.tolist() for k, v in drawn.items()}


def true_inertia(motion: RouteMotion, times: Array, mount: ArrayLike) -> tuple[Array, Array, Array]:
    """Angular rate ``(n, 3)`` [rad/s], specific force ``(n, 3)`` [m/s²], roll and pitch ``(n, 2)`` of a unit.

    Parameters
    ----------
    times : (n,)
    mount : (7,)
        T_base_imu.
    """
    T = np.asarray(mount, dtype=np.float64)
    lever, to_unit = T[:3], T[3:] * [-1.0, -1.0, -1.0, 1.0]
    q = motion.poses(times)[:, 3:]
    omega, alpha = motion.rotation(times)
    # of the point at the lever, base frame: a + ω' × l + ω × (ω × l); the unit also measures -g
    world = motion.accelerations(times) + [0.0, 0.0, GRAVITY]
    felt = quat_rotate(q * [-1.0, -1.0, -1.0, 1.0], world)
    felt = felt + np.cross(alpha, lever) + np.cross(omega, np.cross(omega, lever))
    return quat_rotate(to_unit, omega), quat_rotate(to_unit, felt), roll_pitch_angles(quat_multiply(q, T[3:]))


def roll_pitch_angles(q: Array) -> Array:
    """Roll and pitch ``(n, 2)`` [rad] of ``R_z(yaw) R_y(pitch) R_x(roll)`` from unit quaternions ``(n, 4)``."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
        ],
        -1,
    )


def ornstein_uhlenbeck(rng: np.random.Generator, shape: tuple[int, int], sigma: float, time: float, dt: float) -> Array:
    """Stationary errors ``shape`` along the first axis, σ ``sigma``, correlation ``exp(-|Δt| / time)``."""
    keep = np.exp(-dt / time)
    white = sigma * rng.standard_normal(shape)
    white[1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class WheelErrors:
    """Relative errors of a log's wheels."""

    speed: float
    turn: float


def measure_wheels(motion: RouteMotion, config: CrawlerConfig, seeds: SeedTree) -> tuple[VelocityControls, WheelErrors]:
    """Mean speed and yaw rate from each stamp to the next, with scale errors and noise."""
    c, rng = config, seeds.generator()
    n = int(np.floor(motion.duration * c.wheel_rate + 1e-9)) + 1
    edges = np.minimum(np.arange(n + 1) / c.wheel_rate, motion.duration)
    inner = np.stack([edges[:-1], 0.5 * (edges[:-1] + edges[1:]), edges[1:]])

    def mean(values: Array) -> Array:  # Simpson's rule over each interval
        return np.asarray((values[0] + 4.0 * values[1] + values[2]) / 6.0)

    at = inner.ravel()
    back = motion.poses(at)[:, 3:] * [-1.0, -1.0, -1.0, 1.0]
    speed = mean(quat_rotate(back, motion.velocities(at))[:, 0].reshape(inner.shape))
    turning = mean(motion.rotation(at)[0][:, 2].reshape(inner.shape))
    scales = c.noise_scale * np.array([c.wheel_scale, c.turn_scale]) * rng.standard_normal(2)
    noise = c.noise_scale * np.array([c.wheel_sigma, c.turn_sigma])[:, None] * rng.standard_normal((2, n))
    moving = np.abs(speed) > 1e-6  # a wheel at rest measures exactly zero
    controls = VelocityControls(
        times=edges[:-1],
        speed=(1.0 + scales[0]) * speed + np.where(moving, noise[0], 0.0),
        yaw_rate=(1.0 + scales[1]) * turning + np.where(moving, noise[1], 0.0),
    )
    return controls, WheelErrors(float(scales[0]), float(scales[1]))


def end_error(motion: RouteMotion, yaw_bias: ArrayLike, *, step: float = 0.2) -> Array:
    """Distance [m] by which dead reckoning misses the end if a constant yaw bias is its only error.

    Parameters
    ----------
    yaw_bias : array_like
        [rad/s]
    step : float
        Of the integral [s].
    """
    edges = np.linspace(0.0, motion.duration, max(int(motion.duration / step), 8) + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    p = motion.poses(edges)[:, :2]
    moved = np.diff(p[:, 0] + 1j * p[:, 1])
    b = np.asarray(yaw_bias, dtype=np.float64)[..., None]
    return np.asarray(np.abs(np.sum((np.exp(1j * b * middle) - 1.0) * moved, axis=-1)))


def yaw_bias_for(motion: RouteMotion, error: float, sign: float, most: float) -> float:
    """The smallest yaw bias [rad/s] that gives dead reckoning an end error of ``error`` [m], at most ``most``.

    If no bias up to ``most`` gives that error, the result is the one with the greatest end error.
    """
    if error <= 0:
        return 0.0
    trial = np.linspace(0.0, most, 401)[1:]
    missed = end_error(motion, sign * trial)
    over = np.flatnonzero(missed >= error)
    if not len(over):
        return float(sign * trial[np.argmax(missed)])
    k = int(over[0])
    low, high = (float(trial[k - 1]) if k else 0.0), float(trial[k])
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if float(end_error(motion, sign * middle)) >= error else (middle, high)
    return float(sign * high)
