"""Ties along submaps: where they are, what they say, and by which entries they hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.submap import Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.find_loops import FindConfig, find_loops
from graphslam.loops.overlap_constraints import OverlapConfig, overlap_candidates
from graphslam.loops.places import Places
from graphslam.solve.batch import BatchSolver
from tests.reference.loop_places import loop_places

OUT = 20
"""Poses on the way into a dead end, a metre apart; the way out is as long."""


def dead_end(dim: int, turns: int) -> list[Submap]:
    """As many drives into a dead end and out again, one submap each; the body turns round where it ends."""
    along = np.concatenate([np.arange(OUT + 1.0), np.arange(OUT - 1.0, -1.0, -1.0)])
    heading = np.concatenate([np.zeros(OUT + 1), np.full(OUT, np.pi)])
    zero = np.zeros(len(along))
    if dim == 2:
        body = np.column_stack([along, zero, heading])
    else:
        body = np.column_stack([along, zero, zero, zero, zero, np.sin(heading / 2), np.cos(heading / 2)])
    g = group_of(body)
    times = np.arange(len(body), dtype=np.float64)
    P = np.array([1e-4 * (1.0 + k) * np.eye(g.dof) for k in range(len(body))])
    out = []
    for k in range(turns):
        # every other drive begins where the one before ended, turned round: its base sees the way in behind it
        start = g.identity if k % 2 == 0 else body[-1]
        poses = body if k % 2 == 0 else g.between(np.broadcast_to(start, body.shape), body)
        t = times + k * (len(body) - 1.0)
        out.append(
            Submap(
                key=10 + k, interval=(float(t[0]), float(t[-1])), exit_pose=g.between(poses[0], poses[-1]),
                exit_covariance=P[-1], trajectory=Trajectory(t, poses, P),
            )
        )  # fmt: skip
    return out


def entered(s: Submap, target: int, T: Array, holds: list[int]) -> Submap:
    match = Match(
        target=target, T_target_here=T, covariance=1e-3 * np.eye(len(T) - len(T) // 7), fitness=1.0, support=0.9
    )
    return replace(s, matches=(match,), report={"holds": holds, "entered": "match"})


def where(places: Places, submaps: list[Submap], starts: list[Array]) -> Array:
    """Places in one frame: by the true poses of the bases."""
    g = group_of(submaps[0].exit_pose)
    return g.compose(np.stack([starts[int(k)] for k in places.submap]), places.T_base_node)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_way_out_is_tied_to_the_way_in(dim: int) -> None:
    submaps = dead_end(dim, 1)
    places = loop_places(submaps, 3.0)
    found = overlap_candidates(submaps, places)
    assert found
    assert all(x.source == "overlap" and x.facts == {"entries": []} for x in found)
    g = group_of(places.T_base_node)
    for x in found:
        a, b = places.T_base_node[x.i], places.T_base_node[x.j]
        assert np.linalg.norm(a[:dim] - b[:dim]) <= 1.6  # no farther than half the spacing of places
        assert places.arc[x.j] - places.arc[x.i] >= 12.0
        np.testing.assert_allclose(x.T_ij, g.between(a, b), atol=1e-12)
        sigma = [0.08, 0.08, 0.011] if dim == 2 else [0.011, 0.011, 0.011, 0.08, 0.08, 0.03]
        np.testing.assert_allclose(x.covariance, np.diag(np.square(sigma)))
    arcs = places.arc[[x.j for x in found]]
    assert np.diff(arcs).min() >= 6.0
    assert len(found) == 2
    assert not overlap_candidates(submaps, places, config=OverlapConfig(least_path=100.0))


@pytest.mark.parametrize("dim", [2, 3])
def test_in_another_map_by_the_entries_that_are_believed(dim: int) -> None:
    """Three drives: the second went on in the map of the first, the third in that of the second, which holds both."""
    drives = dead_end(dim, 3)
    g = group_of(drives[0].exit_pose)
    turned = drives[0].exit_pose
    drives[1] = entered(drives[1], 10, turned, [10, 11])
    drives[2] = entered(drives[2], 11, g.inverse(turned), [10, 11, 12])
    places = loop_places(drives, 3.0)
    poses = where(places, drives, [g.identity, turned, g.identity])
    own = {(x.i, x.j) for x in overlap_candidates(drives, places)}
    assert {int(places.submap[i]) for i, _ in own} == {0, 1, 2}
    assert all(places.submap[i] == places.submap[j] for i, j in own)

    def check(entries: set[tuple[int, int]]) -> set[tuple[int, int]]:
        found = overlap_candidates(drives, places, entries)
        for x in found:
            np.testing.assert_allclose(x.T_ij, g.between(poses[x.i], poses[x.j]), atol=1e-9)
        return {(int(places.submap[x.i]), int(places.submap[x.j])) for x in found}

    assert (0, 1) in check({(10, 11)})
    assert (1, 2) not in check({(10, 11)})
    assert not any(target != 2 and j == 2 for target, j in check({(10, 11)}))  # its own entry is not believed
    both = overlap_candidates(drives, places, {(10, 11), (11, 12)})
    last = [x for x in both if places.submap[x.j] == 2]
    by = {tuple(map(tuple, x.facts["entries"])) for x in last if places.submap[x.i] == 0}
    assert by <= {((10, 11), (11, 12))}
    assert {int(places.submap[x.i]) for x in last} <= {0, 1}
    # one that does not hold the other's scans left its map again
    held = [drives[0], replace(drives[1], report={"holds": [11], "entered": "match"}), drives[2]]
    assert all(places.submap[x.i] != 0 or places.submap[x.j] == 0 for x in overlap_candidates(held, places, {(10, 11)}))


@pytest.mark.parametrize("right", [True, False])
def test_ties_come_and_go_with_their_match(right: bool) -> None:
    drives = dead_end(3, 2)
    T = drives[0].exit_pose.copy()
    if not right:
        T[1] += 9.0  # the chain knows the place to a decimetre or two
    drives[1] = entered(drives[1], 10, T, [10, 11])

    def solved(config: FindConfig) -> tuple[FactorGraph, list[str]]:
        graph = FactorGraph(3)
        for s in drives:
            graph.add_submap(s, spacing=3.0)
        solver = BatchSolver(graph)
        solver.solve_to_optimum()
        closer = find_loops(graph, solver, drives, config)
        names = [closer.loops[n].source for n in closer.accepted]
        overlaps = [closer.loops[n] for n in closer.accepted if closer.loops[n].source == "overlap"]
        if not right:
            assert all(x.submaps[0] == x.submaps[1] for x in overlaps)
        return graph, names

    config = FindConfig(front_end=True, rounds=0)
    graph, sources = solved(config)
    assert sources.count("front-end") == int(right)
    assert sources.count("overlap") >= 4
    without, _ = solved(replace(config, overlaps=None))
    end = graph.submaps[-1].exit_node
    P, P0 = (g.covariance().poses()[end] for g in (graph, without))
    assert np.linalg.det(P) < 0.5 * np.linalg.det(P0)


def test_impossible_overlap_options_are_refused() -> None:
    for bad in ({"spacing": 0.0}, {"sigma": -1.0}, {"sigma_angle": float("nan")}):
        with pytest.raises(ConfigError, match="overlap constraints"):
            OverlapConfig(**bad)
