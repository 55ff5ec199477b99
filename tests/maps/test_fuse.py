"""Fused maps: the twin, the laws of moving, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graphslam.core.errors import ConfigError, DataError, GeometryError, GridError
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.maps.fuse import FusedMap, fuse_pieces
from graphslam.maps.pieces import Piece, piece_of_grid
from tests.reference.plain_fuse import fused_voxels, voxels_of_grid
from tests.reference.small_maps import same_map, scanned, some_pose


@pytest.mark.parametrize("dim", [2, 3])
def test_fused_map_is_its_slow_twin(dim: int, rng: np.random.Generator) -> None:
    pieces = {k: piece_of_grid(scanned(rng, dim), some_pose(rng, dim)) for k in range(3)}
    poses = {k: some_pose(rng, dim) for k in pieces}
    fused = fuse_pieces(pieces, poses)
    wanted = fused_voxels(pieces, poses, BeamModel().clamp_steps)
    got = voxels_of_grid(fused.grid)
    assert got == wanted
    assert len(got) > 500
    # two-sided: the twin sees a millimetre and a thousandth of a probability
    poses[0] = poses[0] + np.eye(len(poses[0]))[0] * 0.01
    assert fused_voxels(pieces, poses, BeamModel().clamp_steps) != got


@pytest.mark.parametrize("dim", [2, 3])
def test_two_pieces_are_what_merging_makes_of_them(dim: int, rng: np.random.Generator) -> None:
    grids = {k: scanned(rng, dim) for k in "ab"}
    poses = {k: some_pose(rng, dim) for k in grids}
    merged = EvidenceGrid(0.25, dim=dim)
    for k, grid in grids.items():
        merged.merge(grid, poses[k])
    assert same_map(fuse_pieces({k: piece_of_grid(g) for k, g in grids.items()}, poses).grid, merged)


def test_sums_are_clamped_once_so_that_order_means_nothing(rng: np.random.Generator) -> None:
    low, high = BeamModel().clamp_steps
    c = np.zeros((1, 3), np.int64)
    values = {"up": high, "more": high, "down": low}
    pieces = {k: Piece(0.2, 3, c, np.full((1, 512), v, np.int16)) for k, v in values.items()}
    poses = dict.fromkeys(pieces, SE3.identity)
    got = {int(v) for v in fuse_pieces(pieces, poses).grid.brick_values().ravel()}
    assert got == {min(2 * high + low, high)}
    back = dict(reversed(pieces.items()))
    assert same_map(fuse_pieces(back, poses).grid, fuse_pieces(pieces, poses).grid)
    one_by_one = EvidenceGrid(0.2)  # which clamps after each
    for k in pieces:
        one_by_one.merge(fuse_pieces({k: pieces[k]}, poses).grid)
    assert int(one_by_one.brick_values()[0, 0]) == high + low != min(2 * high + low, high)


steps = st.lists(
    st.tuples(st.sampled_from(["move", "remove", "add", "nudge", "both", "copy"]), st.integers(0, 2**32 - 1)),
    min_size=1,
    max_size=6,
)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(dim=st.sampled_from([2, 3]), seed=st.integers(0, 2**32 - 1), history=steps)
def test_after_any_history_the_map_is_the_one_made_from_scratch(
    dim: int, seed: int, history: list[tuple[str, int]]
) -> None:
    rng = np.random.default_rng(seed)
    pool = {k: piece_of_grid(scanned(rng, dim, scans=2), some_pose(rng, dim)) for k in range(4)}
    fused = FusedMap(0.25, dim=dim, tolerance=0.25)
    names = [0, 1, 2]
    fused.add({k: pool[k] for k in names}, {k: some_pose(rng, dim) for k in names})
    for what, number in history:
        r = np.random.default_rng(number)
        here = list(fused.pieces)
        if what in ("move", "nudge") and here:
            spread = 1.0 if what == "move" else 0.02
            group = SE3 if dim == 3 else SE2
            chosen = [k for k in here if r.random() < 0.6]
            at = fused.poses
            fused.move({k: group.compose(at[k], some_pose(r, dim, spread)) for k in chosen})
        elif what == "remove" and here:
            fused.remove([here[int(r.integers(len(here)))]])
        elif what == "add":
            missing = [k for k in pool if k not in fused.pieces]
            fused.add({k: pool[k] for k in missing}, {k: some_pose(r, dim) for k in missing})
        elif what == "both" and here:
            k = here[0]  # replaced, while another moves
            fused.update(add={k: pool[3]}, remove=[k], poses={j: some_pose(r, dim) for j in here[:2]})
        elif what == "copy":
            other = fused.copy()
            other.move({k: some_pose(r, dim) for k in here})  # must not be felt here
        if len(fused):
            scratch = fuse_pieces(dict(fused.pieces), fused.poses)
            assert same_map(fused.grid, scratch.grid)
        assert fused.entropy() == fused.grid.entropy()
        assert fused.known_volume() == fused.grid.known_volume()


def test_pieces_stay_until_their_far_end_would_move(rng: np.random.Generator) -> None:
    grid = EvidenceGrid(0.25, dim=2)
    grid.insert_scan([[10.0, 0.0], [0.0, 10.0]])
    fused = fuse_pieces({"a": piece_of_grid(grid)}, {"a": np.zeros(3)}, tolerance=0.5)
    before = fused.grid
    far = float(np.linalg.norm(fused.pieces["a"].corners, axis=1).max())
    small = 0.9 * 0.5 * 0.25 / far  # a turn that moves the far end by less than half a voxel
    change = fused.move({"a": [0.0, 0.0, small]})
    assert (change.moved, change.held, change.summed) == (0, 1, 0)
    assert fused.grid.same_as(before)
    assert np.array_equal(fused.wanted["a"], [0.0, 0.0, small])
    assert np.array_equal(fused.poses["a"], np.zeros(3))
    # they do not creep: as much again is too much from where the piece is
    assert fused.move({"a": [0.0, 0.0, 2 * small]}).moved == 1
    assert not same_map(fused.grid, before)
    # and exactly, if that is asked for
    fused.move({"a": [0.0, 0.0, 2 * small + 1e-4]})
    assert fused.move(fused.wanted, tolerance=0).moved == 1
    assert np.array_equal(fused.poses["a"], fused.wanted["a"])


def test_only_bricks_that_a_moved_piece_touches_are_made_anew(rng: np.random.Generator) -> None:
    grids = {k: scanned(rng, 3) for k in range(4)}
    poses = {k: np.r_[20.0 * k, 0.0, 0.0, 0, 0, 0, 1.0] for k in grids}
    fused = fuse_pieces({k: piece_of_grid(g) for k, g in grids.items()}, poses)
    all_bricks = len(fused.grid.brick_coordinates())
    away = poses[2] + [0, 1.3, 0, 0, 0, 0, 0]
    change = fused.move({2: away})
    assert change.moved == 1
    assert change.written <= change.summed < 0.6 * all_bricks
    fused.move({2: poses[2]})
    assert same_map(fused.grid, fuse_pieces(dict(fused.pieces), poses).grid)


def test_what_was_given_out_does_not_change(rng: np.random.Generator) -> None:
    fused = fuse_pieces({k: piece_of_grid(scanned(rng, 3)) for k in range(2)}, {k: some_pose(rng, 3) for k in range(2)})
    grid = fused.grid
    values = grid.brick_values()
    fused.remove([0])
    assert np.array_equal(grid.brick_values(), values)
    assert fused.known_volume() < grid.known_volume()
    fused.remove([1])
    assert fused.known_volume() == fused.entropy() == 0.0


def test_bricks_that_nobody_touches_any_more_go(rng: np.random.Generator) -> None:
    fused = fuse_pieces({0: piece_of_grid(scanned(rng, 3))}, {0: SE3.identity})
    for k in range(40):
        fused.move({0: np.r_[5.0 * (k % 7), 3.0 * (k % 3), 0, 0, 0, 0, 1.0]})
    assert same_map(fused.grid, fuse_pieces(dict(fused.pieces), fused.poses).grid)
    many = len(fused.grid.brick_coordinates())
    fused._empty = 10**9
    fused.move({0: SE3.identity})
    assert len(fused.grid.brick_coordinates()) < many


def test_changes_that_nobody_counts_do_not_pile_up(rng: np.random.Generator) -> None:
    fused = fuse_pieces({0: piece_of_grid(scanned(rng, 3))}, {0: SE3.identity})
    assert fused.entropy() > 0
    for k in range(3000):
        fused._uncounted.append(np.repeat(fused._posed[0].keys, 4))
        if k % 500 == 0:
            fused.move({0: np.r_[0.1 * k, 0, 0, 0, 0, 0, 1.0]})
    assert sum(map(len, fused._uncounted)) < 400_000
    assert fused.entropy() == fused.grid.entropy()


@pytest.mark.parametrize("dim", [2, 3])
def test_threads_make_the_same_map(dim: int, rng: np.random.Generator) -> None:
    pieces = {k: piece_of_grid(scanned(rng, dim)) for k in range(5)}
    poses = {k: some_pose(rng, dim) for k in pieces}
    one, three = (fuse_pieces(pieces, poses, threads=n) for n in (1, 3))
    assert same_map(one.grid, three.grid)
    again = {k: some_pose(rng, dim) for k in pieces}
    assert one.move(again) == three.move(again)
    assert same_map(one.grid, three.copy().grid)
    with pytest.raises(ConfigError):
        FusedMap(0.25, threads=0)


def test_what_is_refused_changes_nothing(rng: np.random.Generator) -> None:
    piece = piece_of_grid(scanned(rng, 3))
    fused = fuse_pieces({"a": piece, "b": piece}, {"a": SE3.identity, "b": some_pose(rng, 3)})
    before, poses = fused.grid, fused.poses
    nan = np.full(7, np.nan)
    far = np.r_[20_000.0, 0, 0, 0, 0, 0, 1]
    flat = piece_of_grid(scanned(rng, 2))
    fine = piece_of_grid(scanned(rng, 3, size=0.5))
    cases = [
        (DataError, {"poses": {"c": SE3.identity}}),
        (DataError, {"remove": ["c"]}),
        (DataError, {"add": {"a": piece}, "poses": {"a": SE3.identity}}),
        (DataError, {"add": {"c": piece}}),
        (DataError, {"remove": ["a"], "poses": {"a": SE3.identity}}),
        (DataError, {"poses": {"a": np.zeros(3)}}),
        (GeometryError, {"poses": {"a": nan, "b": SE3.identity}}),
        (GeometryError, {"poses": {"a": np.zeros(7)}}),
        (GridError, {"poses": {"a": SE3.identity + [0.5, 0, 0, 0, 0, 0, 0], "b": far}}),
        (GridError, {"add": {"c": flat}, "poses": {"c": SE3.identity}}),
        (GridError, {"add": {"c": fine}, "poses": {"c": SE3.identity}}),
        (ConfigError, {"poses": {"a": SE3.identity}, "tolerance": -1.0}),
    ]
    for error, arguments in cases:
        with pytest.raises(error):
            fused.update(**arguments)
        assert fused.grid.same_as(before)
        assert set(fused.pieces) == set(fused.wanted) == {"a", "b"}
        assert all(np.array_equal(fused.poses[k], poses[k]) for k in poses)
    with pytest.raises(ConfigError):
        FusedMap(0.2, tolerance=float("nan"))
    with pytest.raises(DataError):
        fuse_pieces({}, {})


def test_empty_pieces_are_carried_along() -> None:
    empty = Piece(0.2, 3, np.zeros((0, 3), np.int64), np.zeros((0, 512), np.int16))
    unknown = Piece(0.2, 3, np.zeros((1, 3), np.int64), np.full((1, 512), UNKNOWN, np.int16))
    fused = fuse_pieces({0: empty, 1: unknown}, dict.fromkeys(range(2), SE3.identity))
    assert fused.known_volume() == 0.0
    change = fused.move({0: SE3.identity + [1.0, 0, 0, 0, 0, 0, 0]})
    assert (change.moved, change.held) == (0, 1)
    assert fused.entropy() == 0.0
