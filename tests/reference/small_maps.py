"""Small evidence grids for tests of maps, and what it means that two are the same."""

from __future__ import annotations

import numpy as np

from graphslam.core.poses import SE2, SE3
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.compact import grid_pieces
from graphslam.evidence.grid import EvidenceGrid


def scanned(rng: np.random.Generator, dim: int, scans: int = 3, size: float = 0.25) -> EvidenceGrid:
    """A small round room from a few places."""
    grid = EvidenceGrid(size, dim=dim)
    for _ in range(scans):
        points = rng.normal(size=(40, dim))
        points *= (2.0 + 0.2 * rng.random((40, 1))) / np.linalg.norm(points, axis=1, keepdims=True)
        if dim == 3:
            pose = SE3.exp(np.r_[0, 0, rng.normal(), 0.5 * rng.normal(size=3)])
        else:
            pose = SE2.exp(rng.normal(size=3) * [0.5, 0.5, 1.0])
        grid.insert_scan(points, pose=pose)
    return grid


def some_pose(rng: np.random.Generator, dim: int, spread: float = 1.0) -> np.ndarray:
    """A pose about the identity."""
    group = SE3 if dim == 3 else SE2
    return group.exp(spread * rng.normal(size=group.dof))


def same_map(a: EvidenceGrid, b: EvidenceGrid) -> bool:
    """Whether every voxel is the same, whatever happened to the two before."""
    x, y = grid_pieces(a), grid_pieces(b)
    return all(
        np.array_equal(getattr(x, n), getattr(y, n)) for n in ("bricks", "values", "cubes", "log_edges", "cube_values")
    )


def straight(dim: int, length: float = 9.0, n: int = 46, lift: float = 0.0) -> Trajectory:
    """Ten seconds along x."""
    poses = np.zeros((n, 7 if dim == 3 else 3))
    poses[:, 0] = np.linspace(0.0, length, n)
    if dim == 3:
        poses[:, 2], poses[:, 6] = lift, 1.0
    return Trajectory(np.linspace(0.0, 10.0, n), poses)


def room(pose: np.ndarray, size: float = 0.2, dim: int = 3, beams: int = 4000) -> EvidenceGrid:
    """A room of 6 m × 4 m × 2.4 m (2-D: 6 m × 4 m) with a pillar, seen from its middle, in the frame of a body that
    stands at ``pose`` in the room's frame."""
    rng = np.random.default_rng(5)
    grid = EvidenceGrid(size, dim=dim)
    group = SE3 if dim == 3 else SE2
    half = np.array([3.0, 2.0, 1.2])[:dim]
    d = rng.normal(size=(beams, dim))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        reach = np.min(half / np.abs(d), axis=1)
    # a pillar of 0.6 m at (1.5, 0.5)
    lower, upper = np.array([1.2, 0.2, -9.0])[:dim], np.array([1.8, 0.8, 9.0])[:dim]
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = lower / d, upper / d
    near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    reach = np.where((near < far) & (near > 0), np.minimum(near, reach), reach)
    points = d * reach[:, None]
    inverse = group.inverse(pose)
    body = group.transform(np.broadcast_to(inverse, (beams, group.size)), points)
    grid.insert_scan(body, origin=group.transform(inverse, np.zeros(dim)))
    return grid
