"""Candidates for loops: what a chain knows of two places, which pairs may overlap, in which order they are tried."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, group_of
from graphslam.core.submap import Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.loops.candidates import (
    CandidateConfig,
    front_end_candidates,
    information_gain,
    overlap_probability,
    pairs_sharing_scans,
    proximity_candidates,
    thin_candidates,
)
from graphslam.loops.places import Places
from tests.reference.chain_poses import ChainRelativePoses, chain_increments
from tests.reference.loop_places import loop_places

D3 = np.diag([1e-6, 1e-6, 4e-6, 1e-4, 1e-4, 2.5e-5])


def square(side: float = 30.0, laps: float = 1.25, dim: int = 3, cut: float = 20.0) -> list[Submap]:
    """Submaps of a drive round a square, a pose every metre; the covariance of a path grows with every step."""
    n = int(4 * side * laps)
    at = np.arange(n + 1.0)
    leg, along = np.divmod(at, side)
    corner = np.array([[0, 0], [side, 0], [side, side], [0, side]])[(leg % 4).astype(int)]
    turn = 0.5 * np.pi * (leg % 4)
    xy = corner + along[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    if dim == 2:
        poses = np.column_stack([xy, turn])
        D = np.diag([1e-4, 1e-4, 4e-6])
    else:
        z = np.zeros(len(xy))
        poses = np.column_stack([xy, z, z, z, np.sin(turn / 2), np.cos(turn / 2)])
        D = D3
    g = group_of(poses)
    out = []
    bounds = [*range(0, n, int(cut)), n]
    for k, (a, b) in enumerate(pairwise(bounds)):
        local = g.between(np.broadcast_to(poses[a], poses[a : b + 1].shape), poses[a : b + 1])
        P = [np.zeros((g.dof, g.dof))]
        for T in g.between(local[:-1], local[1:]):
            A = g.adjoint(g.inverse(T))
            P.append(A @ P[-1] @ A.T + D)
        C = np.stack(P)
        out.append(
            Submap(
                key=k,
                interval=(float(a), float(b)),
                exit_pose=local[-1],
                exit_covariance=C[-1],
                trajectory=Trajectory(at[a : b + 1], local, C),
            )
        )
    return out


@pytest.mark.parametrize("dim", [2, 3])
def test_what_a_chain_knows_of_two_places_is_what_samples_say(dim: int) -> None:
    """Poses of places with sampled noise on every step, against mean and covariance, forwards and backwards."""
    submaps = square(dim=dim)
    places = loop_places(submaps, 4.0)
    chain = ChainRelativePoses(submaps, places)
    T, Q = chain_increments(submaps, places)
    g = group_of(T)
    rng = np.random.default_rng(1)
    runs = 3000
    noise = np.einsum("kij,rkj->rki", np.linalg.cholesky(Q), rng.standard_normal((runs, len(T), g.dof)))
    poses = [np.broadcast_to(g.identity, (runs, g.size))]
    for k in range(len(T)):
        poses.append(g.compose(poses[-1], g.compose(np.broadcast_to(T[k], (runs, g.size)), g.exp(noise[:, k]))))
    i, j = np.array([0, 7, 20]), np.array([len(places) - 1, 3, 31])
    mean, P = chain(i, j)
    for k in range(3):
        sample = g.between(poses[i[k]], poses[j[k]])
        e = g.log(g.between(np.broadcast_to(mean[k], sample.shape), sample))
        L = np.linalg.inv(np.linalg.cholesky(P[k]))
        S = L @ (e.T @ e / runs) @ L.T
        np.testing.assert_allclose(S, np.eye(g.dof), atol=0.15)
    # the true places
    np.testing.assert_allclose(chain.poses[: len(places)][places.submap == 0], places.T_base_node[places.submap == 0])


def test_places_lie_along_the_way() -> None:
    submaps = square()
    places = loop_places(submaps, 3.0)
    assert np.all(np.abs(np.diff(places.arc) - 3.0) <= 1.01)
    assert places.of_submap(1).tolist() == np.flatnonzero(places.submap == 1).tolist()
    assert places.arc[places.of_submap(2)[0]] == pytest.approx(40.0)
    assert places.nearest(0, np.array([7.2, 0.3, 0.0])) == int(np.argmin(np.abs(places.arc - 7.2)))
    with pytest.raises(GeometryError):
        Places(places.node, places.submap[:-1], places.T_base_node, places.arc, places.time)
    with pytest.raises(DataError):
        Places(places.node, places.submap, places.T_base_node, places.arc[::-1], places.time)
    with pytest.raises(DataError):
        loop_places([Submap(key=0, interval=(0, 1), exit_pose=np.zeros(3), exit_covariance=np.eye(3))])


def plain_pairs(places: Places, chain: ChainRelativePoses, c: CandidateConfig) -> set[tuple[int, int]]:
    """All pairs that may be tried, one by one."""
    out = set()
    for i in range(len(places)):
        for j in range(i + 1, len(places)):
            if places.arc[j] - places.arc[i] < c.least_path or places.submap[i] == places.submap[j]:
                continue
            T, P = chain(np.array([i]), np.array([j]))
            R = se3.quat_to_matrix(T[0, 3:])
            S = R @ P[0, 3:, 3:] @ R.T
            flat = math.hypot(T[0, 0], T[0, 1]) - c.overlap <= c.sigmas * math.sqrt(np.linalg.eigvalsh(S[:2, :2])[-1])
            level = abs(T[0, 2]) - c.height <= c.sigmas * math.sqrt(S[2, 2])
            s = np.full(6, c.match_angle)
            s[3:] = c.match_sigma
            gain = 0.5 * np.log(np.linalg.det(np.eye(6) + P[0] / np.outer(s, s)))
            if flat and level and gain >= c.least_gain:
                out.add((i, j))
    return out


def test_proximity_gives_the_pairs_that_may_overlap() -> None:
    submaps = square()
    places = loop_places(submaps, 5.0)
    chain = ChainRelativePoses(submaps, places)
    for c in (
        CandidateConfig(stretch=0.0, keep=10_000, batch=37),
        CandidateConfig(stretch=0.0, keep=10_000, overlap=3.0, least_gain=4.0, least_path=60.0),
    ):
        found = proximity_candidates(places, chain, c)
        assert {(x.i, x.j) for x in found} == plain_pairs(places, chain, c)
        assert len(found) > 5
        assert [x.score for x in found] == sorted((x.score for x in found), reverse=True)
    thin = proximity_candidates(places, chain, CandidateConfig())
    assert 0 < len(thin) < len(found)
    # against one submap no two places of one stretch
    for a in thin:
        for b in thin:
            if a is not b and places.submap[a.i] == places.submap[b.i]:
                assert abs(places.arc[a.j] - places.arc[b.j]) >= 12.0
    # what was tried is not tried again, what shares a map never
    assert proximity_candidates(places, chain, tried=[(x.i, x.j) for x in thin]) == []
    every = {(a, b) for a in range(len(submaps)) for b in range(a)}
    assert proximity_candidates(places, chain, exclude=every) == []


def test_a_storey_above_is_no_candidate() -> None:
    T = np.array([[1.0, 1.0, z, 0, 0, 0, 1] for z in (0.0, 2.0, 3.2)])
    P = np.broadcast_to(np.diag([1e-4] * 3 + [1.0, 1.0, 0.16]), (3, 6, 6))
    chance, may = overlap_probability(T, P, CandidateConfig())
    assert may.tolist() == [True, True, False]
    assert chance[0] > 0.9 > 0.1 > chance[1] > chance[2]


def test_chance_is_that_of_samples_along_a_line() -> None:
    """Where only the distance is uncertain."""
    rng = np.random.default_rng(0)
    P = np.zeros((1, 3, 3))
    P[0, 0, 0] = 9.0
    P[0, 1, 1] = P[0, 2, 2] = 1e-8
    chance, _ = overlap_probability(np.array([[10.0, 0.0, 0.0]]), P, CandidateConfig())
    x = 10.0 + 3.0 * rng.standard_normal(100_000)
    assert chance[0] == pytest.approx(np.mean(np.abs(x) < 8.0), abs=0.01)


def test_gain_is_the_entropy_that_a_match_takes() -> None:
    """½ log of the determinants before and after a linear update."""
    A = np.random.default_rng(3).standard_normal((3, 3))
    P = A @ A.T
    R = np.diag([0.1, 0.1, 0.012]) ** 2
    after = P - P @ np.linalg.solve(P + R, P)
    wanted = 0.5 * (np.linalg.slogdet(P)[1] - np.linalg.slogdet(after)[1])
    assert information_gain(P[None], 0.1, 0.012, 2)[0] == pytest.approx(wanted)


def test_thinning_takes_the_best_first() -> None:
    target, along = np.array([0, 0, 0, 1]), np.array([0.0, 5.0, 20.0, 1.0])
    score = np.array([1.0, 3.0, 2.0, 0.5])
    assert thin_candidates(target, along, score, 10.0, 9) == [1, 2, 3]
    assert thin_candidates(target, along, score, 10.0, 2) == [1, 2]
    assert thin_candidates(target, along, score, 10.0, 9, [(0, 22.0)]) == [1, 3]
    assert thin_candidates(target, along, score, 0.0, 9) == [1, 2, 0, 3]


def with_matches(submaps: list[Submap], matches: dict[int, list[Match]], report: dict[int, dict]) -> list[Submap]:  # type: ignore[type-arg]
    return [
        Submap(
            key=s.key, interval=s.interval, exit_pose=s.exit_pose, exit_covariance=s.exit_covariance,
            trajectory=s.trajectory, matches=tuple(matches.get(s.key, ())), report=report.get(s.key, {}),
        )
        for s in submaps
    ]  # fmt: skip


def test_front_ends_matches_become_candidates_at_the_nearest_place() -> None:
    here: Array = np.array([7.2, 0.4, 0.1])
    C = np.diag([0.01, 0.01, 1e-4])
    match = Match(target=0, T_target_here=here, covariance=C, fitness=0.9, support=0.7)
    weak = Match(target=1, T_target_here=here, covariance=C, fitness=0.9, support=0.01)
    missing = Match(target=77, T_target_here=here, covariance=C, fitness=0.9, support=0.9)
    submaps = with_matches(square(dim=2), {6: [match, weak, missing]}, {6: {"entered": "match"}})
    places = loop_places(submaps, 3.0)
    (x,) = front_end_candidates(submaps, places)
    assert (places.submap[x.i], places.submap[x.j], x.source) == (0, 6, "front-end")
    assert x.facts == {"support": 0.7, "fitness": 0.9}
    # from the place on, the match is what it was from the base
    np.testing.assert_allclose(SE2.compose(places.T_base_node[x.i], x.T_ij), here, atol=1e-12)
    assert np.linalg.norm(x.T_ij[:2]) < 1.7
    np.testing.assert_array_equal(x.covariance, C)


def test_submaps_that_hold_the_same_scans_are_known() -> None:
    C = np.eye(3)
    into = [Match(target=0, T_target_here=np.zeros(3), covariance=C, fitness=0.9, support=1.0)]
    submaps = with_matches(square(dim=2), {4: into}, {4: {"entered": "match"}, 6: {"holds": [6, 4, 0]}})
    assert pairs_sharing_scans(submaps) == {(0, 4), (0, 6), (4, 6)}
    assert pairs_sharing_scans(square(dim=2)) == set()


def test_impossible_configurations_are_refused() -> None:
    for bad in ({"overlap": 0.0}, {"sigmas": -1.0}, {"least_gain": math.nan}, {"batch": 0}):
        with pytest.raises(ConfigError):
            CandidateConfig(**bad)
