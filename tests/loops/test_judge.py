"""All loops judged together: wrong groups that bear each other out must be paid for by the chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.poses import group_of
from graphslam.loops.global_inlier_check import truncated_least_squares_inliers
from graphslam.loops.loops import LoopCloser
from graphslam.loops.measure import Loop
from tests.reference.loop_chain import chain_of, loop_of, right_loops, square_poses
from tests.reference.loop_network import LoopNetwork
from tests.reference.wrong_submap_loops import KINDS, Kind, inject_wrong_loops


def arrays(loops: list[Loop]):
    ends = np.array([[x.i, x.j] for x in loops], dtype=np.int64)
    return ends, np.stack([x.T_ij for x in loops]), np.stack([x.covariance for x in loops])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_half_of_the_loops_wrong(dim: int, kind: Kind) -> None:
    poses = square_poses(dim)
    wrong_accepted, right_accepted, right_all = 0, 0, 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        loops, wrong = inject_wrong_loops(right_loops(poses, rng, 8), poses, 0.5, rng, kind=kind, period=4.0)
        good = truncated_least_squares_inliers(*chain_of(poses, rng), arrays(loops))
        wrong_accepted += int((good & wrong).sum())
        right_accepted, right_all = right_accepted + int((good & ~wrong).sum()), right_all + int((~wrong).sum())
    assert wrong_accepted <= 3  # of 24: one group that a short chain bears, for which others must speak
    assert right_accepted >= 0.95 * right_all


def test_a_second_opinion_changes_what_was_taken_only_for_more_loops() -> None:
    """Two wrong ones came first; the judge's right ones, refused one by one, take their place."""
    poses = square_poses(3)
    T, P = chain_of(poses, np.random.default_rng(3))
    g = group_of(poses)
    off = np.zeros(6)
    off[3] = 0.4
    W = g.compose(g.compose(poses[58], g.exp(off)), g.inverse(poses[58]))
    wrong = []
    for j in (57, 59):
        x = loop_of(poses, j - 48, j, np.random.default_rng(j))
        wrong.append(replace(x, T_ij=g.between(poses[j - 48], g.compose(W, poses[j]))))
    right = [loop_of(poses, i, i + 48, np.random.default_rng(100 + i)) for i in (8, 9, 10, 11)]
    asked = []

    def judge(increments, covariances, loops):
        asked.append(len(loops[0]))
        # ends tell right from wrong here: a judge that knows
        return np.array([tuple(e) not in {(9, 57), (11, 59)} or np.allclose(z, right_at[tuple(e)])
                         for e, z in zip(loops[0].tolist(), loops[1])])  # fmt: skip

    right_at = {(x.i, x.j): x.T_ij for x in right}
    closer = LoopCloser(LoopNetwork(T, P), T, P, joint_test=judge)
    first = [d.loop for d in closer.propose(wrong)]
    assert closer.accepted == first  # nothing better is there
    closer.propose(right)
    assert asked
    assert not set(first) & set(closer.accepted)
    assert len(closer.accepted) == 4
    # a judge that believes none changes nothing
    stubborn = LoopCloser(LoopNetwork(T, P), T, P, joint_test=lambda t, p, x: np.zeros(len(x[0]), bool))
    stubborn.propose(right)
    assert len(stubborn.accepted) == 4


def test_neighbouring_nodes_are_not_judged() -> None:
    poses = square_poses(2)
    T, P = chain_of(poses, np.random.default_rng(0))
    loop = loop_of(poses, 4, 5, np.random.default_rng(0), np.array([9.0, 0.0, 0.0]))
    assert truncated_least_squares_inliers(T, P, arrays([loop])).tolist() == [True]
