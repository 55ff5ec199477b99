"""Planar dead reckoning between stamps from any motion stream of a log, with covariance.

Three kinds of stream: speed and steering of a car (:class:`SteeringControls`), speed and yaw rate
(:class:`VelocityControls`), and recorded increments with their covariances (:class:`Odometry`).

Noise of real vehicles is not white per control step (side slip and steering offsets are correlated over seconds), so
the noise model has a part that is constant over one increment and a part that grows with the distance driven.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.core.record_source import RecordSource
from graphslam.core.records import Odometry, SteeringControls, VelocityControls, check_times
from graphslam_frontends.odometry.motion_kernels import (
    FRONT_STEER,
    REAR_AXLE,
    compose_increments_kernel,
    steering_increments_kernel,
    velocity_increments_kernel,
)

HEADING_UNKNOWN = float(np.pi / np.sqrt(3.0))
"""σ of a uniformly distributed heading [rad]."""
Motion = SteeringControls | VelocityControls | Odometry
"""Motion streams, in order of preference."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionNoise:
    """Noise of one dead-reckoning increment (right tangent at its end).

    ``steering`` is for cars, ``yaw_rate`` and its fraction for streams of speed and yaw rate; a recorded odometry has
    its own covariances and uses only the floors.
    """

    speed: float = 0.3
    """σ of the measured speed [m/s]."""
    speed_fraction: float = 0.0
    """Part of σ proportional to speed: σ² = speed² + (speed_fraction · v)²."""
    steering: float = float(np.deg2rad(3.0))
    """σ of the measured steering angle [rad]."""
    yaw_rate: float = 0.05
    """σ of the yaw rate [rad/s]."""
    yaw_rate_fraction: float = 0.0
    """Part of σ proportional to the yaw rate: σ² = yaw_rate² + (yaw_rate_fraction · ω)²."""
    speed_walk: float = 0.0
    """σ of the distance after one second of driving, growing with the root of time [m/√s]; speed and yaw rate only."""
    yaw_walk: float = 0.0
    """σ of the heading after one second of driving, growing with the root of time [rad/√s]; speed and yaw rate only."""
    per_increment: bool = False
    """True: errors of the controls are constant over an increment; False: independent per control step."""
    lateral: float = 0.0
    """σ of side slip per metre driven [m/m], independent per increment."""
    heading: float = 0.0
    """σ of heading drift per metre driven [rad/m], independent per increment."""
    floor_position: float = 1e-4
    """σ added to x and y of every increment [m]: keeps the covariance of a stationary vehicle invertible."""
    floor_heading: float = 1e-5
    """σ added to the heading of every increment [rad]."""

    def __post_init__(self) -> None:
        check_options(self, "motion noise: ", {"> 0 or inf": "floor_position floor_heading", "≥ 0 or inf": "*"})

    def as_array(self) -> Array:
        """As the array that the kernels expect."""
        return np.array(
            [
                self.speed,
                self.speed_fraction,
                self.steering,
                float(self.per_increment),
                self.lateral,
                self.heading,
                self.floor_position,
                self.floor_heading,
                self.yaw_rate,
                self.yaw_rate_fraction,
                self.speed_walk,
                self.yaw_walk,
            ]
        )


def motion_stream(log: SensorLog) -> tuple[str, Motion]:
    """Name and stream for dead reckoning: steering before velocities before recorded odometry."""
    name = motion_stream_name(log)
    if name is None:
        raise MissingDataError(
            "no motion to dead-reckon from", where=log.name, wanted="SteeringControls, VelocityControls or Odometry"
        )
    return name, log[name]


def motion_stream_name(log: SensorLog | RecordSource) -> str | None:
    """Name of the stream for dead reckoning; None: there is none."""
    found = (log.of_type(kind) for kind in (SteeringControls, VelocityControls, Odometry))
    return next((name for name in found if name is not None), None)


def dead_reckoned_increments(
    log: SensorLog, times: npt.ArrayLike, noise: MotionNoise, *, hold: float = 0.0
) -> tuple[Odometry, str]:
    """Increments between consecutive ``times`` from the log's motion stream, and that stream's name.

    Parameters
    ----------
    times : (n,)
        Stamps of the poses [s], strictly increasing.
    noise : MotionNoise
        Of controls; recorded odometry has its own covariances.
    hold : float
        Longest extrapolation before the first control, which is held backwards [s]; recorded odometry is extrapolated
        by as much at its first and last velocity. The last *control* is held to the end.
    """
    name, stream = motion_stream(log)
    where = f"{log.name}/{name}"
    t = check_times(times, where=where)
    if len(stream.times) == 0:
        raise MissingDataError("motion stream is empty", where=where)
    early = float(stream.times[0] - t[0]) if len(t) else 0.0
    if early > hold:
        raise DataError(
            "pose stamp before the first motion record",
            where=where,
            got=f"{t[0]:.3f} s",
            wanted=f"≥ {stream.times[0] - hold:.3f} s",
        )
    if isinstance(stream, Odometry):
        if stream.increments.shape[1] != 3:
            raise DataError("odometry in space cannot be used", where=where, wanted="odometry in the plane")
        return cut_odometry(stream, t, noise, hold=hold), name
    if early > 0:
        stream = replace(stream, times=np.concatenate([t[:1], stream.times[1:]]))
    if isinstance(stream, VelocityControls):
        return velocity_odometry(stream, t, noise), name
    return steering_odometry(stream, t, noise), name


def _fine_steps(stamps: Array, times: Array) -> tuple[Array, Array, npt.NDArray[np.intp], npt.NDArray[np.int64]]:
    """Steps with constant controls, between the pose stamps ``times``.

    Returns
    -------
    times : (n,)
    dt : (s,)
    active : (s,)
        Control of every step.
    first : (n,)
        First step of every increment.
    """
    t = check_times(times)
    if len(t) and t[0] < stamps[0]:
        raise DataError("pose stamp before the first control", got=f"{t[0]:.3f} s", wanted=f"≥ {stamps[0]:.3f} s")
    knots = np.union1d(stamps[(stamps > t[0]) & (stamps < t[-1])], t) if len(t) else t
    active = np.searchsorted(stamps, knots[:-1], side="right") - 1
    return t, np.diff(knots), active, np.searchsorted(knots, t).astype(np.int64)


def _start(n: int, noise: MotionNoise) -> tuple[Array, Array]:
    """Increments and covariances to fill: record 0 is the identity with the floor covariance."""
    increments, covs = np.zeros((n, 3)), np.zeros((n, 3, 3))
    covs[:1] = np.diag([noise.floor_position**2, noise.floor_position**2, noise.floor_heading**2])
    return increments, covs


def velocity_odometry(controls: VelocityControls, times: Array, noise: MotionNoise) -> Odometry:
    """Increments between consecutive ``times`` from zero-order-hold speed and yaw rate; exact arcs.

    Zero speed and zero rate mean a stationary base, without noise except the floors. With white noise the mean is
    unbiased: rate noise shortens the integrated path, which is corrected as for steering.

    Parameters
    ----------
    controls : VelocityControls
        The last one is held to the end.
    times : (n,)
        Stamps of the poses, strictly increasing, none before the first control.
    noise : MotionNoise
        σ² = speed² + (speed_fraction · v)² and yaw_rate² + (yaw_rate_fraction · ω)²: independent per control, or with
        ``per_increment`` per increment (a constant and a scale error each). Random walks of distance and heading are
        added, independent of the control rate.

    Returns
    -------
    Odometry
        As :func:`steering_odometry`.
    """
    t, dt, active, first = _fine_steps(controls.times, times)
    increments, covs = _start(len(t), noise)
    if len(t) > 1:
        speed, rate = controls.speed[active], controls.yaw_rate[active]
        velocity_increments_kernel(dt, speed, rate, first, noise.as_array(), increments[1:], covs[1:])
    return Odometry(times=t, increments=increments, covariances=covs)


def cut_odometry(odometry: Odometry, times: Array, noise: MotionNoise, *, hold: float = 0.0) -> Odometry:
    """Increments between consecutive ``times``, composed of recorded ones and their covariances.

    If a stamp is inside a record, the record is divided at constant velocity and its covariance in proportion to time
    (as for white noise; the pieces are then independent and add up to the covariance of the record to first order).

    Parameters
    ----------
    odometry : Odometry
        In two or three dimensions.
    times : (n,)
    noise : MotionNoise
        Only its floors are used.
    hold : float
        Longest extrapolation before the first and after the last record, at constant velocity [s]; σ then grows in
        proportion to time.
    """
    t, stamps, g = check_times(times), odometry.times, group_of(odometry.increments)
    if len(stamps) < 2:
        raise DataError("odometry cannot be used", got=f"{len(stamps)} records", wanted="two at least")
    if len(t) and not (t[0] >= stamps[0] - hold and t[-1] <= stamps[-1] + hold):
        raise DataError(
            "pose stamp outside the odometry",
            got=f"[{t[0]:.3f}, {t[-1]:.3f}] s",
            wanted=f"[{stamps[0] - hold:.3f}, {stamps[-1] + hold:.3f}] s",
        )
    usual = float(np.sqrt(np.median(odometry.covariances[1:, g.heading, g.heading])))
    if g.dim == 2 and usual > HEADING_UNKNOWN:
        raise DataError(
            "the stated covariances of the odometry leave its heading unknown within one record",
            got=f"σ of {usual:.3g} rad in {float(np.median(np.diff(stamps))):.3g} s",
            wanted=f"below {HEADING_UNKNOWN:.2g} rad; look at their unit and their order: x, y [m], heading [rad]",
        )
    floor = np.full(g.dof, noise.floor_heading**2)
    floor[g.position] = noise.floor_position**2
    increments, covs = np.tile(g.identity, (len(t), 1)), np.tile(np.diag(floor), (len(t), 1, 1))
    if len(t) < 2:
        return Odometry(times=t, increments=increments, covariances=covs)
    knots = np.union1d(stamps[(stamps > t[0]) & (stamps < t[-1])], t)
    record = np.clip(np.searchsorted(stamps, 0.5 * (knots[:-1] + knots[1:]), side="right"), 1, len(stamps) - 1)
    u = np.diff(knots) / (stamps[record] - stamps[record - 1])
    whole = (knots[:-1] == stamps[record - 1]) & (knots[1:] == stamps[record])
    pieces = np.where(
        whole[:, None], odometry.increments[record], g.exp(u[:, None] * g.log(odometry.increments[record]))
    )
    guessed = (knots[:-1] < stamps[0]) | (knots[:-1] >= stamps[-1])
    added = np.where(guessed, np.maximum(u, u**2), u)[:, None, None] * odometry.covariances[record]
    first = np.searchsorted(knots, t).astype(np.int64)
    if g.dim == 2:
        compose_increments_kernel(pieces, added, first, increments[1:], covs[1:])
        return Odometry(times=t, increments=increments, covariances=covs)
    P, counts = np.zeros((len(t) - 1, g.dof, g.dof)), np.diff(first)
    for m in range(int(counts.max())):  # all increments in parallel, one piece each at a time
        live = np.flatnonzero(counts > m)
        piece = pieces[first[live] + m]
        increments[live + 1] = g.compose(increments[live + 1], piece)
        back = g.adjoint(g.inverse(piece))
        P[live] = back @ P[live] @ np.swapaxes(back, -1, -2) + added[first[live] + m]
    covs[1:] += 0.5 * (P + np.swapaxes(P, -1, -2))
    return Odometry(times=t, increments=increments, covariances=covs)


def steering_odometry(controls: SteeringControls, times: Array, noise: MotionNoise) -> Odometry:
    """Increments between consecutive ``times`` from zero-order-hold controls.

    Parameters
    ----------
    controls : SteeringControls
        Held constant from each stamp to the next; the last one is held to the end.
    times : (n,)
        Stamps of the poses, strictly increasing, none before the first control.

    Returns
    -------
    Odometry
        Record 0 is the identity with the floor covariance; record k takes ``times[k - 1]`` to ``times[k]``.
    """
    t, dt, active, first = _fine_steps(controls.times, times)
    increments, covs = _start(len(t), noise)
    g = controls.geometry
    models = {"rear-axle": REAR_AXLE, "front-steer": FRONT_STEER}
    if g.model not in models:
        raise ConfigError(f"unknown steering model {g.model!r}; known: {', '.join(models)}")
    if len(t) > 1:
        steering_increments_kernel(
            np.stack([dt, controls.speed[active], controls.steering[active]]),
            first,
            models[g.model],
            g.wheelbase,
            g.encoder_offset,
            noise.as_array(),
            increments[1:],
            covs[1:],
        )
    return Odometry(times=t, increments=increments, covariances=covs)
