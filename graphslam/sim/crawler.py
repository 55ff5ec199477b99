"""Simulation of a robot like Cave Crawler in a triangle-mesh world.

A planar scanner whose head spins about the roll axis while the robot drives (every beam has its own time, origin and
direction), an IMU with noise, bias and random walk that also gives roll and pitch, and wheels with a scale error. The
dominant error is the bias of the yaw rate.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.records import Stream
from graphslam.core.se3 import se3_inverse
from graphslam.sim.crawler_config import DEFAULTS, PRESETS, CrawlerConfig, crawler_preset
from graphslam.sim.crawler_sensors import end_error, measure_imu, measure_wheels, scan_world, yaw_bias_for
from graphslam.sim.drive import DriveConfig, RouteMotion, drive_motion, euler_to_quat
from graphslam.sim.raycast import RayCaster

if TYPE_CHECKING:
    from graphslam.sim.world import World

__all__ = ["PRESETS", "CrawlerConfig", "crawler_motion", "crawler_preset", "simulate_crawler", "start_frame"]


def crawler_motion(world: World, config: CrawlerConfig = DEFAULTS, caster: RayCaster | None = None) -> RouteMotion:
    """The true motion of the crawler in the frame of the world, without any sensor."""
    wanted = {f.name: getattr(config, f.name) for f in dataclasses.fields(DriveConfig) if f.name != "rate"}
    return drive_motion(world, DriveConfig(rate=config.imu_rate, **wanted), caster)


def start_frame(motion: RouteMotion) -> Array:
    """``T_world_frame`` (7,): position and heading of the base at the start, z up."""
    first = motion.poses(np.zeros(1))[0]
    x, y, z, w = first[3:]
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.concatenate([first[:3], euler_to_quat(yaw, 0.0, 0.0)])


def simulate_crawler(world: World, seed: int, config: CrawlerConfig = DEFAULTS, *, progress: bool = False) -> SensorLog:
    """Simulate the drive through a world and record the sensors.

    Parameters
    ----------
    seed : int
        Of all random errors.
    progress : bool
        Show a progress bar on stderr.

    Returns
    -------
    SensorLog
        Streams ``scanner`` (RangeScans; ``scanner2``, facing backwards, if there are two), ``imu`` (Imu) and ``wheels``
        (VelocityControls). Ground truth at the rate of the IMU, in the levelled frame of the first base; ``meta``
        contains all parameters, the realised errors, and ``T_world_frame`` (7,), that frame in the world frame.
    """
    caster = RayCaster.of(world)
    motion = crawler_motion(world, config, caster)
    seeds = SeedTree(int(seed)).child("crawler")

    choice = seeds.child("drift").generator()
    sign = 1.0 if choice.random() < 0.5 else -1.0
    spread = 1.0 + config.drift_spread * float(np.clip(choice.standard_normal(), -2.0, 2.0))
    wanted, most = config.drift * motion.length, config.most_turned / motion.duration
    yaw_bias = yaw_bias_for(motion, spread * wanted, sign, spread * most)
    nominal = abs(yaw_bias_for(motion, wanted, sign, most))

    streams: dict[str, Stream] = {}
    for k, mount in enumerate([config.mount, config.rear_mount][: config.scanners]):
        name = "scanner" if k == 0 else f"scanner{k + 1}"
        streams[name] = scan_world(motion, caster, config, mount, seeds.child(name), progress=progress)
    streams["imu"], drawn = measure_imu(motion, config, yaw_bias, nominal, seeds.child("imu"))
    streams["wheels"], wheels = measure_wheels(motion, config, seeds.child("wheels"))

    frame = start_frame(motion)
    truth = motion.trajectory().transformed(se3_inverse(frame))
    figures = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(config).items()}
    meta: dict[str, Any] = {
        "source": "simulation",
        "robot": "crawler",
        "world": world.name,
        "seed": int(seed),
        "frame": "first base, z up",
        "T_world_frame": frame.tolist(),
        "length": motion.length,
        "duration": motion.duration,
        "world_meta": dict(world.meta),
        "mesh": {"vertices": len(world.vertices), "triangles": len(world.triangles)},
        "config": figures,
        "noise": {**_noise(config), "yaw_bias": nominal},
        "drawn": {
            **drawn,
            "wheel_scale": wheels.speed,
            "turn_scale": wheels.turn,
            "end_error_of_yaw_bias": float(end_error(motion, config.noise_scale * yaw_bias)),
        },
    }
    read = {name: len(s.times) for name, s in streams.items()}
    return SensorLog(name=world.name, streams=streams, truth=Truth(truth), read=read, meta=meta)


def _noise(config: CrawlerConfig) -> dict[str, float]:
    """Nominal σ of all random errors."""
    names = (
        *("range_sigma", "drop_out", "gyro", "gyro_bias_across", "gyro_walk", "accelerometer", "accelerometer_bias"),
        *("accelerometer_walk", "attitude_sigma", "attitude_time", "attitude_bias", "wheel_scale", "wheel_sigma"),
        *("turn_scale", "turn_sigma", "noise_scale"),
    )
    return {name: float(getattr(config, name)) for name in names}
