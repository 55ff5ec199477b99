"""Halls to register scans in, scans of them, and errors of the results."""

from __future__ import annotations

import numpy as np

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.registration.register import Registration
from graphslam.registration.target import Target
from tests.reference.box_world import BoxWorld, heading


def error3(r: Registration, T: Array) -> Array:
    return se3.se3_log(se3.se3_between(r.T_target_source, T))


def error2(r: Registration, T: Array) -> Array:
    return se2.se2_log(se2.se2_between(r.T_target_source, T))


def along(rng: np.random.Generator, step: float = 3.0) -> Array:
    return np.array([heading(x, rng.uniform(7, 11), 1.2, rng.uniform(-0.3, 0.3)) for x in np.arange(4.0, 58.0, step)])


def somewhere(rng: np.random.Generator) -> Array:
    return heading(rng.uniform(8, 52), rng.uniform(7, 11), 1.2, rng.uniform(-3, 3))


def flat_scan(world: BoxWorld, pose: Array, n: int, sigma: float, rng: np.random.Generator) -> Array:
    a = rng.uniform(-np.pi, np.pi, n)
    rays = np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    return world.scan(heading(pose[0], pose[1], 0.5, pose[2]), rays, sigma, 25.0, rng)[:, :2]


def flat_map(world: BoxWorld, rng: np.random.Generator, jitter: float = 0.0) -> Target:
    poses = [np.array([x, rng.uniform(7, 11), rng.uniform(-3, 3)]) for x in np.arange(4.0, 58.0)]
    scans = []
    for p in poses:
        moved = se2.se2_compose(p, rng.standard_normal(3) * [jitter, jitter, 0.1 * jitter])
        scans.append(se2.se2_transform(moved, flat_scan(world, p, 361, 0.025, rng)))
    return Target(np.concatenate(scans), voxel=0.1)
