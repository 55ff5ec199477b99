"""What maps say of two solutions: the right one, nothing where the world repeats itself, and seldom the wrong one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.loops.conflicting_groups import choose_group
from graphslam.loops.loops import LoopCloser
from graphslam.loops.map_overlap_test import ERROR, FEWEST, disagreement_shares, overlap_log_likelihood_ratio
from graphslam.loops.measure import Loop
from tests.reference.loop_chain import chain_of, loop_of, square_poses
from tests.reference.loop_network import LoopNetwork


def shares(rng: np.random.Generator, angle: float, n: int) -> Array:
    return np.sin(np.abs(rng.normal(angle, 0.05, n))) ** 2


def test_maps_tell_which_solution_is_right(rng) -> None:
    right, moved = shares(rng, 0.05, 30), shares(rng, 0.4, 30)
    good, bad = shares(rng, 0.05, 3), shares(rng, 0.4, 3)
    ratio = overlap_log_likelihood_ratio(right, moved, good, bad)
    assert ratio > -np.log(ERROR)
    assert overlap_log_likelihood_ratio(right, moved, bad, good) == pytest.approx(-ratio)
    assert choose_group(np.full(3, 1.0), np.full(2, 500.0), ratio)[0] == "changes"
    assert choose_group(np.full(2, 500.0), np.full(3, 1.0), -ratio)[0] == "stays"
    # both solutions are wrong alike, or too few tell how maps lie on each other
    assert overlap_log_likelihood_ratio(right, moved, bad, bad) == pytest.approx(0.0, abs=1e-9)
    assert overlap_log_likelihood_ratio(right[: FEWEST - 1], moved, good, bad) == 0.0
    # of one loop alone nothing but the maps is believed
    assert choose_group(np.full(3, 500.0), np.full(1, 1.0), 1.0)[0] == "stays"


def test_maps_say_nothing_where_the_world_repeats_itself(rng) -> None:
    decided = 0
    for _ in range(500):
        args = [shares(rng, 0.1, n) for n in (20, 20, 4, 4)]
        decided += abs(overlap_log_likelihood_ratio(*args)) > -np.log(ERROR)
    assert decided <= 5


@pytest.mark.parametrize("apart", [0.02, 0.05, 0.1])
def test_maps_seldom_decide_wrongly(rng, apart: float) -> None:
    """Markov's bound, of laws that are learnt: 2000 draws, of which 2 may be wrong; 3 σ beyond that are 6."""
    wrong = 0
    for _ in range(2000):
        args = [shares(rng, a, n) for a, n in ((0.3, 30), (0.3 + apart, 60), (0.3, 6), (0.3 + apart, 6))]
        wrong += overlap_log_likelihood_ratio(*args) < np.log(ERROR)
    assert wrong <= 6


def test_places_of_one_pair_of_submaps_are_one_piece_of_evidence() -> None:
    poses = square_poses(2)
    x = loop_of(poses, 3, 51, np.random.default_rng(0))
    loops = [replace(x, submaps=p) for p in ((0, 4), (4, 0), (1, 4))]
    assert disagreement_shares(loops, np.array([0.1, 0.3, 0.5])).tolist() == pytest.approx([0.2, 0.5])


def test_one_right_loop_stands_against_three_wrong_ones_by_what_the_maps_say() -> None:
    poses = square_poses(3, side=60, nodes=420)
    g, rng = group_of(poses), np.random.default_rng(4)
    off = np.array([0.0, 0, 0, 2.0, 0, 0])

    def named(x: Loop) -> Loop:
        return replace(x, submaps=(x.i // 4, x.j // 4))

    W = g.compose(g.compose(poses[401], g.exp(off)), g.inverse(poses[401]))
    calm = [named(loop_of(poses, i, i + 240, rng)) for i in range(0, 48, 4)]
    wrong = []
    for i in (160, 161, 162):
        x = loop_of(poses, i, i + 240, rng)
        wrong.append(named(replace(x, T_ij=g.between(poses[i], g.compose(W, poses[i + 240])))))
    one = named(loop_of(poses, 163, 403, rng))

    def map_check(loops: Sequence[Loop], T: Array) -> Array:
        true = g.between(poses[[x.i for x in loops]], poses[[x.j for x in loops]])
        away = np.linalg.norm(g.log(g.between(true, T))[:, 3:], axis=1)
        return np.where(away > 1.0, 0.2, 0.004) + 0.003 * rng.random(len(loops))

    outcomes = []
    for asked in (None, map_check):
        T, P = chain_of(poses, np.random.default_rng(7))
        closer = LoopCloser(LoopNetwork(T, P), T, P, map_check=asked)
        closer.propose([*calm, *wrong])
        (d,) = closer.propose([one])
        outcomes.append((len(closer.accepted), d.verdict))
        if asked is not None:
            assert all("the maps say so" in closer.ledger.of(n).why for n in range(12, 15))
    assert outcomes == [(15, "rejected"), (13, "accepted")]
