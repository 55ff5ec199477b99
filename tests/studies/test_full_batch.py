"""Full batch against the slow and obvious one, and its covariance against what it should mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.worlds import simulate
from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_adjoint, se2_compose, se2_inverse, se2_transform
from graphslam.core.log import SensorLog
from graphslam_frontends.odometry.motion import MotionNoise, steering_odometry
from graphslam_studies.baselines.full_batch import FullBatch, full_batch
from tests.reference.batch_slam import batch_slam


def solve(log: SensorLog) -> FullBatch:
    """From a start that is off by decimetres."""
    noise, obs = log.meta["noise"], log["landmarks"]
    motion = MotionNoise(speed=noise["speed"], steering=noise["steering"], floor_position=1e-6, floor_heading=1e-8)
    odo = steering_odometry(log["controls"], np.concatenate([[0.0], obs.times]), motion)
    rng = np.random.default_rng(1)
    poses = log.truth.trajectory.interpolate(obs.times) + 0.05 * rng.standard_normal((len(obs.times), 3))
    marks = log.truth.landmarks + 0.3 * rng.standard_normal(log.truth.landmarks.shape)
    increments, covariances = odo.increments[1:], odo.covariances[1:]
    return full_batch(increments, covariances, obs, initial_poses=poses, initial_landmarks=dict(enumerate(marks)))


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return simulate("landmark-field", preset="quick", seed=3)


def test_same_optimum_and_covariance_as_the_slow_twin(log: SensorLog) -> None:
    fast, slow = solve(log), batch_slam(log)
    assert fast.converged
    assert fast.objective == pytest.approx(slow.chi2, rel=1e-9)
    assert fast.dof == slow.dof
    np.testing.assert_allclose(fast.poses, slow.poses, atol=1e-5)
    np.testing.assert_allclose(fast.landmarks, slow.landmarks, atol=1e-5)
    P = slow.covariance()
    n = 3 * (len(slow.poses) - 1)
    np.testing.assert_allclose(fast.landmark_covariance(), P[n:, n:], rtol=1e-4, atol=1e-7)
    last = len(slow.poses) - 1
    R = np.eye(3)
    c, s = np.cos(slow.poses[-1, 2]), np.sin(slow.poses[-1, 2])
    R[:2, :2] = [[c, -s], [s, c]]
    np.testing.assert_allclose(
        fast.pose_covariances([last])[0], R @ P[n - 3 : n, n - 3 : n] @ R.T, rtol=1e-4, atol=1e-9
    )


def test_consistent_on_average() -> None:
    """χ²/dof of objective and NEES of the last pose and landmarks over runs, two-sided (4σ of their chi-squares)."""
    chi2, dof, nees, n = 0.0, 0, 0.0, 0
    for seed in range(12):
        log = simulate("landmark-field", preset="quick", seed=seed, layout_seed=5)
        b = solve(log)
        chi2, dof = chi2 + b.objective, dof + b.dof
        e = (b.landmarks - log.truth.landmarks[b.landmark_ids]).ravel()
        nees, n = nees + e @ np.linalg.solve(b.landmark_covariance(), e), n + len(e)
    assert abs(chi2 / dof - 1) < 4 * np.sqrt(2 / dof)
    assert abs(nees / n - 1) < 4 * np.sqrt(2 / n)


def test_a_sensor_away_from_the_base_sees_the_same_world(log: SensorLog) -> None:
    """The same data read as those of a sensor at S: motion S⁻¹ u S makes the same problem, bases are moved by S⁻¹."""
    S = np.array([1.2, -0.4, 0.3])
    noise, obs = log.meta["noise"], log["landmarks"]
    motion = MotionNoise(speed=noise["speed"], steering=noise["steering"], floor_position=1e-6, floor_heading=1e-8)
    odo = steering_odometry(log["controls"], np.concatenate([[0.0], obs.times]), motion)
    A = se2_adjoint(S)
    moved = se2_compose(S, se2_compose(odo.increments[1:], se2_inverse(S)))
    Q = A @ odo.covariances[1:] @ A.T
    plain = solve(log)
    to_sensor = se2_compose(S, se2_compose(plain.poses, se2_inverse(S)))  # bases of a vehicle that carries it at S
    other = full_batch(
        moved,
        Q,
        replace(obs, T_base_sensor=S),
        initial_poses=to_sensor[1:] + 0.01,
        initial_landmarks=dict(zip(plain.landmark_ids.tolist(), se2_transform(S, plain.landmarks), strict=True)),
    )
    assert other.objective == pytest.approx(plain.objective, rel=1e-9)
    np.testing.assert_allclose(other.poses, to_sensor, atol=1e-6)
    np.testing.assert_allclose(other.landmarks, se2_transform(S, plain.landmarks), atol=1e-6)


def test_bad_input_is_refused(log: SensorLog) -> None:
    obs = log["landmarks"]
    n = len(obs.times)
    u, Q = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))
    with pytest.raises(DataError, match="no start"):
        full_batch(u, Q, obs, initial_poses=u, initial_landmarks={})
    with pytest.raises(DataError, match="one increment"):
        full_batch(u[1:], Q[1:], obs, initial_poses=u, initial_landmarks={})
    with pytest.raises(DataError, match="identities"):
        full_batch(u, Q, replace(obs, ids=None), initial_poses=u, initial_landmarks={})
