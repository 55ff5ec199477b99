"""NEES up to a rigid motion: against explicit minimisation, blind to the frame, and χ² with three scalars less."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.geometry import se2_compose, se2_transform
from graphslam.evaluate.consistency import joint_nees, vector_pose_error
from graphslam.evaluate.gauge import aligned_nees, gauge_directions, inner_covariance

POSES = np.array([[1.0, 2.0, 0.3], [4.0, -1.0, 2.0], [0.5, 5.0, -3.0]])
POINTS = np.array([[3.0, 3.0], [-2.0, 1.0], [0.0, -4.0], [6.0, 1.0]])


def covariance(rng, n=17):
    A = rng.normal(size=(n, n)) * 0.03
    return A @ A.T + 1e-4 * np.eye(n)


def error(poses, points):
    return np.concatenate([vector_pose_error(POSES, poses).ravel(), (points - POINTS).ravel()])


def test_directions_are_derivatives_of_a_rigid_motion():
    G = gauge_directions(POSES, POINTS)
    for k in range(3):
        T = 1e-6 * np.eye(3)[k]
        moved = error(se2_compose(T, POSES), se2_transform(T, POINTS)) / 1e-6
        np.testing.assert_allclose(moved, G[:, k], atol=1e-5)


NONE = np.zeros((0, 3))


def drawn(rng, P, T=(0.0, 0.0, 0.0)):
    """Truth that differs from the estimate by an error of covariance ``P``, in a frame moved by ``T``."""
    e = rng.multivariate_normal(np.zeros(17), P)
    poses, points = POSES + e[:9].reshape(-1, 3), POINTS + e[9:].reshape(-1, 2)
    return se2_compose(np.array(T), poses), se2_transform(np.array(T), points)


def test_equals_the_minimum_over_explicit_motions(rng):
    P = covariance(rng)
    u, v = drawn(rng, P)
    found = minimize(
        lambda T: joint_nees(error(se2_compose(T, u), se2_transform(T, v)), covariance=P),
        np.zeros(3),
        method="Powell",
        tol=1e-12,
    ).fun
    assert aligned_nees(POSES, POINTS, (u, v), P) == pytest.approx(found, rel=1e-5)
    assert aligned_nees(POSES, POINTS, (u, v), P) < joint_nees(error(u, v), covariance=P)


@pytest.mark.parametrize("T", [(0.4, -0.2, 0.03), (50.0, 0.0, np.pi), (-3.0, 7.0, 1.5)])
def test_the_frame_of_the_truth_does_not_matter(rng, T):
    P = covariance(rng)
    u, v = drawn(rng, P)
    alone = aligned_nees(POSES, POINTS, (u, v), P)
    moved = se2_compose(np.array(T), u), se2_transform(np.array(T), v)
    assert aligned_nees(POSES, POINTS, moved, P) == pytest.approx(alone, rel=1e-9)
    assert joint_nees(error(*moved), covariance=P) > 2 * joint_nees(error(u, v), covariance=P)


def test_mean_is_three_scalars_less(rng):
    P = 0.01 * covariance(rng)
    n = 1500
    mean = np.mean([aligned_nees(POSES, POINTS, drawn(rng, P), P) for _ in range(n)])
    assert mean == pytest.approx(14.0, abs=4 * np.sqrt(2 * 14 / n))


def test_what_cannot_be_judged_is_refused():
    with pytest.raises(DataError, match="do not fit"):
        aligned_nees(POSES[:1], NONE, (POSES[:1], NONE), np.eye(3))
    with pytest.raises(DataError, match="do not fit"):
        aligned_nees(POSES, NONE, (POSES[:2], NONE), np.eye(9))
    twice = np.array([[1.0, 1.0], [1.0, 1.0]])
    with pytest.raises(CovarianceError, match="not determined"):
        aligned_nees(NONE, twice, (NONE, twice), np.eye(4))


@pytest.mark.parametrize(("m", "n"), [(1, 0), (0, 1), (2, 0), (1, 3)])
def test_directions_of_few_and_of_single_rows(m, n):
    """A pose or a point may come as a plain row; nothing else moves."""
    G = gauge_directions(POSES[0] if m == 1 else POSES[:m], POINTS[0] if n == 1 else POINTS[:n])
    assert G.shape == (3 * m + 2 * n, 3)
    whole = gauge_directions(POSES, POINTS)
    np.testing.assert_array_equal(G, whole[[*range(3 * m), *range(9, 9 + 2 * n)]])


def test_four_scalars_are_enough_and_leave_one_degree_of_freedom(rng):
    """Two points: the motion takes three numbers, what is left is how far they are apart, measured with its own σ."""
    points = np.array([[1.0, 0.0], [-1.0, 0.0]])
    P = np.diag([0.04, 1.0, 0.05, 1.0])
    true = np.array([[1.3, 0.2], [-1.6, 0.2]])
    assert aligned_nees(NONE, points, (NONE, true), P) == pytest.approx(0.9**2 / 0.09)
    with pytest.raises(CovarianceError, match=r"wanted \(4, 4\)"):
        aligned_nees(NONE, points, (NONE, true), np.eye(5))


def test_shapes_that_do_not_fit_are_refused():
    G = gauge_directions(np.zeros((0, 3)), POINTS)
    with pytest.raises(DataError, match="do not fit"):
        inner_covariance(np.eye(7), G)


def test_inner_covariance_is_that_of_aligned_errors(rng):
    P = covariance(rng, 8)
    G = gauge_directions(np.zeros((0, 3)), POINTS - POINTS.mean(axis=0))
    got = inner_covariance(P, G)
    draws = rng.multivariate_normal(np.zeros(8), P, size=20000)
    left = draws - (G @ np.linalg.lstsq(G, draws.T, rcond=None)[0]).T
    np.testing.assert_allclose(got, np.cov(left.T), atol=0.05 * np.diag(got).max())
    np.testing.assert_allclose(got @ G, 0, atol=1e-12)
    np.testing.assert_array_equal(got, got.T)
    # the frame in which the map was first known does not matter
    np.testing.assert_allclose(inner_covariance(P + G @ np.diag([4.0, 4.0, 0.1]) @ G.T, G), got, atol=1e-9)
