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


def test_equals_the_minimum_over_explicit_motions(rng):
    P = covariance(rng)
    e = rng.multivariate_normal(np.zeros(17), P)
    G = gauge_directions(POSES, POINTS)
    found = minimize(lambda d: joint_nees(e + G @ d, covariance=P), np.zeros(3), method="Powell", tol=1e-12).fun
    assert aligned_nees(e, P, G) == pytest.approx(found, rel=1e-5)
    assert aligned_nees(e, P, G) < joint_nees(e, covariance=P)


def test_the_frame_of_the_truth_does_not_matter(rng):
    P, G = covariance(rng), gauge_directions(POSES, POINTS)
    e = rng.multivariate_normal(np.zeros(17), P)
    moved = e + G @ np.array([0.4, -0.2, 0.03])
    assert aligned_nees(moved, P, G) == pytest.approx(aligned_nees(e, P, G), rel=1e-9)
    assert joint_nees(moved, covariance=P) > 2 * joint_nees(e, covariance=P)


def test_mean_is_three_scalars_less(rng):
    P, G = covariance(rng), gauge_directions(POSES, POINTS)
    draws = rng.multivariate_normal(np.zeros(17), P, size=4000)
    mean = np.mean([aligned_nees(e, P, G) for e in draws])
    assert mean == pytest.approx(14.0, abs=4 * np.sqrt(2 * 14 / 4000))


def test_what_cannot_be_judged_is_refused(rng):
    with pytest.raises(DataError, match="do not fit"):
        aligned_nees(np.zeros(3), np.eye(3), np.zeros((3, 3)))
    twice = np.array([[1.0, 1.0], [1.0, 1.0]])
    with pytest.raises(CovarianceError, match="not determined"):
        aligned_nees(np.zeros(4), np.eye(4), gauge_directions(np.zeros((0, 3)), twice))


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
    e = np.array([0.3, 0.2, -0.6, 0.7])
    G = gauge_directions(np.zeros((0, 3)), points)
    assert aligned_nees(e, P, G) == pytest.approx(0.9**2 / 0.09)
    with pytest.raises(CovarianceError, match=r"wanted \(4, 4\)"):
        aligned_nees(e, np.eye(5), G)


@pytest.mark.parametrize(("apart", "judged"), [(3e-9, True), (1.4e-9, False)])
def test_points_that_coincide_do_not_hold_a_heading(apart, judged):
    """Below 1e-9 of the size of a shift, the square of a turn is lost in double precision (1e-16 of it)."""
    G = gauge_directions(np.zeros((0, 3)), [[apart / 2, 0.0], [-apart / 2, 0.0]])
    # a shift of both changes √2, a turn of one radian apart / √2
    if judged:
        assert aligned_nees([1.0, 0.0, -1.0, 0.0], np.eye(4), G) == pytest.approx(2.0)
    else:
        with pytest.raises(CovarianceError, match="not determined"):
            aligned_nees([1.0, 0.0, -1.0, 0.0], np.eye(4), G)


def test_shapes_that_do_not_fit_are_refused():
    G = gauge_directions(np.zeros((0, 3)), POINTS)
    for error_, directions in ((np.zeros((8, 1)), G), (np.zeros(7), G), (np.zeros(8), G[:, :2])):
        with pytest.raises(DataError, match="do not fit"):
            aligned_nees(error_, np.eye(len(error_)), directions)
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
