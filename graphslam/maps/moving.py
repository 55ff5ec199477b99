"""Detection of moving objects: points in space that other submaps observed as free.

A moving car leaves points at a different place in each scan. Submaps before and after observe these places as free. A
point is dynamic if at least two neighbouring submaps know its place as free, without an occupied neighbour voxel, if
more of them do so than support it, and if enough other dynamic points are near. Ground points are excluded: grazing
beams make them look free. Objects whose place is never observed again stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, distance_transform_edt, label, mean
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.dense import CloudMap
from graphslam.core.geometry import Array
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam.evidence.spilled_grid import spill_grid

Mask = npt.NDArray[np.bool_]


NEIGHBOURS = 4
"""Submaps before and after that are compared."""
FREE = -0.8
"""Log-odds below which a voxel is free."""
LEAST_FREE = 2
"""Least number of neighbours that know a place as free."""
REACH = 30.0
"""Points farther from their sensor are not tested [m]: the beams are too sparse."""
ABOVE_GROUND, GROUND_CELL = 0.3, 1.0
"""Points lower than this above the lowest point around them are not tested; edge of the ground cells (3 × 3) [m]."""
COMPANY, COMPANY_RADIUS = 6, 0.6
"""A dynamic point needs this number of other dynamic points within this radius [m]."""
THING = 2.5
"""Points within this distance of dynamic points can belong to the same object [m]: half the length of a car."""


def moving_points(submaps: Sequence[Submap], bases: Array) -> list[Mask]:
    """Find the points of submap clouds that are on moving objects.

    Parameters
    ----------
    submaps : sequence of n Submap
        3-D, in time order; those without a grid, or without a cloud with sensor origins, are not tested.
    bases : (n, 7)
        ``T_world_base``, z up.

    Returns
    -------
    list of (m,) bool
        Mask of each submap's cloud; empty without a cloud.
    """
    clouds = [s.cloud if s.grid is not None and s.cloud is not None and s.cloud.dim == 3 else None for s in submaps]
    out = []
    for k, cloud in enumerate(clouds):
        if cloud is None or cloud.origins is None or cloud.scan is None:
            out.append(np.zeros(0 if cloud is None else len(cloud), np.bool_))
            continue
        world = _world(bases[k], cloud.points)
        near = np.linalg.norm(cloud.points - cloud.origins[cloud.scan], axis=1) < REACH
        others = [j for j in range(max(k - NEIGHBOURS, 0), min(k + NEIGHBOURS + 1, len(submaps))) if j != k]
        around = [world, *(_world(bases[j], other.points) for j in others if (other := clouds[j]) is not None)]
        asked = np.flatnonzero(near & ~near_ground(world, np.concatenate(around)))
        free, supported = np.zeros(len(asked), np.int64), np.zeros(len(asked), np.int64)
        for j in others:
            grid = submaps[j].grid
            if not isinstance(grid, EvidenceGrid):
                continue
            T = np.asarray(se3.se3_between(bases[j], bases[k]))
            state = known_state(grid, _world(T, cloud.points[asked]), FREE)
            free += state < 0
            supported += state > 0
        moved = np.zeros(len(cloud), np.bool_)
        moved[asked[(free >= LEAST_FREE) & (free > supported)]] = True
        out.append(_in_company(world, moved))
    return out


class MovedObjects:
    """Moving objects around known dynamic points, to remove them from other scans of the same time.

    :func:`moving_points` finds only some points of an object, and none near the ground. A point belongs to an object if
    it is within :data:`COMPANY_RADIUS` of a dynamic point in the plane. A connected cluster above the ground that is
    mostly so near belongs to it as a whole, with all points within that radius.

    Parameters
    ----------
    moved : (m, 3)
        Dynamic points, in a frame with the z axis upwards [m].
    """

    def __init__(self, moved: Array) -> None:
        self.moved = np.asarray(moved, dtype=np.float64)[:, :2]
        self.cell = COMPANY_RADIUS / 4.0
        if not len(self.moved):
            return
        margin = THING + COMPANY_RADIUS
        self.first = np.floor((self.moved.min(axis=0) - margin) / self.cell).astype(np.int64)
        size = np.floor((self.moved.max(axis=0) + margin) / self.cell).astype(np.int64) - self.first + 1
        away = np.ones(size, np.bool_)
        away[tuple((np.floor(self.moved / self.cell).astype(np.int64) - self.first).T)] = False
        distance = distance_transform_edt(away, sampling=self.cell)
        self.near, self.around = distance < COMPANY_RADIUS, distance < THING

    def __len__(self) -> int:
        return len(self.moved)

    def parts(self, points: Array) -> Mask:
        """Mask of the points ``(n, 3)`` of a scan on moving objects; distances are rounded."""
        out = np.zeros(len(points), np.bool_)
        if not len(self) or not len(points):
            return out
        cell = np.floor(points[:, :2] / self.cell).astype(np.int64) - self.first
        rows = np.flatnonzero(np.all((cell >= 0) & (cell < self.near.shape), axis=1))
        rows = rows[self.around[cell[rows, 0], cell[rows, 1]]]
        near = self.near[cell[rows, 0], cell[rows, 1]]
        out[rows[near]] = True
        if not near.any():
            return out
        stands = cell[rows[~near_ground(points[rows], points[rows])]]
        raised = np.zeros(self.near.shape, np.bool_)
        raised[stands[:, 0], stands[:, 1]] = True
        things, many = label(binary_dilation(raised, np.ones((3, 3))), np.ones((3, 3)))  # over gaps of three cells
        things[~raised] = 0
        share = mean(self.near, things, np.arange(1, many + 1))
        whole = np.argwhere(np.concatenate([[False], np.asarray(share) > 0.5])[things])
        if len(whole):
            ask = rows[~near]
            reach = COMPANY_RADIUS / self.cell
            out[ask] = cKDTree(whole).query(cell[ask], distance_upper_bound=reach)[0] < reach
        return out


def static_submaps(submaps: Sequence[Submap], bases: Array) -> tuple[list[Submap], tuple[int, int]]:
    """Submaps without the points on moving objects.

    Parameters
    ----------
    submaps, bases
        As for :func:`moving_points`.

    Returns
    -------
    submaps : list of Submap
    moving : (int, int)
        Number of points that were removed, and of all.
    """
    if bases.shape[1] != 7 or all(s.cloud is None for s in submaps):
        return list(submaps), (0, 0)
    moving = moving_points(submaps, bases)
    return without_moving(submaps, moving), (sum(int(m.sum()) for m in moving), sum(len(m) for m in moving))


def without_moving(submaps: Sequence[Submap], moving: Sequence[Mask]) -> list[Submap]:
    """Submaps with clouds and grids rebuilt without dynamic points; the others are unchanged."""
    out = []
    for s, drop in zip(submaps, moving):
        cloud, grid = s.cloud, s.grid
        if not drop.any() or cloud is None or cloud.scan is None or not isinstance(grid, EvidenceGrid):
            out.append(s)
            continue
        assert cloud.origins is not None
        left = CloudMap(points=cloud.points[~drop], origins=cloud.origins, scan=cloud.scan[~drop], cell=cloud.cell)
        drawn = grid.empty(GridPool(grid.pool.levels))
        for k, origin in enumerate(cloud.origins):
            points = cloud.points[(cloud.scan == k) & ~drop]
            if len(points):
                drawn.insert_scan(points, np.broadcast_to(origin, points.shape))
        out.append(replace(s, cloud=left, grid=spill_grid(drawn), report={**s.report, "points_moved": int(drop.sum())}))
    return out


def _world(T: Array, points: Array) -> Array:
    return np.asarray(se3.se3_transform(T[None], points))


def known_state(grid: EvidenceGrid, points: Array, free: float) -> npt.NDArray[np.int64]:
    """State of points ``(n, 3)``: -1 free without occupied neighbours, 1 occupied or with such a neighbour, 0 other."""
    known = grid.log_odds_at(points)
    out = np.zeros(len(points), np.int64)
    asked = np.flatnonzero(np.isfinite(known))
    occupied = np.zeros(len(asked), np.bool_)
    for step in product((-1, 0, 1), repeat=3):
        occupied |= grid.occupied_at(points[asked] + grid.voxel_size * np.array(step, dtype=np.float64))
    out[asked[occupied]] = 1
    out[asked[~occupied & (known[asked] < free)]] = -1
    return out


def near_ground(points: Array, around: Array) -> Mask:
    """Mask of the points that are less than :data:`ABOVE_GROUND` above the lowest one around them."""
    cell = np.floor(around[:, :2] / GROUND_CELL).astype(np.int64)
    first = cell.min(axis=0) - 1
    size = cell.max(axis=0) - first + 2
    lowest = np.full(int(size[0] * size[1]), np.inf)
    at = cell - first
    np.minimum.at(lowest, at[:, 0] * size[1] + at[:, 1], around[:, 2])
    mine = np.floor(points[:, :2] / GROUND_CELL).astype(np.int64) - first
    low = np.full(len(points), np.inf)
    for i, j in product((-1, 0, 1), repeat=2):
        low = np.minimum(low, lowest[(mine[:, 0] + i) * size[1] + mine[:, 1] + j])
    return np.asarray(points[:, 2] - low < ABOVE_GROUND)


def _in_company(points: Array, moved: Mask) -> Mask:
    rows = np.flatnonzero(moved)
    if not len(rows):
        return moved
    tree = cKDTree(points[rows])
    many = tree.query_ball_point(points[rows], COMPANY_RADIUS, return_length=True) - 1
    out = np.zeros_like(moved)
    out[rows[many >= COMPANY]] = True
    return out
