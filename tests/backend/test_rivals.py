"""Two groups of loops that cannot both be right, of which nothing tells which is: both maps, kept beside the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.backend.ambiguous_maps import ambiguous_maps
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.loops.conflicting_groups import AMBIGUOUS
from graphslam.loops.graph_loops import GraphLoops, chain_of_graph
from graphslam.loops.loops import LoopCloser
from graphslam.loops.measure import Loop
from tests.loops.test_graph_loops import graph_of, submaps_of
from tests.reference.loop_chain import loop_of, square_poses

OFF = 1.5
"""What wrong loops are off by [m]: within what the chain bears over 240 m."""


def torn(dim: int) -> tuple[GraphLoops, LoopCloser, Array]:
    """Two rounds of 240 m and a bit; three right loops near their end, and three that are off by one motion."""
    poses = square_poses(dim, side=60, nodes=313)
    every, g = poses[::3], group_of(poses)  # nodes stand every 3 m
    ours = graph_of(submaps_of(poses, np.random.default_rng(5)))
    rng = np.random.default_rng(1)
    off = np.zeros(g.dof)
    off[-2 if dim == 3 else 1] = OFF
    right = [loop_of(every, k, k + 80, rng) for k in (14, 15, 16)]
    W = g.compose(g.compose(every[96], g.exp(off)), g.inverse(every[96]))
    wrong = []
    for k in (17, 18, 19):
        x = loop_of(every, k, k + 80, rng)
        wrong.append(replace(x, T_ij=g.between(every[k], g.compose(W, every[k + 80]))))
    closer = LoopCloser(ours, *chain_of_graph(ours.graph))
    closer.propose([*right, *wrong])
    return ours, closer, every


def between(poses: Array, loop: Loop) -> Array:
    g = group_of(poses)
    return np.asarray(g.log(g.between(loop.T_ij, g.between(poses[loop.i], poses[loop.j]))))


@pytest.mark.parametrize("dim", [2, 3])
def test_both_maps_are_kept_where_nothing_decides(dim: int) -> None:
    ours, closer, _ = torn(dim)
    assert closer.accepted == []
    assert all(d.why.startswith(AMBIGUOUS) for d in closer.ledger.current())
    ((a, b),) = closer.undecided
    assert sorted([sorted(a), sorted(b)]) == [[0, 1, 2], [3, 4, 5]]
    before, factors, written = ours.graph.values.poses.copy(), set(ours.graph.records), len(closer.ledger)
    found = ambiguous_maps(ours.graph, ours.solver, closer)
    assert found is not None
    # the result is as it was, and nothing was decided
    np.testing.assert_allclose(ours.graph.values.poses, before, atol=1e-6)
    assert (set(ours.graph.records), len(closer.ledger)) == (factors, written)
    # each map has its own loops, and not those of the other
    sides = [sorted(a), sorted(b)]
    assert [list(m.loops) for m in found.maps] == sides
    for m, own, other in zip(found.maps, sides, sides[::-1]):
        assert max(np.abs(between(m.node_poses, closer.loops[n])[-dim:]).max() for n in own) < 0.3
        assert min(np.linalg.norm(between(m.node_poses, closer.loops[n])[-dim:]) for n in other) > OFF - 0.5
        assert len(m.path) > len(m.node_poses)
        assert m.path.covariances is not None
    facts = found.facts()
    apart = np.linalg.norm(found.maps[0].node_poses[:, :dim] - found.maps[1].node_poses[:, :dim], axis=1)
    assert facts["apart_max"] == pytest.approx(apart.max())
    assert facts["apart_median"] == pytest.approx(np.median(apart))
    assert facts["apart_max_time"] == found.maps[0].node_times[int(np.argmax(apart))]
    (place,) = facts["places"]
    assert place["nodes"] == [[14, 19], [94, 99]]
    assert place["times"] == [[42.0, 57.0], [282.0, 297.0]]


def test_the_same_numbers_give_the_same_maps() -> None:
    first, second = (ambiguous_maps(o.graph, o.solver, c) for o, c, _ in (torn(3), torn(3)))
    assert first is not None
    assert second is not None
    assert first.facts() == second.facts()
    for a, b in zip(first.maps, second.maps):
        assert a.path.poses.tobytes() == b.path.poses.tobytes()
        assert a.node_poses.tobytes() == b.node_poses.tobytes()


def test_what_is_decided_later_is_in_dispute_no_more() -> None:
    """A loop that only the right ones agree with, from the next round of looks, tells."""
    ours, closer, every = torn(3)
    more = [loop_of(every, k, k + 80, np.random.default_rng(k)) for k in (2, 4, 6, 8, 10, 12)]
    closer.propose(more)
    assert {0, 1, 2} <= set(closer.accepted)
    assert closer.undecided == []
    assert ambiguous_maps(ours.graph, ours.solver, closer) is None
