"""Ties between sessions: right ones are found without any prediction, and what does not overlap is said to be so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.relative import relative_poses
from graphslam.loops.graph_loops import GraphRelativePoses
from graphslam.loops.inter_session_loops import InterSessionConfig, SessionMap, TwoSessions, session_start
from graphslam.loops.measure import Loop
from tests.reference.box_submaps import straight_path
from tests.reference.box_world import corridor, hall
from tests.reference.hall_sessions import HallDrive, hall_drive
from tests.reference.space_chain import dense_chain

CONFIG = InterSessionConfig()


@pytest.fixture(scope="module")
def drives() -> tuple[HallDrive, HallDrive]:
    """There along one side of a hall, and back along the other, from another start."""
    world, rng = hall(cars=60), np.random.default_rng(3)
    there = hall_drive(world, straight_path(8.0, 44.0, 8.0, step=0.75), rng)
    back = hall_drive(world, straight_path(50.0, 16.0, 9.0, yaw=np.pi, step=0.75), rng)
    return there, back


def truth_between(a: HallDrive, b: HallDrive) -> np.ndarray:
    return se3.se3_between(a.path.poses[0], b.path.poses[0])


@pytest.fixture(scope="module")
def two(drives: tuple[HallDrive, HallDrive]) -> TwoSessions:
    return TwoSessions(*(SessionMap(d.submaps) for d in drives))


def test_right_ties_are_found_from_nothing(drives: tuple, two: TwoSessions) -> None:
    result = two.find(CONFIG)
    assert not result.why
    assert len(result.chosen) >= CONFIG.least
    where = [d.path.interpolate(m.places.time) for d, m in zip(drives, (two.known, two.new))]
    chi2 = []
    for x in result.chosen:
        e = se3.se3_log(se3.se3_between(x.T_ij, se3.se3_between(where[0][x.i], where[1][x.j])))
        assert np.linalg.norm(e[3:]) < 0.4
        chi2.append(e @ np.linalg.solve(x.covariance, e))
    assert np.median(chi2) < chi2_quantile(0.99, 6)
    assert len({(x.i, x.j) for x in result.chosen}) == len(result.chosen)
    # the true poses of the nodes in their own frames give the start
    own = [se3.se3_between(np.broadcast_to(w[0], w.shape), w) for w in where]
    e = se3.se3_log(se3.se3_between(session_start(result.chosen, own[0], own[1]), truth_between(*drives)))
    assert np.linalg.norm(e[3:]) < 1.0
    assert abs(e[2]) < 0.05
    rows = result.rows()
    assert len(rows) == len(result.loops)
    assert sum(bool(r["accepted"]) for r in rows) == len(result.chosen)
    apart = two.thinned(result.chosen, 12.0)
    assert 1 <= len(apart) <= len(result.chosen)
    for k, x in enumerate(apart):
        for y in apart[:k]:
            same = two.known.places.submap[x.i] == two.known.places.submap[y.i]
            assert not same or abs(two.new.places.arc[x.j] - two.new.places.arc[y.j]) >= 12.0


def test_sessions_that_do_not_overlap_are_reported(two: TwoSessions) -> None:
    elsewhere = hall_drive(corridor(120.0), straight_path(-15.0, 15.0, 0.0), np.random.default_rng(5))
    result = TwoSessions(two.known, SessionMap(elsewhere.submaps)).find(CONFIG)
    assert "looked alike" in result.why
    assert result.chosen == []
    assert not any(r["accepted"] for r in result.rows())


def made(
    two: TwoSessions, T_known_new: np.ndarray, rows: list[tuple[int, int]], rng: np.random.Generator
) -> list[Loop]:
    """Ties that put the new session there, with noise of 5 cm and 0.01 rad."""
    g, out = se3, []
    sigma = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05])
    pose = [np.array([0.0, 0, 0, 0, 0, 0, 1])]
    for step in two.known.increments:
        pose.append(g.se3_compose(pose[-1], step))
    own = [np.array([0.0, 0, 0, 0, 0, 0, 1])]
    for step in two.new.increments:
        own.append(g.se3_compose(own[-1], step))
    for i, j in rows:
        T = g.se3_between(pose[i], g.se3_compose(T_known_new, own[j]))
        T = g.se3_compose(T, g.se3_exp(sigma * rng.standard_normal(6)))
        out.append(Loop(i=i, j=two.offset + j, T_ij=T, covariance=np.diag(sigma**2), source="test", score=0.9))
    return out


def test_agreement_decides_and_two_places_are_not_guessed_between(two: TwoSessions) -> None:
    rng = np.random.default_rng(1)
    true = np.array([4.0, -3.0, 0.1, 0, 0, np.sin(0.7), np.cos(0.7)])
    alias = np.array([12.0, -3.0, 0.1, 0, 0, np.sin(0.7), np.cos(0.7)])
    right = made(two, true, [(1, 2), (3, 4), (5, 6), (7, 8), (8, 10)], rng)
    wrong = made(two, alias, [(2, 3), (6, 5)], rng)
    stray = made(two, true, [(4, 4)], rng)
    stray[0] = replace(stray[0], T_ij=se3.se3_compose(stray[0].T_ij, se3.se3_exp([0, 0, 1.0, 5.0, 0, 0])))
    failed = [replace(right[0], why="fitness 0.1 < 0.8")]
    result = two.agree([*right, *wrong, *stray, *failed], CONFIG)
    assert not result.why
    assert result.accepted.tolist() == [True] * 5 + [False] * 4
    assert result.rival == 2
    assert "contradicts" in result.reasons[5]
    assert result.reasons[-1].startswith("registration")
    assert [x.j for x in result.chosen] == [2, 4, 6, 8, 10]  # of the session's own chain
    alike = made(two, alias, [(2, 3), (6, 5), (9, 9)], rng)
    result = two.agree([*right, *alike], CONFIG)
    assert "could be two places" in result.why
    assert result.chosen == []
    few = two.agree(right[:2], CONFIG)
    assert "2 agree, wanted 3" in few.why
    near = made(two, true, [(1, 2), (2, 3), (3, 2)], rng)
    assert "m of the path only" in two.agree(near, CONFIG).why
    assert "0 agree" in two.agree([], CONFIG).why


def test_what_cannot_be_placed_is_refused(two: TwoSessions, drives: tuple) -> None:
    s = drives[0].submaps[0]
    with pytest.raises(DataError, match="path and a map"):
        SessionMap([replace(s, grid=None)])
    with pytest.raises(DataError, match="path and a map"):
        SessionMap([replace(s, trajectory=None)])
    with pytest.raises(DataError, match="at least one"):
        SessionMap([])
    with pytest.raises(ConfigError, match="level"):
        InterSessionConfig(level=1.0)
    with pytest.raises(ConfigError, match="least"):
        InterSessionConfig(least=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_nodes_are_those_of_a_graph(dim: int) -> None:
    """What a graph knows of pairs of nodes is what its whole covariance says; the first node is held."""
    chain = dense_chain(np.random.default_rng(2), dim)
    graph = FactorGraph(dim)
    for s in chain.submaps:
        graph.add_submap(s, spacing=3.0)
    d, n = graph.values.group.dof, len(graph.values.poses)
    S = np.zeros((n * d, n * d))
    S[d:, d:] = graph.covariance().joint([f"x{k}" for k in range(1, n)])
    S = S.reshape(n, d, n, d)
    i, j = np.array([0, 5, n - 1]), np.array([7, 2, 3])
    poses = graph.values.poses
    T, P = GraphRelativePoses(graph)(i, j)
    want = relative_poses(poses[i], poses[j], S[i, :, i], S[i, :, j], S[j, :, j])
    np.testing.assert_allclose(T, want[0])
    np.testing.assert_allclose(P, want[1], atol=1e-15)
    assert np.all(np.linalg.eigvalsh(P) > 0)
