"""Information joins against the dense twin of eq. 13–16, the Kalman filter, exact sparsity, and odd chains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, SolverError, UnknownNameError
from graphslam.core.submap import Submap
from graphslam.join import eif
from graphslam.join.ekf import DenseMap, join_ekf
from graphslam.join.joined_map import JoinedMap, JoinTimes
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_blocks import SubmapProblem, scale_covariances
from graphslam.join.submap_solver import solve_submaps
from tests.reference.dense_join import dense_information_join, dense_tree_join
from tests.reference.submap_chain import submap_chain

JOINERS = [join_sequential, join_tree, join_ekf]


@pytest.fixture
def chain(rng: np.random.Generator) -> list[Submap]:
    return submap_chain(rng, submaps=13, landmarks=45)[0]


def test_sequential_join_is_eq_13_to_16(chain: list[Submap]) -> None:
    X, I, ids = dense_information_join(chain)
    joined = join_sequential(chain)
    assert list(joined.landmark_ids) == ids
    x = joined.vector
    m = len(chain)
    X[2 : 3 * m : 3] = np.arctan2(np.sin(X[2 : 3 * m : 3]), np.cos(X[2 : 3 * m : 3]))
    np.testing.assert_allclose(x, X, atol=1e-8)
    np.testing.assert_allclose(joined.information.toarray(), I, rtol=0, atol=1e-8 * np.abs(I).max())


@pytest.mark.parametrize("count", [1, 2, 3, 6, 13])
def test_tree_join_is_the_same_joins_dense(count: int, chain: list[Submap]) -> None:
    ids, X, I = dense_tree_join(chain[:count])
    joined = join_tree(chain[:count])
    assert sorted(joined.landmark_ids) == sorted(j for kind, j in ids if kind == "landmark")
    at, places = 0, {}
    for kind, j in ids:
        places[kind, j] = np.arange(at, at + (3 if kind == "pose" else 2))
        at += 3 if kind == "pose" else 2
    order = [places["pose", k] for k in range(count)] + [places["landmark", int(j)] for j in joined.landmark_ids]
    ix = np.concatenate(order)
    x = X[ix]
    x[2 : 3 * count : 3] = np.arctan2(np.sin(x[2 : 3 * count : 3]), np.cos(x[2 : 3 * count : 3]))
    np.testing.assert_allclose(joined.vector, x, atol=1e-8)
    dense = joined.information.toarray()
    np.testing.assert_allclose(dense, I[np.ix_(ix, ix)], rtol=0, atol=1e-8 * np.abs(I).max())


def test_kalman_filter_is_the_information_filter(chain: list[Submap]) -> None:
    a, b = join_sequential(chain), join_ekf(chain)
    np.testing.assert_allclose(a.vector, b.vector, atol=1e-8)
    P = a.joint_covariance()
    np.testing.assert_allclose(b.joint_covariance(), P, rtol=0, atol=1e-8 * np.abs(P).max())
    assert a.objective == pytest.approx(b.objective, rel=1e-8)
    some = np.array([0, 5, 40])
    np.testing.assert_allclose(a.covariance_block(some), b.covariance_block(some), rtol=1e-6)
    assert b.nnz == b.states**2 > a.nnz


def test_textbook_update_is_the_same_filter(chain: list[Submap]) -> None:
    a, b = join_ekf(chain), join_ekf(chain, form="naive")
    np.testing.assert_allclose(b.vector, a.vector, atol=1e-6)
    P = a.joint_covariance()
    np.testing.assert_allclose(b.joint_covariance(), P, rtol=0, atol=1e-6 * np.abs(P).max())
    assert np.any(b.joint_covariance() != P)  # another arithmetic
    with pytest.raises(ConfigError, match="unknown form 'cubic'"):
        join_ekf(chain, form="cubic")


def test_kalman_filter_stays_symmetric_and_positive_over_a_closure(chain: list[Submap]) -> None:
    P = join_ekf(chain).joint_covariance()
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-15 * np.abs(P).max())
    assert np.linalg.eigvalsh(P)[0] > 0


def test_joined_information_is_exactly_sparse(chain: list[Submap]) -> None:
    """Only what stood in one submap is coupled; in the tree, also the inner starts of a half with that half."""
    problem = SubmapProblem(chain)
    joined = join_sequential(chain)
    together = {int(i): set() for i in joined.landmark_ids}
    for s in chain:
        for i in s.landmarks.ids:
            together[int(i)] |= set(s.landmarks.ids.tolist())
    I = joined.information.toarray()
    apart = 0
    for i in joined.landmark_ids:
        for j in joined.landmark_ids:
            block = I[np.ix_(joined.landmark_indices(i), joined.landmark_indices(j))]
            if int(j) not in together[int(i)]:
                apart += 1
                assert not block.any()
            else:
                assert block.any()
    assert apart > 100
    assert joined.nnz <= problem.pattern.nnz < join_tree(chain).nnz < joined.states**2


@pytest.mark.parametrize("join", JOINERS)
def test_polish_reaches_the_batch_optimum(join, chain: list[Submap]) -> None:
    best = solve_submaps(chain)
    assert best.converged
    joined = join(chain)
    assert joined.objective > best.objective + 1e-4  # filtering has its price, else this shows nothing
    polished = optimise_from_join(chain, joined)
    assert polished.converged
    assert polished.objective == joined.objective
    assert polished.objective_polished == pytest.approx(best.objective, rel=1e-9)
    np.testing.assert_allclose(polished.poses, best.poses, atol=1e-6)
    np.testing.assert_allclose(polished.landmarks, best.landmarks, atol=1e-6)
    np.testing.assert_allclose(polished.pose_covariance(9), best.pose_covariance(9), rtol=1e-5)
    assert polished.seconds > joined.seconds > 0.0
    assert all(polished.times[part] == seconds for part, seconds in joined.times.items())
    assert set(polished.times) == {"association", "update", "recovery", "polish"}


@pytest.mark.parametrize("join", JOINERS)
def test_a_landmark_that_stands_twice_in_a_submap(join, chain: list[Submap]) -> None:
    def merged(s: Submap, old: int, new: int) -> Submap:
        return s.with_ids(np.where(s.landmarks.ids == old, new, s.landmarks.ids))

    old, new = (int(i) for i in chain[4].landmarks.ids[:2])
    twice = [merged(s, old, new) for s in chain]
    assert np.sum(twice[4].landmarks.ids == new) == 2
    best = solve_submaps(twice)
    joined = join(twice)
    assert np.array_equal(np.sort(joined.landmark_ids), np.sort(best.landmark_ids))
    assert all(np.array_equal(a, s.landmarks.ids) for a, s in zip(joined.submap_ids, twice))
    np.testing.assert_allclose(optimise_from_join(twice, joined).landmarks, best.landmarks, atol=1e-5)


@pytest.mark.parametrize("join", JOINERS)
def test_one_submap_alone_is_handed_through(join, chain: list[Submap]) -> None:
    joined = join(chain[:1])
    local = chain[0].landmarks
    np.testing.assert_allclose(joined.vector, local.mean, atol=1e-12)
    np.testing.assert_allclose(joined.joint_covariance(), local.covariance, rtol=0, atol=1e-12)
    assert joined.objective == pytest.approx(0.0, abs=1e-18)
    assert optimise_from_join(chain[:1], joined).objective_polished == pytest.approx(0.0, abs=1e-18)


@pytest.mark.parametrize("join", JOINERS)
def test_submaps_without_landmarks_are_links(join, chain: list[Submap]) -> None:
    blind = [
        Submap(key=s.key, interval=s.interval, exit_pose=s.exit_pose, exit_covariance=s.exit_covariance)
        if s.key in (0, 5, 6, 12)
        else s
        for s in chain
    ]
    joined, best = join(blind), solve_submaps(blind)
    np.testing.assert_allclose(optimise_from_join(blind, joined).poses, best.poses, atol=1e-6)
    links = [s for s in blind if s.landmarks is None]
    assert join(links).objective == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("join", JOINERS)
def test_bad_chains_are_refused(join, chain: list[Submap]) -> None:
    with pytest.raises(DataError, match="no submaps"):
        join([])
    lost = chain[3].with_ids(np.full(len(chain[3].landmarks), -1))
    with pytest.raises(DataError, match="submap 3 has landmarks without an identity"):
        join([*chain[:3], lost, *chain[4:]])


def test_no_news_no_factorisation(chain: list[Submap]) -> None:
    """Maps that share no landmark are placed by composition alone, and their mean does not move."""
    a = JoinedMap.leaf(chain[0], identified=True)
    b = JoinedMap.leaf(chain[1], identified=True)
    times = JoinTimes()
    joined = eif.join_maps(a, b, np.full(len(b.ids), -1, dtype=np.intp), times)
    assert times.parts["recovery"] == 0.0
    np.testing.assert_array_equal(joined.x[: len(a.x)], a.x)


@pytest.mark.parametrize("stale", [0.0, np.inf])
def test_the_kept_order_changes_nothing_but_time(chain: list[Submap], stale: float, monkeypatch) -> None:
    expected = join_sequential(chain)
    monkeypatch.setattr(eif, "_STALE", stale)
    joined = join_sequential(chain)
    np.testing.assert_allclose(joined.vector, expected.vector, atol=1e-9)
    I = expected.information.toarray()
    np.testing.assert_allclose(joined.information.toarray(), I, rtol=0, atol=1e-10 * np.abs(I).max())


def test_indices_of_the_state_vector(chain: list[Submap]) -> None:
    joined = join_tree(chain)
    j = int(joined.landmark_ids[7])
    np.testing.assert_array_equal(joined.vector[joined.landmark_indices(j)], joined.landmarks[7])
    np.testing.assert_array_equal(joined.vector[joined.pose_indices(4)], joined.poses[4])
    P = joined.joint_covariance()
    at = joined.landmark_indices(j)
    np.testing.assert_allclose(joined.landmark_covariance(j), P[np.ix_(at, at)], rtol=1e-7)
    with pytest.raises(UnknownNameError):
        joined.pose_indices(0)
    with pytest.raises(UnknownNameError):
        joined.landmark_indices(-5)
    assert "13" in replace(joined, iterations=13)._repr_html_()


def test_the_dense_map_does_not_outgrow_its_room(chain: list[Submap]) -> None:
    first, second = chain[0].landmarks, chain[1].landmarks
    dense = DenseMap(first, np.arange(len(first)), capacity=3 + 2 * len(first))
    with pytest.raises(DataError, match="no room"):
        dense.join(second, np.arange(len(second)), np.full(len(second), -1))


def test_polish_of_other_submaps_does_not_take_the_old_problem(chain: list[Submap]) -> None:
    joined = join_tree(chain)
    doubled = scale_covariances(chain, 2.0)
    assert optimise_from_join(doubled, joined).objective_polished == pytest.approx(
        0.5 * solve_submaps(chain).objective, rel=1e-9
    )


def test_a_start_that_is_not_finite_is_an_error(chain: list[Submap]) -> None:
    joined = join_tree(chain)
    with pytest.raises((SolverError, DataError)):
        optimise_from_join(chain, replace(joined, poses=np.full_like(joined.poses, np.nan)))
