"""Means and scatters of poses, level frames, and consistent covariances of exits: worked cases, laws, Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from graphslam.core import se3
from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.poses import (
    SE2,
    SE3,
    Group,
    frame_between,
    group_of,
    heading_of,
    normalise_weights,
    pose_mean,
    pose_scatter,
    remove_roll_pitch,
)
from graphslam_frontends.segslam.covariance import exit_covariance
from graphslam_studies.evaluate.exit_nees import exit_nees

GROUPS = [SE2, SE3]


def _cloud(g: Group, n: int, seed: int, scale: float = 0.1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centre = g.exp(rng.normal(0.0, 1.0, g.dof))
    return g.compose(np.broadcast_to(centre, (n, g.size)), g.exp(scale * rng.normal(size=(n, g.dof))))


@pytest.mark.parametrize("g", GROUPS, ids=["SE2", "SE3"])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999), scale=st.sampled_from([1e-9, 0.01, 0.4]))
def test_the_mean_is_the_pose_of_least_squares(g: Group, seed: int, scale: float) -> None:
    """Its first-order condition holds, and it moves and turns with the cloud."""
    p = _cloud(g, 7, seed, scale)
    w = np.random.default_rng(seed).uniform(0.1, 1.0, 7)
    mean = pose_mean(p, w)
    e = g.log(g.between(np.broadcast_to(mean, p.shape), p))
    np.testing.assert_allclose(w @ e, 0.0, atol=1e-10)
    T = g.exp(np.random.default_rng(seed + 1).normal(size=g.dof))
    moved = pose_mean(g.compose(np.broadcast_to(T, p.shape), p), w)
    np.testing.assert_allclose(g.log(g.between(g.compose(T, mean), moved)), 0.0, atol=1e-9)


def test_the_mean_of_headings_lies_on_the_circle() -> None:
    p = np.array([[1.0, 0.0, np.pi - 0.1], [1.0, 0.0, -np.pi + 0.3]])
    assert abs(abs(pose_mean(p)[2]) - (np.pi - 0.1)) < 1e-9
    assert heading_of(pose_mean(p, [3.0, 1.0])) == pytest.approx(np.pi, abs=1e-9)
    single = pose_mean(p[:1])
    np.testing.assert_allclose(single, p[0])


def test_the_mean_of_rotations_is_that_of_a_general_optimiser() -> None:
    p = _cloud(SE3, 5, 3, 0.3)
    p[:, :3] = 0.0  # rotations alone, for which the cost below is the Karcher mean's

    def cost(x: np.ndarray) -> float:
        T = SE3.compose(p[0], SE3.exp(np.concatenate([x, np.zeros(3)])))
        return float(np.sum(SE3.log(SE3.between(np.broadcast_to(T, p.shape), p))[:, :3] ** 2))

    best = optimize.minimize(cost, np.zeros(3), tol=1e-14).x
    expected = SE3.compose(p[0], SE3.exp(np.concatenate([best, np.zeros(3)])))
    np.testing.assert_allclose(se3.pose_to_matrix(pose_mean(p)), se3.pose_to_matrix(expected), atol=1e-6)


def test_scatter_of_a_worked_cloud() -> None:
    # two poses ± 0.3 m ahead of one that looks to the left: ahead is x of its tangent
    p = np.array([[0.0, 0.3, np.pi / 2], [0.0, -0.3, np.pi / 2]])
    np.testing.assert_allclose(pose_scatter(p, [0.0, 0.0, np.pi / 2]), np.diag([0.09, 0.0, 0.0]), atol=1e-15)
    # about another point: the offset is added
    np.testing.assert_allclose(pose_scatter(p, p[0]), np.diag([0.18, 0.0, 0.0]), atol=1e-15)
    np.testing.assert_allclose(pose_scatter(p, p[0], [1.0, 0.0]), 0.0, atol=1e-15)


def test_level_frames_keep_place_and_heading() -> None:
    rng = np.random.default_rng(0)
    p = SE3.exp(rng.normal(0.0, 0.4, (50, 6)))
    flat = remove_roll_pitch(p)
    np.testing.assert_array_equal(flat[:, :3], p[:, :3])
    np.testing.assert_allclose(heading_of(flat), heading_of(p), atol=1e-12)
    np.testing.assert_allclose(se3.quat_rotate(flat[:, 3:], np.array([0.0, 0, 1])), [[0.0, 0, 1]] * 50, atol=1e-12)
    ahead = se3.quat_rotate(p[:, 3:], np.array([1.0, 0, 0]))  # heading is where x points, seen from above
    np.testing.assert_allclose(heading_of(p), np.arctan2(ahead[:, 1], ahead[:, 0]), atol=1e-12)
    np.testing.assert_array_equal(remove_roll_pitch([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])
    # frames that differ by a turn about z: exactly that turn comes back, however the body leans
    a = np.concatenate([[3.0, -2.0, 1.0], se3.so3_exp([0.0, 0.0, 0.8])])
    T_a_b = frame_between(se3.se3_compose(np.broadcast_to(a, p.shape), p), p, gravity=True)
    np.testing.assert_allclose(se3.pose_to_matrix(T_a_b), np.broadcast_to(se3.pose_to_matrix(a), (50, 4, 4)), atol=1e-9)


def test_impossible_poses_and_weights_are_refused() -> None:
    with pytest.raises(GeometryError, match="wrong shape"):
        group_of(np.zeros(4))
    with pytest.raises(GeometryError, match="no poses"):
        pose_mean(np.zeros((0, 3)))
    for bad in ([0.0, 0.0], [1.0, -0.5], [1.0, np.nan], [1.0]):
        with pytest.raises(GeometryError, match="impossible weights"):
            normalise_weights(bad, 2)


def test_an_exit_has_the_particles_and_the_drift() -> None:
    exits = np.array([[10.0, 0.1, 0.0], [10.0, -0.1, 0.0]])
    drift = np.diag([0.04, 0.09, 1e-4])
    c = exit_covariance(exits, [10.0, 0.0, 0.0], drift, drift_scale=2.0)
    np.testing.assert_allclose(c.total, np.diag([0.08, 0.18 + 0.01, 2e-4]))
    np.testing.assert_allclose(c.particles, np.diag([0.0, 0.01, 0.0]), atol=1e-15)
    np.testing.assert_allclose(c.matched, np.diag([1e-4, 0.01 + 1e-4, 1e-6]))
    assert c.effective == 2.0
    # handed over is another pose than the mean: its offset is part of the covariance, not of the moments
    c = exit_covariance(exits, exits[0], drift)
    np.testing.assert_allclose(c.particles[1, 1], 0.02)
    np.testing.assert_allclose(c.matched[1, 1], 0.01 + 1e-4)
    one = exit_covariance(exits[:1], exits[0], drift)
    np.testing.assert_allclose(one.total, one.drift)
    assert one.effective == 1.0


def test_a_drift_model_that_gives_none_is_refused() -> None:
    for bad in (np.zeros((3, 3)), np.full((3, 3), np.nan), np.eye(6), -np.eye(3)):
        with pytest.raises(CovarianceError):
            exit_covariance(np.zeros((2, 3)), np.zeros(3), bad)


@pytest.mark.parametrize("g", GROUPS, ids=["SE2", "SE3"])
def test_particles_with_a_common_error_are_consistent_with_drift_and_not_without(g: Group) -> None:
    """The truth differs from the particles' mean by what particles have (S) and by what they share (D)."""
    rng = np.random.default_rng(4)
    runs, n = 400, 40
    S = np.diag(np.full(g.dof, 0.003**2))
    D = np.diag(np.full(g.dof, 0.03**2))
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    for _ in range(runs):
        centre = g.exp(rng.normal(0.0, 1.0, g.dof))
        own = g.exp(rng.multivariate_normal(np.zeros(g.dof), S, n + 1))
        bodies = g.compose(np.broadcast_to(centre, own.shape), own)
        truth = g.compose(bodies[n], g.exp(rng.multivariate_normal(np.zeros(g.dof), D)))
        c = exit_covariance(bodies[:n], pose_mean(bodies[:n]), D, floor_position=1e-6, floor_angle=1e-6)
        rows.append((c.pose, c.total, c.matched, truth))
    T, P, M, X = (np.stack(r) for r in zip(*rows))
    consistent = exit_nees(T, P, X)
    low, high = chi2_mean_bounds(g.dof, runs, 0.999)
    assert low < consistent.values.mean() < high
    assert 0.92 < consistent.inside() < 0.98
    assert exit_nees(T, M, X).per_dof > 50  # the paper's moments alone
    some = exit_nees(T, P, X, components=(2, 0))
    assert some.dof == 2
    np.testing.assert_allclose(some.errors, consistent.errors[:, [2, 0]])


def test_nees_of_a_worked_case() -> None:
    r = exit_nees([[0.0, 0.0, 0.0]], [np.diag([0.25, 1.0, 0.01])], [[1.0, 0.0, 0.0]])
    assert r.values.tolist() == [4.0]
    assert (r.dof, r.per_dof, r.inside(0.95)) == (3, 4.0 / 3.0, 1.0)
