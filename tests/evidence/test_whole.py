"""Bad input: a clear error or a counted drop, and every grid whole afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, GeometryError, GridError, GridLockedError
from graphslam.evidence.batch import update_grids
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam.evidence.queries import INSIDE
from tests.reference.evidence_pool import assert_same
from tests.reference.evidence_world import IDENTITY, ORIGIN, VOXEL, World

NAN, INF = float("nan"), float("inf")


@pytest.fixture
def world() -> Iterator[World]:
    w = World()
    yield w
    w.check()
    for k in range(3):  # and still of use
        w.insert(k, w.scan)
    w.check()
    for g in w.grids:
        g.release()
    assert w.pool.used_nodes == w.pool.used_bricks == 0


@pytest.mark.parametrize("size", [0, 0.0, -0.1, NAN, INF, None, "0.1", [0.1]])
def test_impossible_voxel_sizes_are_refused(size: Any) -> None:
    with pytest.raises(GridError, match="voxel size"):
        EvidenceGrid(size)


@pytest.mark.parametrize("dim", [0, 1, 4, None])
def test_impossible_dimensions_are_refused(dim: Any) -> None:
    with pytest.raises(GridError, match="dimension"):
        EvidenceGrid(0.1, dim=dim)


@pytest.mark.parametrize("levels", [-1, 0, 1, 8, 2.5])
def test_impossible_pools_are_refused(levels: Any) -> None:
    with pytest.raises(GridError, match="levels"):
        GridPool(levels=levels)


@pytest.mark.parametrize(
    "wrong",
    [
        {"hit": 0.5},
        {"hit": 1.0},
        {"miss": 0.0},
        {"miss": 0.6},
        {"hit": NAN},
        {"clamp": (0.6, 0.9)},
        {"clamp": (0.0, 0.9)},
        {"threshold": 0.99},
        {"threshold": NAN},
        {"clamp": (1e-9, 0.97)},
    ],
)
def test_impossible_beam_models_are_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match="beam model"):
        BeamModel(**wrong)


@pytest.mark.parametrize(
    "arguments",
    [
        {"points": np.zeros(3)},
        {"points": np.zeros((4, 2))},
        {"points": np.zeros((4, 4))},
        {"points": np.zeros((2, 4, 3))},
        {"points": np.ones((4, 3)), "origin": np.zeros(2)},
        {"points": np.ones((4, 3)), "origin": np.zeros((3, 3))},
        {"points": np.ones((4, 3)), "returns": np.ones(3, bool)},
        {"points": np.ones((4, 3)), "returns": np.ones((4, 1), bool)},
        {"points": np.ones((4, 3)), "max_range": 0.0},
        {"points": np.ones((4, 3)), "max_range": -1.0},
        {"points": np.ones((4, 3)), "max_range": NAN},
        {"points": np.ones((4, 3)), "pose": np.zeros(7)},
        {"points": np.ones((4, 3)), "pose": IDENTITY * NAN},
        {"points": np.ones((4, 3)), "pose": IDENTITY[:6]},
        {"points": np.ones((4, 3)), "pose": np.zeros(3)},
        {"points": np.ones((4, 3)), "pose": 2 * np.eye(4)},
        {"points": np.ones((4, 3)), "pose": np.diag([-1.0, 1, 1, 1])},
    ],
)
def test_scans_that_make_no_sense_are_refused_whole(world: World, arguments: dict) -> None:
    with pytest.raises((GridError, GeometryError), match="wanted"):
        world.grids[1].insert_scan(**arguments)
    world.check()


def test_beams_that_cannot_be_used_are_dropped_and_counted(world: World) -> None:
    far = world.pool.half * VOXEL
    good = [[1.0, 0.3, 0.2], [0.4, -1.2, 0.7]]
    bad = [[NAN, 0, 0], [0, INF, 0], [0, 0, -INF], [far, 0.1, 0.1], [0.1, -far - 0.01, 0], [1e308, 1e308, 0]]
    report = world.grids[1].insert_scan([*bad[:3], *good, *bad[3:], ORIGIN], ORIGIN)
    assert (report.rays, report.not_finite, report.zero_length, report.outside) == (2, 4, 1, 2)
    assert report.dropped == 7
    world.twins[1].insert_scan(good, ORIGIN)
    world.check()
    # the same of beam origins, each beam's its own
    origin = np.array([ORIGIN, [NAN, 0, 0], [far + 1, 0, 0]])
    report = world.grids[1].insert_scan(np.array([good[0]] * 3), origin)
    assert (report.rays, report.not_finite, report.outside) == (1, 1, 1)
    world.twins[1].insert_scan(good[:1], ORIGIN)
    # a long beam that is cut within the cube is of use
    report = world.grids[2].insert_scan([[3 * far, 0.1, 0.2]], ORIGIN, max_range=2.0)
    assert (report.rays, report.cut, report.outside) == (1, 1, 0)
    world.twins[2].insert_scan([[3 * far, 0.1, 0.2]], ORIGIN, max_range=2.0)


def test_a_scan_of_nothing_changes_nothing(world: World) -> None:
    root = world.grids[1].root
    for points in (np.zeros((0, 3)), np.full((5, 3), NAN)):
        report = world.grids[1].insert_scan(points)
        assert report.rays == 0
        assert report.bricks == 0
    assert root  # the map is still there
    assert world.grids[2].empty().insert_scan(np.zeros((0, 3))).rays == 0


def test_an_origin_inside_an_occupied_voxel(world: World) -> None:
    wall = np.array([[1.1, 0.1, 0.1]])
    for _ in range(5):
        world.insert(0, wall)
    assert world.twins[0].occupied((4, 0, 0))
    for g, t in zip(world.grids[:1], world.twins[:1]):
        found = g.cast(wall[0], [[1.0, 0.2, 0.1]], 5.0)
        assert (found.status[0], found.ranges[0]) == (INSIDE, 0.0)
        # a beam that starts there passes it, as it passes every voxel before its end
        g.insert_scan([[2.6, 0.1, 0.1]], wall[0])
        t.insert_scan([[2.6, 0.1, 0.1]], wall[0])


def test_locked_grids_do_not_change(world: World) -> None:
    locked = world.grids[1]
    locked.lock()
    for write in (
        lambda: locked.insert_scan(world.scan),
        lambda: locked.merge(world.grids[0]),
        lambda: locked.write_bricks([[0, 0, 0]], np.zeros((1, 512), np.int16)),
    ):
        with pytest.raises(GridLockedError, match="locked"):
            write()
    world.check()
    report = update_grids(world.grids, world.poses, world.scan, origin=ORIGIN)
    assert report.locked == 1
    for k in (0, 2):
        world.twins[k].insert_scan(world.scan, ORIGIN, pose=world.poses[k])
    assert not locked.copy().locked
    locked.unlock()


def test_grids_that_do_not_belong_together_are_refused_whole(world: World) -> None:
    g = world.grids
    stranger = EvidenceGrid(VOXEL)
    finer = EvidenceGrid(VOXEL / 2, pool=world.pool)
    other_model = EvidenceGrid(VOXEL, pool=world.pool, model=BeamModel(hit=0.9))
    flat = EvidenceGrid(VOXEL, pool=world.pool, dim=2)
    for other in (stranger, finer, other_model, flat, g[0]):
        with pytest.raises(GridError):
            update_grids([g[0], g[1], other], world.poses, world.scan)
    for poses in (world.poses[:2], np.tile(world.poses, (2, 1))):
        with pytest.raises(GridError, match="number"):
            update_grids(g, poses, world.scan)
    with pytest.raises(GeometryError):
        update_grids(g, world.poses * [1, 1, 1, 1, 1, 1, NAN], world.scan)
    with pytest.raises(ConfigError):
        update_grids(g, world.poses, world.scan, threads=0)
    for other in (finer, flat):
        with pytest.raises(GridError):
            g[0].merge(other)
    far = world.pool.half * VOXEL
    with pytest.raises(GridError, match="cube"):
        g[0].merge(g[1], np.array([far, 0, 0, 0, 0, 0, 1]))
    with pytest.raises(GeometryError):
        g[0].merge(g[1], np.zeros(7))
    assert update_grids([], np.zeros((0, 7)), world.scan).rays == 0


def test_bricks_that_make_no_sense_are_refused_whole(world: World) -> None:
    edge = world.pool.half // 8
    one = np.zeros((1, 512), np.int16)
    for where, what in (
        ([[0, 0]], one),
        ([[0, 0, 0]], one[:, :64]),
        ([[0, 0, 0]], one.astype(np.int32)),
        ([[0, 0, 0], [1, 0, 0]], one),
        ([[0, 0, 0], [0, 0, 0]], np.tile(one, (2, 1))),
        ([[1, 0, 0], [edge, 0, 0]], np.tile(one, (2, 1))),
        ([[1, 0, 0], [0, 0, -edge - 1]], np.tile(one, (2, 1))),
    ):
        with pytest.raises(GridError):
            world.grids[1].write_bricks(where, what)
        world.check()


@pytest.mark.parametrize("copied", [False, True])
def test_values_beyond_the_clamps_do_not_overflow(world: World, copied: bool) -> None:
    """Bricks of files may hold any value: adding a step to it comes to the clamp, not around to the other sign."""
    values = np.array([-32767, -32000, -31938, 0, 31032, 31940, 32767, -32768], np.int16)
    for _ in range(2):
        bricks = np.random.default_rng(3).choice(values, (8, 512))
        where = np.stack(np.meshgrid(*[[-1, 0]] * 3), -1).reshape(-1, 3)
        world.grids[1].write_bricks(where, bricks)
        world.twins[1].write_bricks(where, bricks)
        world.check()
        before = world.grids[1].copy() if copied else None
        world.insert(1, np.random.default_rng(4).normal(size=(40, 3)))
        assert_same(world.grids[1], world.twins[1])
        del before
    world.check()
