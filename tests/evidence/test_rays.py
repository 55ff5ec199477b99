"""The traversal of the kernels against exact rays: random ones to the voxel, degenerate ones by what must hold."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_pool import assert_same
from tests.reference.evidence_twin import EvidenceTwin, ray_voxels

POOL = GridPool(levels=2)
LAW = settings(max_examples=150, deadline=None)

eighths = st.integers(-40, 40).map(lambda n: n / 8)
"""Coordinates that lie on planes, edges and corners of the lattice as often as not; exact in voxels of 1 m."""
ULP = math.ulp(POOL.half + 1.0)
"""Kernels count voxels from a corner of the cube, so this is the finest step a coordinate can take there."""
nudged = st.builds(lambda x, n: x + n * ULP, eighths, st.integers(-1, 1))
lattice_points = st.tuples(eighths, eighths, eighths)
nudged_points = st.tuples(nudged, nudged, nudged)


def traversed(origin, end, *, returns: bool = False, pool: GridPool = POOL) -> dict:
    """Voxels one beam changes in an empty grid of 1 m voxels, and their values."""
    grid = EvidenceGrid(1.0, pool=pool)
    report = grid.insert_scan([end], origin, returns=[returns])
    assert report.rays == 1
    twin = EvidenceTwin(1.0, grid.model, pool.half)
    twin.write_bricks(grid.brick_coordinates(), grid.brick_values())
    return twin.values


def touches(origin, end, voxel) -> bool:
    """Whether the segment meets the closed cube of a voxel grown by 1e-9, by exact slabs."""
    low, high = Fraction(0), Fraction(1)
    for o, e, v in zip(origin, end, voxel):
        a, b = Fraction(float(o)), Fraction(float(e))
        near, far = Fraction(v) - Fraction(1, 10**9), Fraction(v) + 1 + Fraction(1, 10**9)
        if a == b:
            if not near <= a <= far:
                return False
            continue
        t = sorted(((near - a) / (b - a), (far - a) / (b - a)))
        low, high = max(low, t[0]), min(high, t[1])
    return low <= high


def ends(origin, end) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Voxels of the ends of a ray, counted from the corner of the cube in floats as the kernels do."""
    half = POOL.half
    start = tuple(math.floor(o + half) - half for o in origin)
    return start, tuple(math.floor((o + half) + (e - o)) - half for o, e in zip(origin, end))


def check_degenerate(origin, end) -> None:
    """What holds of any ray, also through edges and corners."""
    start, last = ends(origin, end)
    free = traversed(origin, end)
    distance = sum(abs(a - b) for a, b in zip(start, last))
    assert len(free) == distance  # 6-connected, no voxel twice, the last left out
    assert last not in free
    if not distance:
        return
    assert start in free
    seen, front = {start}, [start]  # connected by faces, and to the last
    while front:
        v = front.pop()
        for axis, s in itertools.product(range(3), (-1, 1)):
            w = tuple(x + s * (i == axis) for i, x in enumerate(v))
            if w in free and w not in seen:
                seen.add(w)
                front.append(w)
    assert seen == set(free)
    assert any(sum(abs(a - b) for a, b in zip(v, last)) == 1 for v in free)
    assert all(touches(origin, end, v) for v in free)
    # within the box of the two ends: no ray goes back
    assert all(min(a, b) <= x <= max(a, b) for v in free for x, a, b in zip(v, start, last))
    hit = traversed(origin, end, returns=True)
    assert set(hit) == {*free, last}
    assert hit[last] > 0 > max(free.values())


@LAW
@given(lattice_points, lattice_points)
@example((0.0, 0.0, 0.0), (3.0, 3.0, 3.0))
@example((3.0, 0.0, 0.0), (-3.0, 0.0, 0.0))
@example((2.0, 2.0, 2.0), (-2.0, -2.0, -2.0))
@example((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))
def test_rays_through_edges_and_corners(origin, end) -> None:
    if origin != end:
        check_degenerate(origin, end)


@LAW
@given(nudged_points, nudged_points)
@example((0.0, 0.0, 0.0), (5.0, -6.1e-16, 0.0))  # a beam at -180°: its sine is not quite 0
@example((0.0, 0.0, 0.5), (5.0, -5e-324, 0.5))
@example((0.0, 3.0, 0.5), (-5.0, 3.0 - ULP, 0.5))
def test_rays_beside_planes_by_less_than_rounding(origin, end) -> None:
    if origin != end:
        check_degenerate(origin, end)


def test_random_rays_are_those_of_the_twin(rng: np.random.Generator) -> None:
    for _ in range(150):
        origin, end = rng.uniform(-1, 1, (2, 3)) * rng.choice([1.0, 8.0, 60.0], (2, 1))
        if rng.random() < 0.3:
            end[rng.integers(3)] = origin[0]
        assert set(traversed(origin, end)) == set(ray_voxels(origin, end)[:-1])


@pytest.mark.parametrize("voxel", [0.1, 0.05, 0.3, 7.0])
def test_scans_of_many_rays_are_those_of_the_twin(voxel: float, rng: np.random.Generator) -> None:
    pool = GridPool(levels=4)
    grid = EvidenceGrid(voxel, pool=pool)
    twin = EvidenceTwin(voxel, grid.model, pool.half)
    for _ in range(4):
        pose = np.concatenate([rng.uniform(-3, 3, 3) * voxel, [0.1, -0.2, 0.3, 0.927362]])
        points = rng.normal(size=(25, 3)) * 12 * voxel
        assert grid.insert_scan(points, pose=pose).rays == twin.insert_scan(points, pose=pose).rays
        assert_same(grid, twin)


@pytest.mark.parametrize("sign", [-1, 1])
def test_rays_along_the_faces_of_the_cube_stay_in_it(sign: int) -> None:
    half = POOL.half
    edge = math.nextafter(2 * half, 0) - half if sign > 0 else -float(half)
    for axis in range(3):
        a, b = np.full(3, -half + 0.3), np.full(3, half - 0.7)
        a[axis] = b[axis] = edge
        values = traversed(a, b, returns=True)
        face = half - 1 if sign > 0 else -half
        assert {v[axis] for v in values} == {face}
        check_degenerate(a, b)
    corner = np.array([edge, edge, edge])
    check_degenerate(np.zeros(3), corner)
    check_degenerate(corner, np.array([0.3, 0.1, -0.2]))


def test_no_ray_leaves_the_cube_by_a_rounding(rng: np.random.Generator) -> None:
    """Ends on the faces and beside planes by one ulp, where accumulated parameters tie: such brick coordinates would
    name a place on the other side of the cube."""
    half, n = POOL.half, 400
    kind = rng.integers(0, 4, (n, 3))
    planes = rng.integers(-60, 60, (n, 3)).astype(float)
    last = np.select([kind == 0, kind == 1, kind == 2], [-half, np.nextafter(2 * half, 0) - half, planes - ULP], planes)
    origins = np.where(rng.random((n, 3)) < 0.5, rng.uniform(-60, 60, (n, 3)), rng.integers(-60, 60, (n, 3)))
    inserted = 0
    for o, e in zip(origins, last):
        if any((x + half) + (y - x) >= 2 * half for x, y in zip(o, e)):
            continue  # rounds out of the cube: dropped and counted
        inserted += 1
        a, b = ends(o, e)
        voxels = np.array(list(traversed(o, e)))
        assert (voxels >= np.minimum(a, b) - 1).all()
        assert (voxels <= np.maximum(a, b) + 1).all()
    assert inserted > 300
