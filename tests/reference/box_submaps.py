"""Submaps of halls made of boxes: evidence grids of scans along a path, in the frame of their own base."""

from __future__ import annotations

import numpy as np

from graphslam.core import se3
from graphslam.core.dense import CloudMap
from graphslam.core.geometry import Array
from graphslam.evidence.grid import EvidenceGrid
from tests.reference.box_world import BoxWorld, around, heading


def straight_path(x0: float, x1: float, y: float, z: float = 1.0, step: float = 1.5, yaw: float = 0.0) -> Array:
    """Level poses ``(n, 7)`` along x; towards falling x where ``x1 < x0``."""
    n = max(round(abs(x1 - x0) / step), 1) + 1
    return np.array([heading(x, y, z, yaw) for x in np.linspace(x0, x1, n)])


def mapped(world: BoxWorld, path: Array, rng: np.random.Generator, *, believed: Array | None = None) -> EvidenceGrid:
    """Grid of scans from true poses ``path (n, 7)``, put where they are ``believed`` to be seen from the first."""
    grid = EvidenceGrid(0.2)
    where = path if believed is None else believed
    for true, at in zip(path, se3.se3_between(np.broadcast_to(where[0], where.shape), where)):
        grid.insert_scan(world.scan(true, around(rng, 1200, -0.7, 0.7), 0.025, 20.0, rng), pose=at)
    return grid


def clouded(
    world: BoxWorld, path: Array, rng: np.random.Generator, *, believed: Array | None = None, origins: bool = True
) -> CloudMap:
    """The same scans as a cloud, with or without the places from which they were taken."""
    where = path if believed is None else believed
    at = se3.se3_between(np.broadcast_to(where[0], where.shape), where)
    scans = [world.scan(T, around(rng, 1200, -0.7, 0.7), 0.025, 20.0, rng) for T in path]
    points = np.concatenate([se3.se3_transform(T, p) for T, p in zip(at, scans)])
    if not origins:
        return CloudMap(points=points)
    return CloudMap(points=points, origins=at[:, :3], scan=np.repeat(np.arange(len(at)), [len(p) for p in scans]))


def drifted(path: Array, rng: np.random.Generator, along: float = 0.01, turn: float = 1e-3) -> Array:
    """The path as dead reckoning has it: every step off by ``along`` [m] and ``turn`` [rad], and a bias of the turn."""
    bias = turn * rng.standard_normal()
    out = [path[0]]
    for step in se3.se3_between(path[:-1], path[1:]):
        e = np.concatenate([[0.0, 0.0, bias + turn * rng.standard_normal()], along * rng.standard_normal(2), [0.0]])
        out.append(se3.se3_compose(out[-1], se3.se3_compose(step, se3.se3_exp(e))))
    return np.stack(out)
