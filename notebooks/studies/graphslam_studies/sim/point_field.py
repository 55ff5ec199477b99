"""A robot that flies through identified points: odometry in space, and points as a stereo or depth camera sees them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog, Truth
from graphslam.core.poses import SE3
from graphslam.core.random import SeedTree
from graphslam.core.records import Odometry, PointObservations
from graphslam.core.se3 import (
    quat_rotate,
    se3_between,
    se3_compose,
    se3_exp,
    se3_inverse,
    se3_transform,
    so3_exp,
)
from graphslam.core.trajectory import Trajectory

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class PointFieldConfig:
    """A flight and its sensors."""

    seconds: float = 150.0
    speed: float = 1.0
    """Along x of the base [m/s]."""
    half_width: float = 12.0
    """Beyond this distance from the start it turns back [m]."""
    points: int = 300
    rate: float = 10.0
    """Of the odometry [1/s]."""
    sigma_turn: float = 0.3
    """σ of each component of the rotation between two records [deg]."""
    sigma_shift: float = 0.02
    """σ of each component of the shift between two records [m]."""
    scan_rate: float = 2.0
    sigma_point: float = 0.1
    """σ of each coordinate of a point [m]."""
    max_range: float = 10.0
    min_depth: float = 0.5
    """Points less far ahead than this are not seen [m]."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            if not (np.isfinite(getattr(self, f.name)) and getattr(self, f.name) > 0):
                raise ConfigError(f"{f.name} = {getattr(self, f.name)}; wanted > 0")
        if self.scan_rate > self.rate:
            raise ConfigError(f"scan_rate = {self.scan_rate}; wanted at most the rate of the odometry, {self.rate}")


PRESETS: Mapping[str, PointFieldConfig] = {
    "flight": PointFieldConfig(),
    "drift": PointFieldConfig(sigma_turn=2.5, sigma_shift=0.05),
    "quick": PointFieldConfig(seconds=40.0, points=120),
}


def point_field_preset(name: str, **changes: Any) -> PointFieldConfig:
    """A preset with some figures changed."""
    if name not in PRESETS:
        raise UnknownNameError("point-field preset", name, PRESETS)
    known = {f.name for f in dataclasses.fields(PointFieldConfig)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise UnknownNameError("figure of the point field", unknown[0], sorted(known))
    return dataclasses.replace(PRESETS[name], **changes)


def simulate_point_field(config: PointFieldConfig, seed: int) -> SensorLog:
    """A log with its truth; route, points and noise are drawn.

    Returns
    -------
    SensorLog
        Streams ``odometry`` and ``points``; everything in the frame of the first base.
    """
    c = config
    branch = SeedTree(seed).child("point-field")
    rng = branch.child("world").generator()
    poses = _fly(c, rng)
    low, high = poses[:, :3].min(axis=0) - 0.8 * c.max_range, poses[:, :3].max(axis=0) + 0.8 * c.max_range
    marks = rng.uniform(low, high, (c.points, 3))
    rng = branch.child("odometry").generator()
    times = np.arange(len(poses)) / c.rate
    sigma = np.repeat([np.deg2rad(c.sigma_turn), c.sigma_shift], 3)
    exact = se3_between(poses[:-1], poses[1:])
    noisy = se3_compose(exact, se3_exp(sigma * rng.standard_normal((len(exact), 6))))
    odometry = Odometry(
        times=times,
        increments=np.vstack([SE3.identity, noisy]),
        covariances=np.tile(np.diag(sigma**2), (len(times), 1, 1)),
    )
    rng = branch.child("points").generator()
    at = np.arange(0, len(poses), round(c.rate / c.scan_rate))
    points, ids, counts = [], [], []
    for k in at:
        seen = se3_transform(se3_inverse(poses[k]), marks)
        which = np.flatnonzero((np.linalg.norm(seen, axis=1) < c.max_range) & (seen[:, 0] > c.min_depth))
        points.append(seen[which] + c.sigma_point * rng.standard_normal((len(which), 3)))
        ids.append(which)
        counts.append(len(which))
    observations = PointObservations(
        times=times[at],
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=np.vstack(points),
        covariances=np.tile(c.sigma_point**2 * np.eye(3), (sum(counts), 1, 1)),
        ids=np.concatenate(ids).astype(np.int64),
    )
    truth = Truth(Trajectory(times, poses), landmark_ids=np.arange(c.points), landmarks=marks)
    return SensorLog(
        name="point-field",
        streams={"odometry": odometry, "points": observations},
        truth=truth,
        meta={"world": "point-field", "config": dataclasses.asdict(c), "seed": int(seed)},
    )


def _fly(c: PointFieldConfig, rng: np.random.Generator) -> Array:
    """True poses ``(n, 7)`` at the rate of the odometry: its rates of turn wander, and far off it turns home."""
    n, dt = round(c.seconds * c.rate), 1.0 / c.rate
    poses = np.tile(SE3.identity, (n + 1, 1))
    rates = np.zeros(3)
    for k in range(n):
        off = float(np.linalg.norm(poses[k, :3]))
        home = quat_rotate(poses[k, 3:] * _CONJUGATE, -poses[k, :3]) / max(off, 1e-9)
        wanted = 0.5 * np.cross([1.0, 0.0, 0.0], home) if off > c.half_width else np.zeros(3)
        rates = rates + dt * (wanted - rates) / 1.5 + 0.15 * np.sqrt(dt) * rng.standard_normal(3)
        step = np.concatenate([[c.speed * dt, 0.0, 0.0], so3_exp(rates * dt)])
        poses[k + 1] = se3_compose(poses[k], step)
    return poses
