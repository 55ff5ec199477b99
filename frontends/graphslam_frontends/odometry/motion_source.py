"""Source of the motion of steps: an IMU and wheels, recorded odometry, or planar controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.records import Odometry, SteeringControls, VelocityControls
from graphslam_frontends.grid.motion import roll_pitch_of
from graphslam_frontends.odometry.dead_reckoning import integrate_imu_and_wheels
from graphslam_frontends.odometry.gaps import Gaps, find_gaps
from graphslam_frontends.odometry.motion import cut_odometry, steering_odometry, velocity_odometry
from graphslam_frontends.odometry.motion_prior import MotionPrior, OdometryBiases
from graphslam_frontends.odometry.recorded import (
    add_yaw_bias,
    bridge_gap,
    chain_odometry,
    without_yaw_per_metre,
)
from graphslam_frontends.odometry.step_config import StepConfig

TILT_TIME = 10.0
"""Correlation time of roll and pitch errors of recorded odometry [s]."""


@dataclass(frozen=True, slots=True)
class MotionSource:
    """Motion of a log, before the stamps of the steps are known.

    Parameters
    ----------
    names : tuple of str
        Streams.
    begin, end : float
        Interval with motion [s].
    solve : callable
        (stamps of the steps, further stamps, drops) → prior with a path that covers all of them.
    """

    names: tuple[str, ...]
    dim: int
    begin: float
    end: float
    solve: Callable[[Array, Array, DropCounter | None], MotionPrior]


def motion_source(log: SensorLog, config: StepConfig, dim: int) -> MotionSource:
    """The motion of a log: an IMU with wheels, else recorded odometry, else controls.

    Parameters
    ----------
    dim : int
        Of the beams: motion of another dimension is used only if there is no other, or if it is named.
    """
    names = config.motion or _best(log, dim)
    streams = [log[n] for n in names]
    for name, stream in zip(names, streams):
        if len(stream.times) == 0:
            raise MissingDataError("motion stream is empty", where=f"{log.name}/{name}")
    kinds = [type(s) for s in streams]
    if set(kinds) == {Imu, VelocityControls} and len(kinds) == 2:
        imu, wheels = sorted(streams, key=lambda s: not isinstance(s, Imu))
        return _inertial(log, names, imu, wheels, config)
    if kinds == [Odometry]:
        return _recorded(log, names[0], streams[0], config)
    if kinds in ([VelocityControls], [SteeringControls]):
        return _controlled(log, names[0], streams[0], config)
    raise ConfigError(
        f"steps: motion from {', '.join(f'{n} ({k.__name__})' for n, k in zip(names, kinds))}; "
        "wanted an Imu and VelocityControls, or one of Odometry, VelocityControls, SteeringControls"
    )


def _best(log: SensorLog, dim: int) -> tuple[str, ...]:
    imu, wheels = log.of_type(Imu), log.of_type(VelocityControls)
    found: list[tuple[int, tuple[str, ...]]] = []  # dimensions, streams; the best first
    if imu is not None and wheels is not None:
        found.append((3, (imu, wheels)))
    for name, stream in log.streams.items():
        if isinstance(stream, Odometry):
            found.append((2 if stream.increments.shape[1] == 3 else 3, (name,)))
    for kind in (VelocityControls, SteeringControls):
        controls = log.of_type(kind)
        if controls is not None:
            found.append((2, (controls,)))
    if not found:
        raise MissingDataError(
            "no motion to make steps of", where=log.name, wanted="Imu with VelocityControls, Odometry, or controls"
        )
    return next((names for d, names in found if d == dim), found[0][1])


def _inertial(
    log: SensorLog, names: tuple[str, ...], imu: Imu, wheels: VelocityControls, config: StepConfig
) -> MotionSource:
    if config.yaw_bias:
        to_imu = se3.quat_rotate(imu.T_base_imu[3:] * [-1.0, -1.0, -1.0, 1.0], np.array([0.0, 0.0, config.yaw_bias]))
        noise = replace(imu.noise, gyro_bias=float(np.hypot(imu.noise.gyro_bias, config.yaw_bias)))
        imu = replace(imu, angular_rate=imu.angular_rate + to_imu, noise=noise)

    def solve(times: Array, further: Array, drops: DropCounter | None) -> MotionPrior:
        since = min(float(times[0]), float(further.min(initial=times[0])))
        return integrate_imu_and_wheels(
            imu, wheels, times, config.noise, since=since, longest=config.longest_record, where=log.name, drops=drops
        )

    begin = float(max(imu.times[0], wheels.times[0]))
    end = min(float(imu.times[-1]), float(wheels.times[-1]) + _spacing(wheels.times))
    return MotionSource(names, 3, begin, end, solve)


def _spacing(stamps: Array) -> float:
    """Validity of the last held record: the median interval [s]."""
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0


def _biases(odometry: Odometry, config: StepConfig) -> OdometryBiases:
    bias = float(np.hypot(config.constant_yaw_bias, config.yaw_bias))
    return OdometryBiases(odometry=odometry, yaw_bias=bias, scale=config.constant_scale)


def _recorded(log: SensorLog, name: str, odometry: Odometry, config: StepConfig) -> MotionSource:
    if len(odometry.times) < 2:
        raise MissingDataError("odometry has a single record: no motion", where=f"{log.name}/{name}")
    if config.yaw_per_metre:
        odometry = without_yaw_per_metre(odometry, config.yaw_per_metre, where=f"{log.name}/{name}")
    upright = chain_odometry(odometry)
    if config.odometry_tilt_sigma and upright.dim == 2:
        raise ConfigError(f"{log.name}/{name}: odometry in the plane has no roll and pitch")
    if config.yaw_bias:
        odometry = add_yaw_bias(odometry, config.yaw_bias)
    whole = chain_odometry(odometry) if config.yaw_bias else upright

    def solve(times: Array, _: Array, drops: DropCounter | None) -> MotionPrior:
        bridged, gaps = bridge_gap(odometry, config.longest_record, where=f"{log.name}/{name}", drops=drops)
        cut = cut_odometry(bridged, times, config.controls)
        poses = whole.interpolate(times)
        motion = MotionPrior(odometry=cut, poses=poses, path=whole, biases=_biases(cut, config), gaps=gaps)
        if not config.odometry_tilt_sigma:
            return motion
        return replace(
            motion,
            tilt=roll_pitch_of(upright.interpolate(times)),
            tilt_sigma=config.odometry_tilt_sigma,
            tilt_time=TILT_TIME,
        )

    return MotionSource((name,), whole.dim, float(whole.times[0]), float(whole.times[-1]), solve)


def _controlled(
    log: SensorLog, name: str, controls: VelocityControls | SteeringControls, config: StepConfig
) -> MotionSource:
    if config.yaw_bias:
        if isinstance(controls, SteeringControls):
            raise ConfigError("steps: yaw_bias cannot be added to steering; wanted a stream of yaw rates or odometry")
        controls = replace(controls, yaw_rate=controls.yaw_rate + config.yaw_bias)

    def dead_reckoned(times: Array) -> Odometry:
        if isinstance(controls, SteeringControls):
            return steering_odometry(controls, times, config.controls)
        return velocity_odometry(controls, times, config.controls)

    def solve(times: Array, further: Array, drops: DropCounter | None) -> MotionPrior:
        span = (float(times[0]), float(times[-1]))
        where = f"{log.name}/{name}"
        gaps = find_gaps(controls.times, *span, config.longest_record, where=where, drops=drops)
        odometry = inflate_over_gaps(dead_reckoned(times), controls, gaps)
        path = chain_odometry(dead_reckoned(np.union1d(times, further)))
        poses = path.poses[np.searchsorted(path.times, times)]
        if len(times) > 1 and not np.all(np.isfinite(poses)):
            raise DataError("dead reckoning is not finite", where=where)
        return MotionPrior(odometry=odometry, poses=poses, path=path, biases=_biases(odometry, config), gaps=gaps)

    end = float(controls.times[-1]) + _spacing(controls.times)
    return MotionSource((name,), 2, float(controls.times[0]), end, solve)


def inflate_over_gaps(odometry: Odometry, controls: VelocityControls | SteeringControls, gaps: Gaps) -> Odometry:
    """Planar increments with covariances increased in the gaps of the controls.

    The last control before a gap is held. Its σ, constant in the gap, is the RMS difference of the speeds and yaw rates
    of the log from it. The error is constant over a gap, so the variances of its pieces add up to that of the whole
    gap.
    """
    if not len(gaps.begin):
        return odometry
    if isinstance(controls, SteeringControls):
        rate = controls.speed * np.tan(controls.steering) / controls.geometry.wheelbase
    else:
        rate = controls.yaw_rate
    t, covariances = odometry.times, odometry.covariances.copy()
    for a, b in zip(gaps.begin, gaps.end):
        last = int(np.searchsorted(controls.times, a, side="right")) - 1
        sigma_v = float(np.sqrt(np.mean((controls.speed - controls.speed[last]) ** 2)))
        sigma_w = float(np.sqrt(np.mean((rate - rate[last]) ** 2)))
        for k in range(1, len(t)):
            inside = min(t[k], b) - max(t[k - 1], a)
            if inside > 0:
                spent = float(inside) * float(b - a)
                covariances[k] += np.diag([sigma_v**2, (0.1 * sigma_v) ** 2, sigma_w**2]) * spent
    return replace(odometry, covariances=covariances)
