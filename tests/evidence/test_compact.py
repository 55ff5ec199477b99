"""Compaction: nothing changes but the memory."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import GridError
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.compact import CompactReport, compact_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_maps import cube, grid_of_map, map_of_grid, random_map, scanned_grid
from tests.reference.evidence_pool import check_pool


def used(pool: GridPool) -> tuple[int, int]:
    return pool.used_nodes, pool.used_bricks


def test_cubes_of_one_value_are_kept_once() -> None:
    """64³ equal voxels and a second block of the same value: one brick and one node on each level."""
    voxels = cube((0, 0, 0), 64, 5) | cube((-64, 0, 0), 32, 5) | cube((-64, -64, 0), 8, -7) | {(-100, 0, 0): 5}
    grid = grid_of_map(voxels, levels=3)
    # 8³, 4³ and 1 bricks of the blocks, and that of the single voxel
    assert used(grid.pool)[1] == 512 + 64 + 1 + 1
    report = compact_grids(grid)
    check_pool(grid.pool, [grid])
    assert map_of_grid(grid) == voxels
    # of 5, of -7, and the mixed one
    assert used(grid.pool)[1] == 3
    assert report.bricks == 578 - 3
    assert report.nodes > 0
    assert compact_grids(grid) == CompactReport()  # a second time there is nothing to do
    grid.release()
    assert used(grid.pool) == (0, 0)


def test_unknown_bricks_are_dropped_and_an_emptied_map_is_empty() -> None:
    grid = grid_of_map({(0, 0, 0): 5, (3000, -2000, 7): 6})
    kept = grid.copy()
    where = grid.brick_coordinates()
    grid.write_bricks(where[:1], np.full((1, 512), UNKNOWN, np.int16))
    assert len(grid.brick_coordinates()) == 2
    report = compact_grids(grid)
    assert len(grid.brick_coordinates()) == 1
    assert (report.nodes, report.bricks) == (4, 1)  # its path, too
    grid.write_bricks(where[1:], np.full((1, 512), UNKNOWN, np.int16))
    compact_grids(grid)
    assert (grid.brick_coordinates().shape, map_of_grid(grid)) == ((0, 3), {})
    assert map_of_grid(kept) == {(0, 0, 0): 5, (3000, -2000, 7): 6}
    check_pool(grid.pool, [grid, kept])
    assert compact_grids(EvidenceGrid(0.1)) == compact_grids([]) == CompactReport()


@pytest.mark.parametrize("levels", [2, 5, 7])
def test_maps_stay_as_they_are(rng: np.random.Generator, levels: int) -> None:
    voxels = random_map(rng, 4 * 4**levels)
    grid = grid_of_map(voxels, levels=levels)
    before = used(grid.pool)
    report = compact_grids(grid)
    assert map_of_grid(grid) == voxels
    check_pool(grid.pool, [grid])
    assert used(grid.pool) == (before[0] - report.nodes, before[1] - report.bricks)
    assert report.bricks > 0


def test_a_map_without_equal_cubes_saves_nothing(rng: np.random.Generator) -> None:
    grid = grid_of_map({(8 * i, 0, 0): i for i in range(-20, 20)})
    before = used(grid.pool)
    assert compact_grids(grid) == CompactReport()
    assert used(grid.pool) == before


def test_compacted_maps_are_written_like_any_other(rng: np.random.Generator) -> None:
    """Bricks with many parents are copied when written, also many times in one scan."""
    voxels = cube((-32, -32, -32), 64, -500)
    plain, small = grid_of_map(voxels, levels=4), grid_of_map(voxels, levels=4)
    compact_grids(small)
    assert used(small.pool)[1] == 1
    for _ in range(4):
        points, origin = rng.uniform(-4, 4, (30, 3)), rng.uniform(-2, 2, 3)
        copy = small.copy()
        held = map_of_grid(copy)
        plain.insert_scan(points, origin)
        small.insert_scan(points, origin)
        check_pool(small.pool, [small, copy])
        assert map_of_grid(small) == map_of_grid(plain)
        assert map_of_grid(copy) == held
        if rng.random() < 0.5:
            compact_grids([small, copy])
    del copy
    small.release()
    assert used(small.pool) == (0, 0)


def test_what_grids_share_stays_shared(rng: np.random.Generator) -> None:
    """Copies that were written since, compacted together or one alone: memory never grows, no map changes."""
    for together in (True, False):
        parent = scanned_grid(rng, scans=3)
        full = np.full((27, 512), 1200, np.int16)
        parent.write_bricks(np.stack(np.mgrid[20:23, 20:23, 20:23], axis=-1).reshape(-1, 3), full)
        family = [parent]
        for k in range(6):
            child = family[k // 2].copy()
            child.insert_scan(rng.normal(0, 2, (10, 3)), rng.normal(0, 1, 3))
            child.write_bricks([[20, 20, 20 + k]], full[:1])
            family.append(child)
        twin = family[2].copy()
        maps = [map_of_grid(g) for g in family]
        before = used(parent.pool)
        report = compact_grids(family if together else family[3])
        after = used(parent.pool)
        assert (before[0] - after[0], before[1] - after[1]) == (report.nodes, report.bricks)
        assert report.bricks >= (26 if together else 1)  # what others hold of it is not one's own to free
        assert [map_of_grid(g) for g in family] == maps
        assert map_of_grid(twin) == maps[2]
        check_pool(parent.pool, [*family, twin])
        assert twin.same_as(family[2])


def test_locked_grids_may_be_compacted() -> None:
    grid = grid_of_map(cube((0, 0, 0), 32, 5))
    grid.lock()
    assert compact_grids(grid).bricks == 63


def test_grids_of_other_thresholds_share_no_flags() -> None:
    """The same value is occupied in one and free in the other."""
    pool = GridPool(3)
    voxels = cube((0, 0, 0), 32, 300)
    grids = [grid_of_map(voxels, pool=pool, model=BeamModel(threshold=t)) for t in (0.5, 0.9, 0.5)]
    assert grids[1].model.threshold_step > 300
    compact_grids(grids)
    assert used(pool)[1] == 2
    check_pool(pool, grids)
    assert [g.voxel_counts().occupied for g in grids] == [32**3, 0, 32**3]


def test_grids_of_other_pools_are_refused() -> None:
    grids = [grid_of_map({(0, 0, 0): 1}), grid_of_map({(0, 0, 0): 1})]
    with pytest.raises(GridError, match="different pools"):
        compact_grids(grids)
