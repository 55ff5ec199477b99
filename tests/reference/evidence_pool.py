"""What a pool of evidence grids must look like, computed from the roots alone with dictionaries and loops."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from tests.reference.evidence_twin import EvidenceTwin

UNKNOWN = -32768


def check_pool(pool: Any, grids: Iterable[Any]) -> None:
    """Recount every reference, recompute every flag, and compare with what the pool holds.

    Parameters
    ----------
    pool : GridPool
    grids : every living grid of the pool
    """
    pool.collect()
    grids = list(grids)
    assert all(g.pool is pool for g in grids)
    thresholds = {g.root: g.model.threshold_step for g in grids if g.root}
    children, node_ref, node_occupied, node_free, bricks, brick_ref, brick_lines, brick_free, counters = pool.tree[:9]

    # references, level by level from the roots: a root has its owner, everything else its parents
    nodes: Counter[int] = Counter(thresholds.keys())
    brick_count: Counter[int] = Counter()
    level_of: dict[int, int] = {}
    layer = sorted(thresholds)
    for level in range(pool.levels - 1, -1, -1):
        below: Counter[int] = Counter()
        for n in layer:
            assert n not in level_of, f"node {n} stands on levels {level_of[n]} and {level}"
            level_of[n] = level
            for child in children[n].tolist():
                if child:
                    below[child] += 1
        if level == 0:
            brick_count = below
        else:
            nodes += below
            layer = sorted(below)
    for n, count in nodes.items():
        assert node_ref[n] == count, f"node {n} of level {level_of[n]}: {node_ref[n]} references, {count} parents"
    for b, count in brick_count.items():
        assert brick_ref[b] == count, f"brick {b}: {brick_ref[b]} references, {count} parents"

    # everything that was ever taken is either reachable or on the stack, once
    for name, alive, stack, used, free in (
        ("nodes", set(nodes), node_free, counters[0], counters[1]),
        ("bricks", set(brick_count), brick_free, counters[2], counters[3]),
    ):
        waiting = stack[:free].tolist()
        assert len(set(waiting)) == len(waiting), f"{name} twice on the stack"
        assert not alive & set(waiting), f"{name} both alive and free: {sorted(alive & set(waiting))[:5]}"
        assert alive | set(waiting) == set(range(1, used)), f"{name} lost: {len(alive)}+{len(waiting)} of {used - 1}"
        capacity = len(node_ref) if name == "nodes" else len(brick_ref)
        assert used <= capacity
    assert pool.used_nodes == len(nodes)
    assert pool.used_bricks == len(brick_count)
    assert len(children) == len(node_occupied) == len(node_free) == len(node_ref)
    assert len(bricks) == len(brick_lines) == len(brick_free) == len(brick_ref)
    assert (bricks[0] == UNKNOWN).all(), "brick 0 was written to"
    assert brick_lines[0] == 0
    assert (children[0] == 0).all()

    # flags, from the voxels up; grids of one tree have one threshold
    for threshold in sorted(set(thresholds.values())):
        occupied: dict[int, bool] = {}  # of the nodes of the level below
        layer = sorted(r for r, t in thresholds.items() if t == threshold)
        layers = [layer]
        for _ in range(pool.levels):
            layer = np.setdiff1d(children[layer], 0).tolist()
            layers.append(layer)
        values = bricks[layers.pop()]
        lines = ((values != UNKNOWN) & (values >= threshold)).reshape(-1, 16, 32).any(2)
        for b, line in zip(layer, (lines @ (1 << np.arange(16))).tolist()):
            assert int(brick_lines[b]) == line, f"brick {b}: wrong lines"
            occupied[b] = line != 0
        while layers:
            above: dict[int, bool] = {}
            for n in layers.pop():
                mask = sum(1 << c for c, child in enumerate(children[n].tolist()) if child and occupied[child])
                assert int(node_occupied[n]) == mask, f"node {n} of level {level_of[n]}: wrong occupied children"
                above[n] = mask != 0
            occupied = above
    check_scratch(pool)


def check_scratch(pool: Any) -> None:
    """The scratch memory is as a scan must find it."""
    for scratch in pool._scratches:
        assert (scratch.window == -1).all(), "a scan left entries in the window"
        assert not scratch.marks.any(), "a scan left marks"


def known_bricks(grid: Any) -> dict[tuple[int, int, int], list[int]]:
    """Bricks of a grid that hold a known voxel: coordinate -> 512 values; and the grid's own order is checked."""
    coordinates = np.asarray(grid.brick_coordinates())
    values = np.asarray(grid.brick_values())
    assert coordinates.shape == (len(values), 3)
    assert values.dtype == np.int16
    keys = [tuple(c) for c in coordinates.tolist()]
    assert keys == sorted(keys, key=lambda c: c[::-1]), "bricks do not ascend in (z, y, x)"
    assert len(set(keys)) == len(keys)
    return {k: v.tolist() for k, v in zip(keys, values) if (v != UNKNOWN).any()}


def assert_same(grid: Any, twin: EvidenceTwin) -> None:
    """A grid holds what its twin does, voxel by voxel."""
    got, wanted = known_bricks(grid), twin.bricks()
    assert got.keys() == wanted.keys(), f"bricks {sorted(got.keys() ^ wanted.keys())[:4]} are in one only"
    for key, brick in wanted.items():
        if got[key] != brick:
            n = next(n for n in range(512) if got[key][n] != brick[n])
            voxel = (8 * key[0] + n % 8, 8 * key[1] + n // 8 % 8, 8 * key[2] + n // 64)
            raise AssertionError(f"voxel {voxel}: got {got[key][n]}, the twin has {brick[n]}")
