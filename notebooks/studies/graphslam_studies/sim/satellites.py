"""A car among high buildings that hears satellites: pseudoranges with walls in their way, wheels and gyro, truth.

What is drawn is what :mod:`graphslam_studies.graph.pseudorange` says: biases of satellites are Gauss–Markov processes
whose size grows as the carrier-to-noise density falls, the clock drifts, the odometer has a bias and a scale error. So
a solution that is told the same figures must be consistent; a recorded street need not be like that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geodesy import tangent_axes
from graphslam.core.geometry import Array
from graphslam.core.gnss import EARTH_RATE, SPEED_OF_LIGHT, Pseudoranges, TangentPlane
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3
from graphslam.core.random import SeedTree
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory

PLANE = TangentPlane(52.5, 13.37, 76.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SatelliteConfig:
    """The drive, the sky, and every noise."""

    seconds: float = 120.0
    step: float = 1.0
    """Between epochs, and between records of the odometry [s]."""
    satellites: int = 12
    sigma: float = 6.0
    """Of a pseudorange of an unobstructed signal [m]."""
    density: tuple[float, float] = (33.0, 52.0)
    """Least and greatest mean of a satellite's carrier-to-noise density [dBHz]."""
    density_full: float = 45.0
    density_scale: float = 10.0
    bias_sigma: float = 5.0
    bias_time: float = 15.0
    offset_walk: float = 0.5
    drift_walk: float = 0.05
    rate_sigma: float = 1e-3
    scale_sigma: float = 3e-3

    def __post_init__(self) -> None:
        if not (self.step > 0 and self.seconds >= 4 * self.step and self.satellites >= 6):
            raise ConfigError(f"a drive of four epochs under six satellites is wanted, got {self}")


def simulate_satellites(seed: int, config: SatelliteConfig | None = None) -> SensorLog:
    """A log with the streams of smartLoc: ``pseudoranges``, ``odometry``, ``reference``.

    Returns
    -------
    SensorLog
        ``meta["plane"]`` is the tangent plane of the reference.
    """
    c = config or SatelliteConfig()
    tree = SeedTree(seed)
    times = np.arange(0.0, c.seconds, c.step)
    path, odometry = _drive(tree.child("drive").generator(), times, c)
    ranges = _sky(tree.child("sky").generator(), times, path, c)
    return SensorLog(
        name="satellites",
        streams={"pseudoranges": ranges, "odometry": odometry, "reference": Trajectory(times, path)},
        meta={"source": "simulation", "plane": [PLANE.latitude, PLANE.longitude, PLANE.height]},
    )


def _drive(rng: np.random.Generator, times: Array, c: SatelliteConfig) -> tuple[Array, Odometry]:
    """True poses in the tangent plane, and what wheels and gyro say."""
    n = len(times)
    bias, scale = c.rate_sigma * rng.standard_normal(), c.scale_sigma * rng.standard_normal()
    poses = [np.concatenate([20.0 * rng.standard_normal(2), [0.0], SE3.exp([0, 0, rng.uniform(-3, 3), 0, 0, 0])[3:]])]
    increments = [SE3.identity]
    sigma = c.step * np.array([0.002, 0.002, 0.002, 0.05, 0.03, 0.03])
    for t in times[:-1]:
        turn = 0.35 if t % 30.0 < 4.0 else 0.0  # right angles, one every half minute
        twist = c.step * np.array([0.0, 0.0, turn, 6.0 + 2.0 * np.sin(0.1 * t), 0.0, 0.0])
        poses.append(SE3.compose(poses[-1], SE3.exp(twist)))
        # the factor turns [ω - bias, (1 + scale) v] into the motion, so that this is what is read
        read = np.concatenate([twist[:3] + c.step * np.array([0, 0, bias]), twist[3:] / (1.0 + scale)])
        noisy = SE3.compose(SE3.exp(twist), SE3.inverse(SE3.exp(sigma * rng.standard_normal(6))))
        increments.append(SE3.exp(SE3.log(noisy) + read - twist))
    P = np.tile(np.diag(sigma**2), (n, 1, 1))
    return np.array(poses), Odometry(times=times, increments=np.array(increments), covariances=P)


def _sky(rng: np.random.Generator, times: Array, path: Array, c: SatelliteConfig) -> Pseudoranges:
    n, m = len(times), c.satellites
    azimuth = 2.0 * np.pi * (np.arange(m) + rng.random(m)) / m
    elevation = np.deg2rad(rng.uniform(15.0, 85.0, m))
    up = np.stack([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], -1)
    arrived = 2.2e7 * up @ tangent_axes(PLANE.latitude, PLANE.longitude) + PLANE.origin
    # in the axes of the instant of sending the satellite was farther east
    angle = -EARTH_RATE / SPEED_OF_LIGHT * np.linalg.norm(arrived - PLANE.origin, axis=1)
    for _ in range(3):
        s, k = np.sin(angle), np.cos(angle)
        sent = np.stack(
            [k * arrived[:, 0] + s * arrived[:, 1], k * arrived[:, 1] - s * arrived[:, 0], arrived[:, 2]], -1
        )
        angle = -EARTH_RATE / SPEED_OF_LIGHT * np.linalg.norm(sent - PLANE.origin, axis=1)
    there = PLANE.satellites(sent)
    mean = rng.uniform(*c.density, m)
    density = np.clip(mean + 3.0 * rng.standard_normal((n, m)), 15.0, 55.0)
    growth = 10.0 ** (np.maximum(c.density_full - density, 0.0) / c.density_scale)
    bias = np.empty((n, m))
    bias[0] = c.bias_sigma * growth[0] * rng.standard_normal(m)
    keep = np.exp(-c.step / c.bias_time)
    for k in range(1, n):
        size = c.bias_sigma * np.sqrt(growth[k] * growth[k - 1] * (1.0 - keep**2))
        bias[k] = keep * bias[k - 1] + size * rng.standard_normal(m)
    drift = -50.0 + c.drift_walk * np.sqrt(c.step) * np.cumsum(rng.standard_normal(n))
    walk = 0.5 * c.step * (drift[1:] + drift[:-1]) + c.offset_walk * np.sqrt(c.step) * rng.standard_normal(n - 1)
    clock = -1.4e5 + np.concatenate([[0.0], np.cumsum(walk)])
    systems = np.where(np.arange(m) % 3 == 2, 4, 1)
    offset = np.where(systems == 4, 4.0 * rng.standard_normal(), 0.0)
    distance = np.linalg.norm(path[:, None, :3] - there, axis=2)
    seen = distance + clock[:, None] + offset + bias + c.sigma * growth * rng.standard_normal((n, m))
    return Pseudoranges(
        times=times,
        offsets=m * np.arange(n + 1),
        ranges=seen.ravel(),
        sigmas=np.full(n * m, c.sigma),
        satellites=np.tile(sent, (n, 1)),
        ids=np.tile(np.arange(m) + 1, n),
        systems=np.tile(systems, n),
        elevation=np.tile(elevation, n),
        density=density.ravel(),
    )
