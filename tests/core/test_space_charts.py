"""The group chart in space: its pose block is the right tangent, and its slopes are those of finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.charts import inverse_left_jacobian_slopes, inverse_left_jacobians, map_difference
from graphslam.core.submap import LandmarkMap, Submap, turned_covariance


def poses(rng: np.random.Generator, n: int, turn: float = 1.0) -> np.ndarray:
    return np.hstack([rng.normal(size=(n, 3)), se3.so3_exp(turn * rng.normal(size=(n, 3)))])


@pytest.mark.parametrize("angle", [1e-4, 0.02, 0.099, 0.101, 0.8, 2.5])
def test_slopes_are_those_of_finite_differences(angle: float) -> None:
    rng = np.random.default_rng(0)
    w, e = rng.normal(size=(2, 6, 3))
    w *= angle / np.linalg.norm(w, axis=1)[:, None]
    h = 1e-6
    columns = []
    for step in h * np.eye(3):
        ahead, behind = (np.einsum("kij,kj->ki", inverse_left_jacobians(w + s), e) for s in (step, -step))
        columns.append((ahead - behind) / (2 * h))
    np.testing.assert_allclose(inverse_left_jacobian_slopes(w, e), np.stack(columns, -1), atol=3e-9)


def test_a_pose_alone_is_gaussian_in_its_right_tangent() -> None:
    rng = np.random.default_rng(1)
    mean, other = poses(rng, 2, 0.7)
    L = rng.normal(size=(6, 6))
    P_tangent = L @ L.T + np.eye(6)
    P = turned_covariance(se3.quat_to_matrix(mean[3:]), P_tangent)
    u = map_difference(other, mean, "group", space=True)
    xi = se3.se3_log(se3.se3_between(mean, other))
    assert u @ np.linalg.solve(P, u) == pytest.approx(xi @ np.linalg.solve(P_tangent, xi), rel=1e-12)


def test_what_moves_with_the_end_hardly_differs() -> None:
    """End and landmarks turned together about the base: in the group chart they err by the turn alone."""
    rng = np.random.default_rng(2)
    mean, points = poses(rng, 1)[0], 10.0 * rng.normal(size=(5, 3))
    turn = np.concatenate([np.zeros(3), se3.so3_exp(np.array([0.3, -0.5, 0.2]))])
    moved = np.concatenate([se3.se3_compose(turn, mean), se3.se3_transform(turn, points).ravel()])
    u = map_difference(moved, np.concatenate([mean, points.ravel()]), "group", space=True)
    w = u[:3]
    np.testing.assert_allclose(w, [0.3, -0.5, 0.2], atol=1e-12)
    # V⁻¹ (R l - l) = w × l: linear in the turn, exactly
    np.testing.assert_allclose(u[6:].reshape(-1, 3), np.cross(w, points), atol=1e-11)


def test_the_exit_of_a_landmark_submap_has_the_covariance_of_its_right_tangent() -> None:
    rng = np.random.default_rng(3)
    pose = poses(rng, 1)[0]
    L = rng.normal(size=(9, 9))
    m = LandmarkMap(ids=[4], exit_pose=pose, positions=rng.normal(size=(1, 3)), covariance=L @ L.T + np.eye(9))
    submap = Submap.from_landmarks(0, m)
    back = turned_covariance(se3.quat_to_matrix(pose[3:]), submap.exit_covariance)
    np.testing.assert_allclose(back, m.dense_covariance()[:6, :6], atol=1e-12)
