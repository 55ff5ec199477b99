"""Entropy of fused maps, and the clearest of several candidates."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.beams import BeamModel
from graphslam.maps.entropy import grid_placements, mean_map_entropy
from graphslam.maps.fuse import fuse_pieces
from graphslam.maps.minimum_entropy import MapHypothesis, rank_by_entropy, visiting_order
from graphslam.maps.pieces import piece_of_grid
from tests.reference.plain_fuse import fused_voxels
from tests.reference.small_maps import room, same_map, scanned, some_pose


def plain_entropy(voxels: dict[tuple[int, int, int], int], volume: float) -> float:
    """Eq. 20-22, a voxel at a time."""
    total = 0.0
    for value in voxels.values():
        p = 1.0 / (1.0 + np.exp(-value / 2048))
        total += volume * -(p * np.log(p) + (1 - p) * np.log(1 - p))
    return total


@pytest.mark.parametrize("dim", [2, 3])
def test_entropy_is_that_of_the_voxels_one_by_one(dim: int, rng: np.random.Generator) -> None:
    pieces = {k: piece_of_grid(scanned(rng, dim)) for k in range(2)}
    poses = {k: some_pose(rng, dim) for k in pieces}
    fused = fuse_pieces(pieces, poses)
    voxels = fused_voxels(pieces, poses, BeamModel().clamp_steps)
    assert fused.entropy() == pytest.approx(plain_entropy(voxels, 0.25**dim), rel=1e-12)
    assert fused.known_volume() == pytest.approx(len(voxels) * 0.25**dim)
    # the same seen twice is clearer; of the same volume
    twice = fuse_pieces(dict.fromkeys("ab", pieces[0]), dict.fromkeys("ab", poses[0]))
    once = fuse_pieces({0: pieces[0]}, {0: poses[0]})
    assert twice.entropy() < 0.9 * once.entropy()
    assert twice.known_volume() == once.known_volume()


def test_clarity_is_the_mean_over_placements(rng: np.random.Generator) -> None:
    pieces = {k: piece_of_grid(scanned(rng, 3)) for k in range(2)}
    poses = {k: some_pose(rng, 3) for k in pieces}
    maps = [
        fuse_pieces(pieces, {k: SE3.compose(T, p) for k, p in poses.items()}, tolerance=0.0)
        for T in grid_placements(3, 0.25, 3)
    ]
    mean = mean_map_entropy(maps)
    assert mean.entropy == pytest.approx(np.mean([m.entropy() for m in maps]), rel=1e-12)
    assert mean.volume == pytest.approx(np.mean([m.known_volume() for m in maps]), rel=1e-12)
    with pytest.raises(DataError):
        mean_map_entropy([])


def candidates(rng: np.random.Generator, dim: int) -> list[MapHypothesis]:
    """A room seen five times; the right poses are the third, the others move one or two of the views."""
    group = SE3 if dim == 3 else SE2
    views = []
    for _ in range(5):
        xi = np.zeros(group.dof)
        xi[group.heading] = 0.3 * rng.normal()
        xi[group.position.start : group.position.start + 2] = 0.2 * rng.normal(size=2)
        views.append(group.exp(xi))
    pieces = {k: piece_of_grid(room(T, dim=dim, beams=3000 if dim == 3 else 600)) for k, T in enumerate(views)}
    out = []
    for wrong in ([1, 2], [2], [], [4], [1, 2, 3]):
        poses = dict(enumerate(views))
        for k in wrong:
            off = np.zeros(group.dof)
            off[group.position.start] = 0.5
            poses[k] = group.compose(group.exp(off), views[k])
        out.append(MapHypothesis(pieces, poses, f"{wrong}"))
    return out


@pytest.mark.parametrize("dim", [2, 3])
def test_candidates_come_in_the_order_of_maps_from_scratch(dim: int, rng: np.random.Generator) -> None:
    given = candidates(rng, dim)
    ranking = rank_by_entropy(given)
    scratch = [fuse_pieces(c.pieces, c.poses) for c in given]
    by_index = {r.index: r for r in ranking.order}
    for k, f in enumerate(scratch):
        assert by_index[k].clarity.entropy == f.entropy()  # to the last bit
        assert by_index[k].clarity.volume == f.known_volume()
    assert [r.index for r in ranking.order] == sorted(range(5), key=lambda k: scratch[k].entropy())
    assert ranking.order[0].index == 2  # the truth is the clearest
    assert same_map(ranking.best.grid, scratch[2].grid)
    # what is equal is not made twice: five views once, and of the other four candidates no more than differs
    assert sum(r.changed for r in ranking.order) <= 5 + 1 + 1 + 2 + 3


def test_candidates_may_have_other_pieces(rng: np.random.Generator) -> None:
    given = candidates(rng, 3)
    fewer = MapHypothesis({k: given[2].pieces[k] for k in (0, 3)}, given[2].poses, "fewer")
    other = MapHypothesis({**given[2].pieces, 1: piece_of_grid(scanned(rng, 3, size=0.2))}, given[0].poses, "other")
    ranking = rank_by_entropy([given[0], fewer, other, given[2]])
    for r in ranking.order:
        c = [given[0], fewer, other, given[2]][r.index]
        scratch = fuse_pieces(c.pieces, {k: c.poses[k] for k in c.pieces})
        assert r.clarity.entropy == scratch.entropy()
        assert r.name == c.name
    mean = rank_by_entropy([given[0], given[2]], count=2)
    for r in mean.order:
        c = [given[0], given[2]][r.index]
        placed = [
            fuse_pieces(c.pieces, {k: SE3.compose(T, p) for k, p in c.poses.items()}, tolerance=0.0).entropy()
            for T in grid_placements(2, next(iter(c.pieces.values())).voxel_size, 3)
        ]
        assert r.clarity.entropy == pytest.approx(np.mean(placed), rel=1e-12)
    best = [given[0], given[2]][mean.order[0].index]
    assert same_map(mean.best.grid, fuse_pieces(best.pieces, best.poses).grid)  # the map itself stands as it was given


def test_visiting_order_goes_to_the_nearest() -> None:
    sets = [frozenset(s) for s in ("abc", "xyz", "abd", "abe", "xyw")]
    order = visiting_order(sets)
    assert sorted(order) == list(range(5))
    assert order[:3] == [0, 2, 3]
    assert visiting_order([frozenset()]) == [0]


def test_impossible_candidates_are_refused(rng: np.random.Generator) -> None:
    piece = piece_of_grid(scanned(rng, 2))
    good = MapHypothesis({0: piece}, {0: np.zeros(3)})
    for wrong in ([], [good, MapHypothesis({}, {})], [MapHypothesis({0: piece}, {1: np.zeros(3)})]):
        with pytest.raises(DataError):
            rank_by_entropy(wrong)
    with pytest.raises(ConfigError):
        rank_by_entropy([good], count=0)
