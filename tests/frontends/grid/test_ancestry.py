"""Paths of particles back in time are those of particles that carry their whole past with them."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import GeometryError
from graphslam_frontends.grid.ancestry import Ancestry
from graphslam_frontends.grid.particles import systematic_resample
from tests.reference.family_tree import FamilyTree


def grow(n: int, steps: int, seed: int, prune_every: int, share: float = 0.4) -> tuple[Ancestry, FamilyTree]:
    rng = np.random.default_rng(seed)
    fast, slow = Ancestry(n, 3, prune_every=prune_every), FamilyTree(n)
    for k in range(steps):
        poses, tags = rng.normal(size=(n, 3)), rng.integers(0, 5, size=n)
        fast.record(poses, tags)
        slow.record(poses, tags)
        if rng.random() < share and k < steps - 1:
            # sorted, as systematic resampling gives them, and in any order
            chosen = systematic_resample(rng.dirichlet(np.full(n, 0.5)), rng.random())
            chosen = chosen if k % 2 else rng.permutation(chosen)
            fast.branch(chosen)
            slow.branch(chosen)
    return fast, slow


@pytest.mark.parametrize("prune_every", [0, 1, 7])
@pytest.mark.parametrize("seed", range(4))
def test_ancestry_equals_the_slow_twin(seed: int, prune_every: int) -> None:
    n = 3 + 4 * seed
    fast, slow = grow(n, 40, seed, prune_every)
    assert np.array_equal(fast.paths(), slow.paths())
    assert np.array_equal(fast.tags(), slow.tags())
    assert np.array_equal(fast.numbers(), slow.numbers())
    assert fast.survivors().tolist() == slow.survivors()
    assert fast.coalescence() == slow.coalescence()
    assert np.array_equal(fast.path(n - 1), slow.paths()[:, n - 1])
    for late in (1, 9, 40, 99):
        assert np.array_equal(fast.recent(late), slow.paths()[-late:])
    edges, alive = fast.links()
    assert {tuple(e) for e in edges[alive].tolist()} == slow.living_edges()
    assert {tuple(e) for e in edges.tolist()} <= set(slow.edges)
    if prune_every == 0:
        assert {tuple(e) for e in edges.tolist()} == set(slow.edges)


def test_particles_that_branched_after_the_last_record_are_those_they_came_from() -> None:
    fast, slow = grow(6, 12, 3, 5)
    chosen = np.array([0, 0, 0, 4, 4, 5])
    fast.branch(chosen)
    slow.branch(chosen)
    fast.prune()
    assert np.array_equal(fast.paths(), slow.paths())
    assert fast.survivors()[-1] == 3
    fast.record(np.zeros((6, 3)))
    slow.record(np.zeros((6, 3)), np.zeros(6))
    assert np.array_equal(fast.paths(), slow.paths())


def test_memory_is_bounded_by_a_row_a_step_and_the_lineages_of_late() -> None:
    n, steps = 30, 1500
    kept, _ = grow_fast(n, steps, 0)
    pruned, _ = grow_fast(n, steps, 16)
    assert kept.rows == n * steps
    back = steps - pruned.coalescence()
    # before they met there is one row a step; behind that at most N, and what was not looked at yet
    assert pruned.rows <= steps + n * (back + 16)
    assert pruned.rows < 0.15 * kept.rows
    assert np.array_equal(pruned.paths(), kept.paths())


def grow_fast(n: int, steps: int, prune_every: int) -> tuple[Ancestry, np.random.Generator]:
    rng = np.random.default_rng(1)
    tree = Ancestry(n, 3, prune_every=prune_every)
    for _ in range(steps):
        tree.record(rng.normal(size=(n, 3)))
        if rng.random() < 0.5:
            tree.branch(systematic_resample(rng.dirichlet(np.ones(n)), rng.random()))
    return tree, rng


def test_one_particle_and_none_resampled() -> None:
    alone = Ancestry(1, 7)
    assert alone.coalescence() == -1
    assert len(alone.links()[0]) == 0
    for _ in range(3):
        alone.record(np.ones((1, 7)))
    assert alone.coalescence() == 2
    never = Ancestry(4, 3)
    for _ in range(40):
        never.record(np.zeros((4, 3)))
    assert never.coalescence() == -1
    assert never.survivors().tolist() == [4] * 40
    assert never.rows == 160


def test_poses_that_do_not_fit_are_refused() -> None:
    with pytest.raises(GeometryError, match="do not fit"):
        Ancestry(4, 7).record(np.zeros((4, 3)))
    with pytest.raises(GeometryError, match="impossible ancestry"):
        Ancestry(0, 7)
