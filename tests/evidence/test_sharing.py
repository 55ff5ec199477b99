"""What several grids see alike stays one brick, and only that."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import GridError
from graphslam.evidence.batch import SERIAL_BATCH, update_grids
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam.evidence.scratch import LINE, aligned_empty, aligned_zeros
from graphslam_studies.plots.evidence import shared_bricks
from tests.reference.evidence_pool import assert_same, check_pool
from tests.reference.evidence_twin import EvidenceTwin

N = 3 * SERIAL_BATCH + 2  # several batches on one thread


def _poses(n: int) -> np.ndarray:
    poses = np.zeros((n, 7))
    poses[:, 6] = 1.0
    return poses


@pytest.mark.parametrize("threads", [1, 2])
def test_siblings_that_see_the_same_share_every_brick(threads: int, rng: np.random.Generator) -> None:
    first = EvidenceGrid(0.2, pool=GridPool(levels=4))
    first.insert_scan(rng.normal(size=(40, 3)) * 5)
    grids = [first, *(first.copy() for _ in range(N - 1))]
    scan = rng.normal(size=(40, 3)) * 5
    update_grids(grids, _poses(N), scan, threads=threads)
    # the pool holds one map's bricks, whoever came first (or fewer: new bricks may be alike within a map)
    assert first.pool.used_bricks <= len(first.brick_coordinates()) == len(grids[-1].brick_coordinates())
    np.testing.assert_array_equal(grids[-1].brick_values(), first.brick_values())
    check_pool(first.pool, grids)


def test_one_voxel_of_difference_parts_a_brick_and_no_other(rng: np.random.Generator) -> None:
    """Two grids, two poses: the scan's one long beam ends a voxel farther in one of them."""
    a = EvidenceGrid(0.1)
    b = a.copy()
    poses = _poses(2)
    poses[1, 0] = 0.1
    beam = np.array([[5.03, 0.03, 0.03]])
    update_grids([a, b], poses, beam, origin=[0.03, 0.03, 0.03])
    apart = sum(not np.array_equal(x, y) for x, y in zip(a.brick_values(), b.brick_values()))
    assert len(a.brick_coordinates()) == len(b.brick_coordinates()) == 7
    assert apart == 2  # the first brick and the last
    # those between were crossed from end to end, as was the first one of one of them: one brick for all of these
    contents = np.unique(np.concatenate([a.brick_values(), b.brick_values()]), axis=0)
    assert a.pool.used_bricks == len(contents) == 4


def test_marks_decide_and_so_does_what_was_there_before(rng: np.random.Generator) -> None:
    """The same marks on different bricks, different marks on the same brick: as twins have it."""
    pool = GridPool(levels=4)
    model = BeamModel()
    first = EvidenceGrid(0.2, pool=pool, model=model)
    grids = [first.empty() for _ in range(6)]
    twins = [EvidenceTwin(0.2, model, pool.half) for _ in grids]
    poses = _poses(6)
    poses[:, :3] = np.repeat(rng.normal(size=(2, 3)) * 0.2, 3, axis=0)
    poses[5, 0] += 0.2
    for k in range(6):
        scan = rng.normal(size=(20, 3)) * 3
        if k == 2:
            scan[:7] = scan[7:14]
        update_grids(grids, poses, scan)
        for t, p in zip(twins, poses):
            t.insert_scan(scan, pose=p)
        if k == 3:  # the second takes the place of the last three
            grids = [*grids[:3], *(grids[1].copy() for _ in range(3))]
            twins = [*twins[:3], *(twins[1].copy() for _ in range(3))]
    for g, t in zip(grids, twins):
        assert_same(g, t)
    check_pool(pool, [*grids, first])


def test_shared_bricks_are_those_that_no_update_parted(rng: np.random.Generator) -> None:
    a = EvidenceGrid(0.2, pool=GridPool(levels=4))
    a.insert_scan(rng.normal(size=(60, 3)) * 5)
    b, c = a.copy(), a.empty()
    assert shared_bricks(a, [b, c]).all()
    assert not shared_bricks(a, [c, a]).any()
    before = a.brick_values()
    b.insert_scan([[3.0, 0.1, 0.1]])
    shared = shared_bricks(a, [b])
    where = {tuple(x) for x in a.brick_coordinates()[~shared].tolist()}
    assert where == {(0, 0, 0), (1, 0, 0)}  # 3 m are two bricks of 1.6 m
    np.testing.assert_array_equal(a.brick_values(), before)
    with pytest.raises(GridError, match="pools"):
        shared_bricks(a, [EvidenceGrid(0.2)])


def test_where_the_table_is_full_bricks_are_made_and_not_shared(rng: np.random.Generator) -> None:
    scan = rng.normal(size=(60, 3)) * 8
    used = []
    for room in (2, 5, 32768):
        first = EvidenceGrid(0.2, pool=GridPool(levels=4))
        scratch = first.pool.scratch(0)
        scratch.made, scratch.made_marks = scratch.made[:room].copy(), scratch.made_marks[: room + 1].copy()
        grids = [first, *(first.copy() for _ in range(4))]
        for _ in range(2):
            update_grids(grids, _poses(5), scan)
        check_pool(first.pool, grids)
        for g in grids[1:]:
            np.testing.assert_array_equal(g.brick_values(), first.brick_values())
        used.append(first.pool.used_bricks)
    assert used[0] > used[1] > used[2]


def test_voxels_begin_where_cache_lines_do(rng: np.random.Generator) -> None:
    pool = GridPool(levels=4)
    grid = EvidenceGrid(0.2, pool=pool)
    for _ in range(3):  # the pool grows
        grid.insert_scan(rng.normal(size=(100, 3)) * 12)
        for a in (pool.tree.bricks, pool.tree.children, pool.scratch(0).marks):
            assert a.ctypes.data % LINE == 0
            assert a.flags.c_contiguous
    assert len(pool.tree.bricks) > 64
    zeros, empty = aligned_zeros((3, 5), np.int16), aligned_empty((0, 7), np.float64)
    assert zeros.shape == (3, 5)
    assert zeros.dtype == np.int16
    assert zeros.flags.writeable
    assert not zeros.any()
    assert empty.shape == (0, 7)
