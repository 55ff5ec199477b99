"""Small drives that faults are put into: a hall with a block in it, in space and in the plane, about half a minute."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from graphslam.core.geometry import se2_between
from graphslam.core.log import SensorLog, Truth
from graphslam.core.records import LaserScans, VelocityControls
from graphslam.core.trajectory import Trajectory
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from tests.frontends.grid_world import drive, ranges

SPEED, RATE = 0.75, 20.0
RANGE = 8.0


@cache
def court_log(seed: int = 3, seconds: float = 40.0) -> SensorLog:
    """The court: a scanner whose head spins, an IMU, wheels."""
    log = simulate_crawler(ring_hall(seed=seed), seed, CrawlerConfig(max_range=RANGE))
    return log.slice(0.0, seconds)


@cache
def ring_log(seed: int = 3, length: float = 30.0) -> SensorLog:
    """A ring of corridors in the plane: a laser of 271° at 5 Hz, and wheels whose heading drifts by 2 mrad/s."""
    rng = np.random.default_rng([seed, 77])
    poses = drive(2, length, SPEED / RATE)
    t = np.arange(len(poses)) / RATE
    steps = se2_between(poses[:-1], poses[1:])
    bias = rng.choice([-1.0, 1.0]) * 0.002
    speed = (1.0 + 0.005 * rng.standard_normal()) * np.append(steps[:, 0], steps[-1, 0]) * RATE
    turn = np.append(steps[:, 2], steps[-1, 2]) * RATE + bias
    wheels = VelocityControls(
        times=t,
        speed=speed + 0.02 * rng.standard_normal(len(t)),
        yaw_rate=turn + 0.01 * rng.standard_normal(len(t)),
    )
    every = slice(0, None, 4)
    bearings = np.deg2rad(np.arange(-135.0, 135.1, 1.5))
    at = np.repeat(poses[every], len(bearings), axis=0)
    angle = at[:, 2] + np.tile(bearings, len(poses[every]))
    r = ranges(at[:, :2] + 0.0, np.column_stack([np.cos(angle), np.sin(angle)]))
    r = np.where(r < RANGE, r + 0.02 * rng.standard_normal(len(r)), RANGE).reshape(-1, len(bearings))
    scans = LaserScans(times=t[every], ranges=np.minimum(r, RANGE), bearings=bearings, max_range=RANGE)
    return SensorLog(name="ring", streams={"scanner": scans, "wheels": wheels}, truth=Truth(Trajectory(t, poses)))


@dataclass(frozen=True)
class Drive:
    """A log with what a front end needs to map it in seconds."""

    log: SensorLog
    options: dict[str, Any]

    def of(self, frontend: str) -> dict[str, Any]:
        """Configuration of a run."""
        part = dict(self.options)
        if frontend == "segslam":
            part |= {"segslam": SEGMENTS}
        return {"frontend": part, "map": {"fuse": False}, "refine": {"use": False}}  # it is filters that are tried


SEGMENTS = {
    "segmentation": {"window": 2.0, "min_seconds": 6.0, "min_length": 5.0, "max_length": 14.0, "excluded": 3.0},
    "winnowing": {"gap": 15.0},
    "search": {"source_radius": 8.0},
    "choice": {"every": 2.0},
    "handover": {"drift_scale": 3.0},
}


def world(dim: int, seed: int = 3) -> Drive:
    """The drive in the plane or in space."""
    steps = {"max_range": RANGE, "most_points": 240, "level_floors": dim == 3}
    options = {"steps": steps, "filter": {"particles": 8, "weight_beams": 120, "walk_scale": 0.5}}
    if dim == 2:
        steps |= {"controls": {"speed": 0.02, "yaw_rate": 0.01, "heading": 0.003}, "constant_yaw_bias": 0.003}
        steps |= {"constant_scale": 0.01}
    return Drive(ring_log(seed) if dim == 2 else court_log(seed), options)
