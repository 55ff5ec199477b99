"""Memory shared and private: what is said to be freed is freed."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import GridError
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.memory import measure_memory
from graphslam.evidence.pool import BRICK_BYTES, NODE_BYTES


def reached(grids: list[EvidenceGrid]) -> tuple[int, int]:
    """Nodes and bricks below some grids, by sets."""
    pool = grids[0].pool
    layer = {g.root for g in grids if g.root}
    nodes = set(layer)
    for _ in range(pool.levels - 1):
        layer = {int(c) for n in layer for c in pool.tree.children[n] if c}
        nodes |= layer
    return len(nodes), len({int(c) for n in layer for c in pool.tree.children[n] if c})


def family(rng: np.random.Generator) -> list[EvidenceGrid]:
    """Grids that share history: copies of copies, some of them written since, some the very same tree."""
    grids = [EvidenceGrid(0.2)]
    grids[0].insert_scan(rng.normal(0, 3, (60, 3)))
    for _ in range(9):
        child = grids[rng.integers(len(grids))].copy()
        if rng.random() < 0.7:
            child.insert_scan(rng.normal(0, 3, (4, 3)), rng.normal(0, 1, 3))
        grids.append(child)
    grids.append(grids[0].empty())
    return grids


@pytest.mark.parametrize("compacted", [False, True])
def test_private_memory_is_what_a_release_frees(rng: np.random.Generator, compacted: bool) -> None:
    some_private = some_shared = 0
    for _ in range(12):
        grids = family(rng)
        pool = grids[0].pool
        if compacted:
            compact_grids(grids)
        chosen = [grids[k] for k in rng.choice(len(grids), rng.integers(1, 8), replace=False)]
        memory = measure_memory(chosen)
        assert (memory.nodes, memory.bricks) == reached(chosen)
        assert memory.total == memory.nodes * NODE_BYTES + memory.bricks * BRICK_BYTES
        assert memory.shared == memory.total - memory.private >= 0
        nodes, bricks = pool.used_nodes, pool.used_bricks
        for g in chosen:
            g.release()
        assert (memory.private_nodes, memory.private_bricks) == (nodes - pool.used_nodes, bricks - pool.used_bricks)
        some_private += memory.private > 0
        some_shared += memory.shared > 0
    assert some_private > 2
    assert some_shared > 2


def test_a_copy_costs_nothing_and_a_write_what_it_changes(rng: np.random.Generator) -> None:
    grid = EvidenceGrid(0.2)
    grid.insert_scan(rng.normal(0, 3, (60, 3)))
    alone = grid.memory()
    assert alone.private == alone.total == grid.pool.used_bytes
    twin = grid.copy()
    assert grid.memory().private == twin.memory().private == 0
    assert measure_memory([grid, twin]).private == measure_memory([twin, grid, twin]).private == alone.total
    twin.insert_scan([[1.0, 0.0, 0.0]])
    assert 0 < twin.memory().private < 0.5 * alone.total
    assert measure_memory([grid, twin]).total == grid.pool.used_bytes
    del twin
    assert grid.memory() == alone


def test_everything_together_is_the_pool(rng: np.random.Generator) -> None:
    grids = family(rng)
    memory = measure_memory(grids)
    assert memory.private == memory.total == grids[0].pool.used_bytes
    assert sum(g.memory().private for g in grids) < memory.total < sum(g.memory().total for g in grids)


def test_nothing_and_strangers() -> None:
    assert measure_memory([]).total == 0
    assert EvidenceGrid(0.1).memory().total == 0
    with pytest.raises(GridError, match="different pools"):
        measure_memory([EvidenceGrid(0.1), EvidenceGrid(0.1)])
