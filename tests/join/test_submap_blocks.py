"""The block problem against a dense twin, finite differences and the exactness of fusing repeated landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from graphslam.core.errors import CovarianceError, DataError, GeometryError, IndeterminateError
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.join.submap_blocks import SubmapProblem, fuse_repeated, relabel, scale_covariances
from graphslam.join.submap_solver import minimise_submaps, solve_submaps
from graphslam.linear.symmetric_factor import SymmetricFactor
from tests.reference.dense_join import dense_normal_equations, first_observation
from tests.reference.submap_chain import submap_chain
from tests.reference.submap_model import submap_residual


def with_repeated_landmark(submaps: list[Submap], k: int) -> list[Submap]:
    """Give two landmarks of submap k that lie anywhere the same id, as after a merge."""
    ids = submaps[k].landmarks.ids.copy()
    ids[1] = ids[0]
    return [s.with_ids(ids) if i == k else s for i, s in enumerate(submaps)]


def in_chart(submaps: list[Submap], chart: str) -> list[Submap]:
    return [replace(s, landmarks=replace(s.landmarks, chart=chart)) for s in submaps]


@pytest.fixture(params=["plain", "repeated", "group", "mixed"])
def chain(request: pytest.FixtureRequest, rng: np.random.Generator) -> list[Submap]:
    submaps, _ = submap_chain(rng, submaps=8, landmarks=40)
    if request.param == "group":
        return in_chart(submaps, "group")
    if request.param == "mixed":
        return in_chart(submaps[:4], "group") + submaps[4:]
    return with_repeated_landmark(submaps, 2) if request.param == "repeated" else submaps


def test_normal_equations_match_the_dense_twin(chain: list[Submap], rng: np.random.Generator) -> None:
    problem = SubmapProblem(chain)
    x = problem.initial() + 0.3 * rng.standard_normal(problem.size)
    f, g, data = problem.linearise(x)
    H = problem.pattern.matrix(data).toarray()
    f_twin, g_twin, H_twin = dense_normal_equations(chain, x)
    assert f == pytest.approx(f_twin, rel=1e-10)
    np.testing.assert_allclose(g, g_twin, rtol=0, atol=1e-9 * np.abs(g_twin).max())
    np.testing.assert_allclose(H, H_twin, rtol=0, atol=1e-9 * np.abs(H_twin).max())
    np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-13 * np.abs(H).max())
    assert list(problem.ids) == first_observation(chain)
    assert problem.objective_per_submap(x).sum() == pytest.approx(f, rel=1e-12)


def test_residual_is_the_model_of_one_submap_after_the_other(chain: list[Submap], rng: np.random.Generator) -> None:
    problem = SubmapProblem(chain)
    x = problem.initial() + 0.3 * rng.standard_normal(problem.size)
    place = {int(j): 3 * problem.m + 2 * i for i, j in enumerate(problem.ids)}
    expected = []
    for k, s in enumerate(chain):
        points = np.array([x[place[int(j)] : place[int(j)] + 2] for j in s.landmarks.ids])
        start = np.zeros(3) if k == 0 else x[3 * k - 3 : 3 * k]
        expected.append(submap_residual(start, x[3 * k : 3 * k + 3], points, s.landmarks.mean, s.landmarks.chart))
    np.testing.assert_allclose(problem.residual(x), np.concatenate(expected), atol=1e-12)


def test_other_ids_and_known_information_are_taken_as_given(chain: list[Submap], rng: np.random.Generator) -> None:
    named = [s.landmarks.ids + 1000 for s in chain]
    known = [s.landmarks.dense_information() for s in chain]
    a, b = SubmapProblem(chain, ids=named, information=known), SubmapProblem(relabel(chain, named))
    np.testing.assert_array_equal(a.ids, b.ids)
    x = a.initial() + 0.1 * rng.standard_normal(a.size)
    assert a.objective(x) == pytest.approx(b.objective(x), rel=1e-9)


def test_gradient_matches_finite_differences(chain: list[Submap], rng: np.random.Generator) -> None:
    problem = SubmapProblem(chain)
    x = problem.initial() + 0.1 * rng.standard_normal(problem.size)
    _, g, _ = problem.linearise(x)
    h = 1e-5
    for i in rng.choice(problem.size, 25, replace=False):
        e = np.zeros(problem.size)
        e[i] = h
        numeric = (problem.objective(x + e) - problem.objective(x - e)) / (2 * h)
        assert 2.0 * g[i] == pytest.approx(numeric, rel=1e-6, abs=1e-4)


def test_a_step_of_a_linear_problem_ends_at_its_minimum(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, known_heading=True)
    problem = SubmapProblem(submaps)
    best = minimise_submaps(problem, problem.initial())
    assert best.converged
    assert best.iterations <= 3
    assert best.history[1] == pytest.approx(best.objective, rel=1e-6)
    _, g, data = problem.linearise(best.x)
    step = problem.pattern.factor(data).solve(g)
    assert np.abs(step).max() < 1e-7


def test_covariance_scale_divides_the_objective_and_scales_the_submaps_alike(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng)
    x = SubmapProblem(submaps).initial()
    f = SubmapProblem(submaps).objective_per_submap(x)
    factors = rng.uniform(0.5, 3.0, len(submaps))
    scaled = SubmapProblem(submaps, scale=factors).objective_per_submap(x)
    np.testing.assert_allclose(scaled, f / factors, rtol=1e-12)
    other = SubmapProblem(scale_covariances(submaps, factors)).objective_per_submap(x)
    np.testing.assert_allclose(other, scaled, rtol=1e-9)


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf])
def test_impossible_scales_are_refused(rng: np.random.Generator, factor: float) -> None:
    submaps, _ = submap_chain(rng, submaps=2)
    with pytest.raises(DataError, match="scale"):
        SubmapProblem(submaps, scale=factor)
    with pytest.raises(DataError, match="scale"):
        scale_covariances(submaps, factor)


def test_fusing_repeated_landmarks_moves_no_minimum(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=6)
    twice = with_repeated_landmark(submaps, 3)
    fused = [replace(s, landmarks=fuse_repeated(s.landmarks)) for s in twice]
    assert len(fused[3].landmarks) == len(twice[3].landmarks) - 1
    assert fused[2].landmarks is twice[2].landmarks
    a, b = solve_submaps(twice), solve_submaps(fused)
    assert np.array_equal(np.sort(a.landmark_ids), np.sort(b.landmark_ids))
    order = [int(np.flatnonzero(b.landmark_ids == j)[0]) for j in a.landmark_ids]
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-7)
    np.testing.assert_allclose(a.landmarks, b.landmarks[order], atol=1e-7)
    assert a.objective > b.objective + 1.0  # two landmarks metres apart were forced together
    np.testing.assert_allclose(a.pose_covariance(6), b.pose_covariance(6), rtol=1e-6)


def test_unidentified_landmarks_are_never_fused(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=1)
    lost = submaps[0].with_ids(np.full(len(submaps[0].landmarks), -1))
    assert fuse_repeated(lost.landmarks) is lost.landmarks


def test_a_submap_with_an_information_matrix_counts_like_its_covariance(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=5)
    sparse = []
    for s in submaps:
        I = np.linalg.inv(s.landmarks.covariance)
        m = replace(s.landmarks, covariance=None, information=sp.csc_matrix(0.5 * (I + I.T)))
        sparse.append(Submap.from_landmarks(s.key, m))
    a, b = solve_submaps(submaps), solve_submaps(sparse)
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-9)
    assert a.objective == pytest.approx(b.objective, rel=1e-8)


def test_indefinite_information_is_named(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=3)
    I = np.linalg.inv(submaps[1].landmarks.covariance)
    I[5, 5] *= -1.0
    bad = replace(submaps[1].landmarks, covariance=None, information=sp.csc_matrix(I))
    with pytest.raises(CovarianceError, match="submap 1"):
        SubmapProblem([submaps[0], replace(submaps[1], landmarks=bad), submaps[2]])


def test_bad_chains_are_refused(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=3)
    with pytest.raises(DataError, match="no submaps"):
        SubmapProblem([])
    lost = submaps[1].with_ids(np.where(np.arange(len(submaps[1].landmarks)) == 0, -1, submaps[1].landmarks.ids))
    with pytest.raises(DataError, match=r"submap 1 .*identity.*1 ids of -1"):
        SubmapProblem([submaps[0], lost])
    flying = Submap(key=7, interval=(0.0, 1.0), exit_pose=np.array([1.0, 0, 0, 0, 0, 0, 1]), exit_covariance=np.eye(6))
    with pytest.raises(DataError, match=r"submap 7 .*dimension"):
        SubmapProblem([flying])
    problem = SubmapProblem(submaps)
    with pytest.raises(GeometryError, match="initial poses"):
        problem.initial(np.zeros((2, 3)))
    with pytest.raises(GeometryError, match="initial landmarks"):
        problem.initial(None, np.full((len(problem.ids), 2), np.nan))


def test_submaps_without_landmarks_measure_their_ends(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=5)
    blind = Submap(
        key=2,
        interval=(2.0, 3.0),
        exit_pose=submaps[2].exit_pose,
        exit_covariance=submaps[2].exit_covariance,
    )
    none = submaps[2].landmarks.subset(np.zeros(0, dtype=int))
    empty = Submap.from_landmarks(2, replace(none, chart="group"))  # that of a right tangent
    a = solve_submaps([*submaps[:2], blind, *submaps[3:]])
    b = solve_submaps([*submaps[:2], empty, *submaps[3:]])
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-10)
    alone = solve_submaps([blind])
    np.testing.assert_allclose(alone.poses[1], blind.exit_pose, atol=1e-12)
    np.testing.assert_allclose(alone.pose_covariance(1), empty.landmarks.covariance, rtol=1e-9)
    assert alone.states == 3


def test_symmetric_factor_solves_and_names_singular_systems(rng: np.random.Generator) -> None:
    B = sp.random_array((90, 90), density=0.03, rng=rng)
    A = sp.csc_matrix(B @ B.T + sp.eye_array(90))
    factor = SymmetricFactor(A)
    inverse = np.linalg.inv(A.toarray())
    some = rng.choice(90, 70, replace=False)
    np.testing.assert_allclose(factor.inverse_block(some), inverse[np.ix_(some, some)], atol=1e-12)
    at = rng.choice(30, 20, replace=False) * 3
    blocks = [inverse[i : i + 3, i : i + 3] for i in at]
    np.testing.assert_allclose(factor.inverse_diagonal_blocks(at, 3), blocks, atol=1e-12)
    assert sorted(factor.order) == list(range(90))
    with pytest.raises(IndeterminateError, match="cannot be factorised"):
        SymmetricFactor(sp.csc_matrix((3, 3)))


def test_zero_covariance_is_refused_where_it_enters() -> None:
    with pytest.raises(CovarianceError, match="positive definite"):
        LandmarkMap(ids=np.array([1]), exit_pose=np.zeros(3), positions=np.zeros((1, 2)), covariance=np.zeros((5, 5)))


def test_a_bent_step_is_the_straight_one_to_first_order(rng: np.random.Generator) -> None:
    """The difference falls with the square of the step; a rigid turn of what follows a pose is followed exactly."""
    problem = SubmapProblem(submap_chain(rng, submaps=9, landmarks=30)[0])
    x = problem.initial()
    step = rng.standard_normal(problem.size)
    step[2 : 3 * problem.m : 3] *= 0.1
    gaps = [np.abs(problem.bent(x, h * step) - (x + h * step)).max() for h in (1e-2, 1e-3)]
    assert gaps[0] > 0.0
    assert gaps[1] / gaps[0] == pytest.approx(1e-2, rel=0.1)
    # turn everything behind the first end pose about it: in what the submaps measure, only one heading changes
    angle, pivot = 0.7, x[:2].copy()
    turn = np.zeros(problem.size)
    ends, marks = turn[: 3 * problem.m].reshape(-1, 3), turn[3 * problem.m :].reshape(-1, 2)
    behind = problem._first_owner >= 1
    poses, points = x[: 3 * problem.m].reshape(-1, 3), x[3 * problem.m :].reshape(-1, 2)
    J = np.array([[0.0, -1.0], [1.0, 0.0]])
    ends[:, :2] = angle * (poses[:, :2] - pivot) @ J.T
    ends[:, 2] = angle
    marks[behind] = angle * (points[behind] - pivot) @ J.T
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    bent = problem.bent(x, turn)
    np.testing.assert_allclose(
        bent[: 3 * problem.m].reshape(-1, 3)[:, :2], (poses[:, :2] - pivot) @ R.T + pivot, atol=1e-9
    )
    moved = bent[3 * problem.m :].reshape(-1, 2)
    np.testing.assert_allclose(moved[behind], (points[behind] - pivot) @ R.T + pivot, atol=1e-9)
    np.testing.assert_allclose(moved[~behind], points[~behind], atol=1e-12)
