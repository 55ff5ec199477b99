"""Faults put into a log of wheels, detections of landmarks and GPS: each a function from a log to a log.

The logs have no ground truth: the run has only its own tests.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from graphslam.core.geometry import Array, rotation2, se2_between, se2_compose, se2_exp, se2_log, wrap_angle
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps, LandmarkObservations, Odometry, SteeringControls, VelocityControls
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.motion import MotionNoise

Inject = Callable[[SensorLog], SensorLog]


def with_stream(log: SensorLog, name: str, stream: Any) -> SensorLog:
    """The log with one stream in place of the one of that name, without truth."""
    return replace(log, streams={**log.streams, name: stream}, truth=None)


def clean(log: SensorLog) -> SensorLog:
    """No fault: only the truth is taken away."""
    return replace(log, truth=None)


# ---- wheels ----------------------------------------------------------------------------------------------------------


def speed(factor: float) -> Inject:
    """Every speed times a factor."""

    def inject(log: SensorLog) -> SensorLog:
        c: SteeringControls = log["controls"]
        return with_stream(log, "controls", replace(c, speed=factor * c.speed))

    return inject


def steering(factor: float) -> Inject:
    """Every steering angle times a factor: -1 is the other side, 180/π is degrees."""

    def inject(log: SensorLog) -> SensorLog:
        c: SteeringControls = log["controls"]
        return with_stream(log, "controls", replace(c, steering=factor * c.steering))

    return inject


def gap(seconds: float, at: float = 20.0) -> Inject:
    """No record of the wheels for some seconds."""

    def inject(log: SensorLog) -> SensorLog:
        c: SteeringControls = log["controls"]
        keep = (c.times < at) | (c.times >= at + seconds)
        return with_stream(log, "controls", c.take(keep))

    return inject


def gap_of_all(seconds: float, at: float = 20.0) -> Inject:
    """No record of any sensor for some seconds, as where a recorder stops."""

    def inject(log: SensorLog) -> SensorLog:
        streams = {k: s.take((s.times < at) | (s.times >= at + seconds)) for k, s in log.streams.items()}
        return replace(log, streams=streams, truth=None)

    return inject


def rates(speed: float = 1.0, yaw_rate: float = 1.0, bias: float = 0.0) -> Inject:
    """Speeds and yaw rates times factors, and a constant added to the yaw rates [rad/s]."""

    def inject(log: SensorLog) -> SensorLog:
        c: VelocityControls = log["controls"]
        return with_stream(log, "controls", replace(c, speed=speed * c.speed, yaw_rate=yaw_rate * c.yaw_rate + bias))

    return inject


def increments(factor: float) -> Inject:
    """Every increment of the odometry for ``factor`` times as long: 0 stands still, -1 is the way back."""

    def inject(log: SensorLog) -> SensorLog:
        o: Odometry = log["odometry"]
        return with_stream(log, "odometry", replace(o, increments=se2_exp(factor * se2_log(o.increments))))

    return inject


def odometry_gap(seconds: float, at: float = 20.0) -> Inject:
    """Records are lost: the way in them is in no other record."""

    def inject(log: SensorLog) -> SensorLog:
        o: Odometry = log["odometry"]
        return with_stream(log, "odometry", o.take((o.times < at) | (o.times >= at + seconds)))

    return inject


def stated_covariance(factor: float) -> Inject:
    """The covariances of the odometry times a factor."""

    def inject(log: SensorLog) -> SensorLog:
        o: Odometry = log["odometry"]
        return with_stream(log, "odometry", replace(o, covariances=factor * o.covariances))

    return inject


def with_imu(log: SensorLog) -> SensorLog:
    """A sound IMU on top, standing level: it measures gravity, and turns and accelerations of the path."""
    assert log.truth is not None
    path = log.truth.trajectory
    t = np.arange(path.times[0], path.times[-1], 0.02)
    along = CubicSpline(path.times, np.column_stack([path.positions, np.unwrap(path.poses[:, 2])]))
    (c, s), a = (f(along(t)[:, 2]) for f in (np.cos, np.sin)), along(t, 2)
    rng, none = np.random.default_rng(9), np.zeros(len(t))
    rate = np.column_stack([none, none, along(t, 1)[:, 2]]) + 0.007 * rng.standard_normal((len(t), 3))
    force = np.column_stack([c * a[:, 0] + s * a[:, 1], c * a[:, 1] - s * a[:, 0], none + 9.81])
    force += 0.07 * rng.standard_normal((len(t), 3))
    noise = ImuNoise(
        gyro=1e-3, gyro_bias=1e-3, gyro_walk=1e-4, accelerometer=1e-2, accelerometer_bias=0.1, accelerometer_walk=1e-3
    )
    return with_stream(log, "imu", Imu(times=t, angular_rate=rate, specific_force=force, noise=noise))


# ---- logs whose wheels say other things ------------------------------------------------------------------------------


def measured_velocities(log: SensorLog) -> SensorLog:
    """The same drive, seen from the rear axle, with controls of speed and yaw rate; σ are the defaults of
    ``frontend.motion``."""
    assert log.truth is not None
    c, z = log["controls"], log["landmarks"]
    front = np.array([c.geometry.wheelbase, 0.0, 0.0])
    there = log.truth.trajectory
    path = Trajectory(there.times, se2_compose(there.poses, np.broadcast_to(-front, there.poses.shape)))
    t = c.times
    steps = se2_log(se2_between(path.interpolate(t[:-1]), path.interpolate(t[1:]))) / np.diff(t)[:, None]
    steps = np.concatenate([steps, steps[-1:]])
    rng = np.random.default_rng(21)
    noise = MotionNoise()
    velocities = VelocityControls(
        times=t,
        speed=steps[:, 0] + noise.speed * rng.standard_normal(len(t)),
        yaw_rate=steps[:, 2] + noise.yaw_rate * rng.standard_normal(len(t)),
    )
    streams = {**log.streams, "controls": velocities, "landmarks": replace(z, T_base_sensor=front)}
    return replace(log, streams=streams, truth=replace(log.truth, trajectory=path))


def measured_increments(log: SensorLog) -> SensorLog:
    """The same drive with recorded increments, five a second, and their covariances."""
    assert log.truth is not None
    path = log.truth.trajectory
    t = np.arange(path.times[0], path.times[-1], 0.2)
    poses = path.interpolate(t)
    rng = np.random.default_rng(22)
    sigma = np.array([0.05, 0.02, 0.01])
    steps = np.zeros((len(t), 3))
    steps[1:] = se2_compose(se2_between(poses[:-1], poses[1:]), se2_exp(sigma * rng.standard_normal((len(t) - 1, 3))))
    odometry = Odometry(times=t, increments=steps, covariances=np.tile(np.diag(sigma**2), (len(t), 1, 1)))
    streams = {"odometry": odometry, **{k: s for k, s in log.streams.items() if k != "controls"}}
    return replace(log, streams=streams)


# ---- detections ----------------------------------------------------------------------------------------------------


def detections(change: Callable[[LandmarkObservations, np.random.Generator], LandmarkObservations]) -> Inject:
    """A change of the stream of detections."""

    def inject(log: SensorLog) -> SensorLog:
        return with_stream(log, "landmarks", change(log["landmarks"], np.random.default_rng(7)))

    return inject


def ranges(factor: float = 1.0, offset: float = 0.0) -> Inject:
    """Ranges in another unit, or longer by a constant; the sensor's stated reach is in the same wrong unit."""
    return detections(
        lambda z, _: replace(z, ranges=factor * z.ranges + offset, max_range=factor * z.max_range + offset)
    )


def constant_ranges(value: float) -> Inject:
    """A rangefinder that always says the same."""
    return detections(lambda z, _: replace(z, ranges=np.full_like(z.ranges, value)))


def mirrored() -> Inject:
    """Bearings positive to the right."""
    return detections(lambda z, _: replace(z, bearings=-z.bearings))


def bearing_offset(angle: float) -> Inject:
    """Bearings from another zero, or the sensor turned on the robot."""

    def change(z: LandmarkObservations, _: np.random.Generator) -> LandmarkObservations:
        low, high = z.field_of_view
        return replace(z, bearings=wrap_angle(z.bearings + angle), field_of_view=(low + angle, high + angle))

    return detections(change)


def bearings_in_degrees() -> Inject:
    """Numbers of degrees, read as radians; σ and field of view stay as the data sheet says."""
    return detections(lambda z, _: replace(z, bearings=np.rad2deg(z.bearings)))


def mounted(x: float, y: float, angle: float) -> Inject:
    """The sensor is elsewhere on the robot than the log says."""

    def change(z: LandmarkObservations, _: np.random.Generator) -> LandmarkObservations:
        d = z.ranges[:, None] * np.column_stack([np.cos(z.bearings), np.sin(z.bearings)]) - [x, y]
        d = d @ rotation2(np.array([angle]))[0]
        r, b = np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])
        return replace(z, ranges=r, bearings=b, field_of_view=(-np.pi, np.pi))

    return detections(change)


def wrong_identities(share: float) -> Inject:
    """Some identities are those of other landmarks."""

    def change(z: LandmarkObservations, rng: np.random.Generator) -> LandmarkObservations:
        assert z.ids is not None
        wrong = rng.random(len(z.ids)) < share
        return replace(z, ids=np.where(wrong, rng.choice(np.unique(z.ids[z.ids >= 0]), len(z.ids)), z.ids))

    return detections(change)


def repeated(times: int) -> Inject:
    """Every scan again and again under new stamps, as from a driver that hands out its last scan."""

    def change(z: LandmarkObservations, _: np.random.Generator) -> LandmarkObservations:
        source = times * (np.arange(len(z.times)) // times)
        rows = np.concatenate([np.arange(z.offsets[k], z.offsets[k + 1]) for k in source])
        assert z.ids is not None
        return replace(
            z,
            offsets=np.concatenate([[0], np.cumsum(np.diff(z.offsets)[source])]),
            ranges=z.ranges[rows],
            bearings=z.bearings[rows],
            sigmas=z.sigmas[rows],
            ids=z.ids[rows],
        )

    return detections(change)


def thinned(keep: Callable[[LandmarkObservations], Array]) -> Inject:
    """Only some scans."""
    return detections(lambda z, _: z.take(keep(z)))


# ---- GPS -------------------------------------------------------------------------------------------------------------


def gps(change: Callable[[Gps, np.random.Generator], Gps]) -> Inject:
    """A change of the fixes."""

    def inject(log: SensorLog) -> SensorLog:
        return with_stream(log, "gps", change(log["gps"], np.random.default_rng(11)))

    return inject


def bursts(g: Gps, rng: np.random.Generator) -> Gps:
    """Four fixes of fourteen are off together, by 15 m or so."""
    p = g.positions.copy()
    for k in range(8, len(p) - 4, 14):
        p[k : k + 4] += 15.0 * rng.standard_normal(2)
    return replace(g, positions=p)


def correlated(sigma: float) -> Any:
    """An error of 3 m that fades over 60 s, on top of the noise."""

    def change(g: Gps, rng: np.random.Generator) -> Gps:
        keep = float(np.exp(-np.median(np.diff(g.times)) / 60.0))
        b, p = 3.0 * rng.standard_normal(2), g.positions.copy()
        for k in range(len(p)):
            p[k] += b
            b = keep * b + np.sqrt(1.0 - keep**2) * 3.0 * rng.standard_normal(2)
        return replace(g, positions=p, sigma=np.full(len(p), sigma))

    return change


def ramp(g: Gps, _: Any) -> Gps:
    """Off by 7 m within 20 s, and then for good."""
    return replace(g, positions=g.positions + np.clip((g.times - 10.0) / 20.0, 0.0, 1.0)[:, None] * [6.0, 3.0])


def degrees(g: Gps, _: Any) -> Gps:
    """Longitude and latitude, read as metres."""
    return replace(g, positions=np.array([11.5, 48.1]) + g.positions / np.array([74000.0, 111200.0]))


def axes_swapped(g: Gps, _: Any) -> Gps:
    """North and east are mixed up: a mirror image."""
    return replace(g, positions=g.positions[:, ::-1].copy())


def off_by_1_km(g: Gps, _: Any) -> Gps:
    """A base station at a wrong place."""
    return replace(g, positions=g.positions + [800.0, -600.0])
