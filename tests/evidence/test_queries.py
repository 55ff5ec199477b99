"""End points, boxes, clouds and sums against the dictionary twin, in 3-D and 2-D, also of compacted maps."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, GeometryError, GridError
from graphslam.core.geometry import se2_transform
from graphslam.core.se3 import se3_exp, se3_transform
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.evidence.pool import GridPool
from graphslam.evidence.queries import endpoint_probability
from tests.reference.evidence_twin import EvidenceTwin

V = 0.25


def pair(rng: np.random.Generator, dim: int) -> tuple[EvidenceGrid, EvidenceTwin]:
    """A grid and its twin after a few scans that see some walls again."""
    grid = EvidenceGrid(V, dim=dim)
    twin = EvidenceTwin(V, grid.model, grid.pool.half, dim)
    points = rng.normal(0, 2.0, (60, dim))
    for _ in range(3):
        origin = rng.normal(0, 0.3, dim)
        for g in (grid, twin):
            g.insert_scan(points, origin)
    return grid, twin


def probability(twin: EvidenceTwin, voxel: tuple[int, int, int], unknown: float) -> float:
    value = twin.values.get(voxel)
    return unknown if value is None else 1.0 / (1.0 + np.exp(-value / 2048.0))


@pytest.mark.parametrize("dim", [3, 2])
def test_points_find_the_voxels_they_lie_in(rng: np.random.Generator, dim: int) -> None:
    grid, twin = pair(rng, dim)
    points = rng.normal(0, 2.0, (500, dim))
    points[:50] = np.round(points[:50] / V) * V  # on faces and corners: of the voxel that begins there
    wanted = [twin.value_at(p) for p in points]
    log_odds = grid.log_odds_at(points)
    assert [None if np.isnan(x) else round(x * 2048) for x in log_odds.tolist()] == wanted
    assert (grid.known_at(points) == [w is not None for w in wanted]).all()
    assert (grid.occupied_at(points) == [w is not None and w >= 0 for w in wanted]).all()
    assert 20 < grid.known_at(points).sum() < 480
    assert grid.occupied_at(points).any()
    odd = np.full((3, dim), np.nan)
    odd[1], odd[2] = 1e7, np.inf
    assert np.isnan(grid.log_odds_at(odd)).all()
    assert not grid.known_at(odd).any()


@pytest.mark.parametrize("dim", [3, 2])
def test_end_points_of_many_grids(rng: np.random.Generator, dim: int) -> None:
    base, base_twin = pair(rng, dim)
    grids, twins, poses = [], [], []
    for _ in range(4):
        scan = rng.normal(0, 2.0, (20, dim))
        grids.append(base.copy())
        twins.append(base_twin.copy())
        grids[-1].insert_scan(scan)
        twins[-1].insert_scan(scan)
        poses.append(rng.normal(0, 0.5, 3) if dim == 2 else se3_exp(rng.normal(0, 0.4, 6)))
    points = rng.normal(0, 1.5, (80, dim))
    points[7, 1] = np.nan
    nearest = endpoint_probability(grids, poses, points, unknown=0.3)
    smooth = endpoint_probability(grids, poses, points, interpolation="trilinear", unknown=0.3)
    move = se2_transform if dim == 2 else se3_transform
    for g, (twin, pose) in enumerate(zip(twins, poses)):
        for k, p in enumerate(move(pose, points)):
            if k == 7:
                assert np.isnan([nearest[g, k], smooth[g, k]]).all()
                continue
            u = np.append(p, 0.5 * V)[:3] / V
            voxel = tuple(np.floor(u).astype(int).tolist())
            assert nearest[g, k] == pytest.approx(probability(twin, voxel, 0.3), abs=1e-6)
            low = np.floor(u - 0.5).astype(int)
            share = u - 0.5 - low
            total = 0.0
            for corner in itertools.product((0, 1), repeat=3):
                weight = np.prod(np.where(corner, share, 1.0 - share))
                total += weight * probability(twin, tuple((low + corner).tolist()), 0.3)
            assert smooth[g, k] == pytest.approx(total, abs=1e-6)
    again = endpoint_probability(grids, poses, points, unknown=0.3, threads=2)
    assert nearest.tobytes() == again.tobytes()
    assert endpoint_probability([], np.zeros((0, 7)), points).shape == (0, 80)


def test_trilinear_is_smooth_and_nearest_at_the_centres(rng: np.random.Generator) -> None:
    grid, _ = pair(rng, 3)
    pose = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
    centres = grid.occupied_cloud()
    exact = endpoint_probability([grid], pose, centres)
    np.testing.assert_allclose(endpoint_probability([grid], pose, centres, interpolation="trilinear"), exact, atol=1e-6)
    line = np.linspace(-1, 1, 2001)[:, None] * [1.0, 0.3, 0.2]
    jump = [
        np.abs(np.diff(endpoint_probability([grid], pose, line, interpolation=how))).max()
        for how in ("nearest", "trilinear")
    ]
    assert jump[0] > 0.05  # the very steps that interpolation takes away
    assert jump[1] < 0.02


def test_impossible_questions_are_refused(rng: np.random.Generator) -> None:
    grid, _ = pair(rng, 3)
    pose, point = np.array([[0.0, 0, 0, 0, 0, 0, 1]]), np.zeros((1, 3))
    with pytest.raises(ConfigError, match="interpolation"):
        endpoint_probability([grid], pose, point, interpolation="cubic")
    with pytest.raises(ConfigError, match="unknown"):
        endpoint_probability([grid], pose, point, unknown=1.5)
    with pytest.raises(GridError, match="wrong shape"):
        endpoint_probability([grid], pose, np.zeros((1, 2)))
    with pytest.raises(GridError, match="differ in number"):
        endpoint_probability([grid], np.repeat(pose, 2, 0), point)
    with pytest.raises(GeometryError, match="quaternion"):
        endpoint_probability([grid], np.zeros((1, 7)), point)
    with pytest.raises(GridError, match="box 1"):
        grid.box_query(np.zeros((2, 3)), [[1.0, 1, 1], [1, -1, 1]])
    with pytest.raises(GridError, match="box 0"):
        grid.box_query([[np.nan, 0, 0]], [[1.0, 1, 1]])
    with pytest.raises(GridError, match="level"):
        grid.binned_cloud(-1)


@pytest.mark.parametrize("dim", [3, 2])
def test_boxes(rng: np.random.Generator, dim: int) -> None:
    grid, twin = pair(rng, dim)
    low = rng.uniform(-5, 3, (25, dim))
    high = low + rng.uniform(0, 3, (25, dim))
    low[0], high[0] = -0.75, 0.75  # on faces of voxels: those beyond are only touched
    high[1] = low[1]  # no extent: the voxel it lies in
    found = grid.box_query(low, high)
    for k in range(25):
        first = np.floor(low[k] / V).astype(int)
        end = np.maximum(np.ceil(high[k] / V).astype(int), first + 1)
        a, b = [0, 0, 0], [1, 1, 1]
        a[:dim], b[:dim] = first.tolist(), end.tolist()
        wanted = twin.box(tuple(a), tuple(b))
        assert (found.occupied[k], found.known[k], found.voxels[k]) == (
            wanted["occupied"], wanted["known"], wanted["all"],
        )  # fmt: skip
    assert found.voxels[0] == 6**dim
    assert found.voxels[1] == 1
    assert found.occupied.max() > 3
    everything = grid.box_query(np.full((1, dim), -np.inf), np.full((1, dim), np.inf))
    assert everything.known[0] == len(twin.values)
    assert everything.voxels[0] == 8192**dim
    assert EvidenceGrid(1.0).box_query([[0.0, 0, 0]], [[2.0, 2, 2]]).known[0] == 0


@pytest.mark.parametrize("dim", [3, 2])
def test_clouds_and_sums(rng: np.random.Generator, dim: int) -> None:
    grid, twin = pair(rng, dim)
    cloud, log_odds = grid.occupied_cloud(with_log_odds=True)
    assert cloud.shape == (len(twin.occupied_cloud()), dim)
    assert {tuple(p) for p in cloud.tolist()} == {tuple(p) for p in twin.occupied_cloud().tolist()}
    assert (log_odds == grid.log_odds_at(cloud)).all()
    for level, minimum in ((0, 1), (1, 1), (2, 2), (4, 1), (13, 1)):
        binned = grid.binned_cloud(level, minimum=minimum)
        wanted = twin.binned_cloud(level, minimum)
        order = sorted(wanted, key=lambda cell: cell[::-1])  # ascending in (z, y, x)
        assert binned.counts.tolist() == [wanted[c][1] for c in order]
        np.testing.assert_allclose(binned.points, [wanted[c][0] for c in order], atol=1e-12)
    assert len(grid.binned_cloud(2).points) < len(cloud)
    bounds, wanted_bounds = grid.bounding_box(), twin.bounds()
    assert bounds is not None
    assert wanted_bounds is not None
    for corner, wanted_corner in zip(bounds, wanted_bounds):
        np.testing.assert_allclose(corner, np.array(wanted_corner[:dim]) * V)
    assert grid.entropy() == pytest.approx(twin.entropy(), rel=1e-13)
    assert grid.known_volume() == pytest.approx(len(twin.values) * V**dim)
    counts = grid.voxel_counts()
    assert (counts.occupied, counts.known) == (len(cloud), len(twin.values))
    assert counts.free == len(twin.values) - len(cloud)


def test_empty_maps_hold_nothing() -> None:
    grid = EvidenceGrid(0.1)
    assert grid.bounding_box() is None
    unseen = EvidenceGrid(0.1)
    unseen.write_bricks([[0, 0, 0]], np.full((1, 512), UNKNOWN, np.int16))  # a brick nobody has seen a voxel of
    assert unseen.bounding_box() is None
    assert grid.occupied_cloud().shape == (0, 3)
    assert grid.binned_cloud(2).points.shape == (0, 3)
    assert (grid.entropy(), grid.known_volume(), grid.voxel_counts().known) == (0.0, 0.0, 0)
    assert np.isnan(grid.log_odds_at([[0.0, 0, 0]])).all()


def test_entropy_of_known_values() -> None:
    grid = EvidenceGrid(0.5)
    values = np.full((1, 512), UNKNOWN, np.int16)
    values[0, :3] = 0, 2048, -2048  # even odds; e to 1, 1 to e
    grid.write_bricks([[0, 0, 0]], values)
    p = 1.0 / (1.0 + np.exp(-1.0))
    one = -p * np.log(p) - (1 - p) * np.log(1 - p)
    assert grid.entropy() == pytest.approx((np.log(2.0) + 2 * one) * 0.5**3, rel=1e-14)


def test_compacted_maps_answer_the_same(rng: np.random.Generator) -> None:
    # homogeneous bricks are kept once, so that sums must count them as often as they stand in the map
    grid = EvidenceGrid(0.1, pool=GridPool(3))
    bricks = np.array(list(itertools.product(range(-8, 8), repeat=3)))
    values = np.repeat(np.int16(-400), len(bricks) * 512).reshape(-1, 512)
    mixed = rng.choice(len(bricks), 40, replace=False)
    values[mixed] = rng.choice(np.array([UNKNOWN, -400, 700], np.int16), (40, 512))
    grid.write_bricks(bricks, values)
    before = grid.copy()
    assert compact_grids(grid).bricks > 3000
    assert grid.entropy() == before.entropy()
    assert grid.voxel_counts() == before.voxel_counts()
    assert (grid.occupied_cloud() == before.occupied_cloud()).all()
    low, high = rng.uniform(-6, 0, (10, 3)), rng.uniform(0, 6, (10, 3))
    one, two = grid.box_query(low, high), before.box_query(low, high)
    assert (one.occupied == two.occupied).all()
    assert (one.known == two.known).all()
    box = grid.bounding_box()
    assert box is not None
    np.testing.assert_allclose(box, [[-6.4] * 3, [6.4] * 3])
    points = rng.uniform(-7, 7, (300, 3))
    np.testing.assert_array_equal(grid.log_odds_at(points), before.log_odds_at(points))
