"""SE(2) and SE(3) behind one face, so that one law is tested on both; with samples where formulas break."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from hypothesis import strategies as st

from graphslam.core import geometry, se3
from graphslam.core.geometry import wrap_angle


@dataclass(frozen=True)
class Group:
    """One Lie group: our functions, GTSAM's type, and the matrix form."""

    name: str
    dim: int
    identity: np.ndarray
    compose: Callable[..., Any]
    inverse: Callable[..., Any]
    between: Callable[..., Any]
    transform: Callable[..., Any]
    exp: Callable[..., Any]
    log: Callable[..., Any]
    adjoint: Callable[..., Any]
    right_jacobian: Callable[..., Any]
    to_gtsam: Callable[[np.ndarray], Any]
    from_gtsam: Callable[[Any], np.ndarray]
    matrix: Callable[[np.ndarray], np.ndarray]
    hat: Callable[[np.ndarray], np.ndarray]
    angle_of: slice

    def difference(self, a: np.ndarray, b: np.ndarray) -> float:
        """Largest deviation of two poses; q and -q are the same rotation, θ lives on the circle."""
        if self.dim == 3:
            d = np.asarray(a) - b
            return float(np.max(np.abs(np.concatenate([d[..., :2].ravel(), wrap_angle(d[..., 2]).ravel()]))))
        return float(np.max(np.abs(se3.pose_to_matrix(a) - se3.pose_to_matrix(b))))


def _pose3(T: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Quaternion(T[6], T[3], T[4], T[5]), T[:3])


def _from_pose3(p: gtsam.Pose3) -> np.ndarray:
    q = p.rotation().toQuaternion()
    return np.array([*p.translation(), q.x(), q.y(), q.z(), q.w()])


def _matrix2(T: np.ndarray) -> np.ndarray:
    M = np.eye(3)
    M[:2, :2], M[:2, 2] = geometry.rotation2(T[2]), T[:2]
    return M


def _hat2(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[0]], [v[2], 0.0, v[1]], [0.0, 0.0, 0.0]])


def _hat3(v: np.ndarray) -> np.ndarray:
    M = np.zeros((4, 4))
    M[:3, :3], M[:3, 3] = se3.skew(v[:3]), v[3:]
    return M


SE2 = Group(
    "SE2",
    3,
    np.zeros(3),
    geometry.se2_compose,
    geometry.se2_inverse,
    geometry.se2_between,
    geometry.se2_transform,
    geometry.se2_exp,
    geometry.se2_log,
    geometry.se2_adjoint,
    geometry.se2_right_jacobian,
    lambda T: gtsam.Pose2(*T),
    lambda p: np.array([p.x(), p.y(), p.theta()]),
    _matrix2,
    _hat2,
    slice(2, 3),
)
SE3 = Group(
    "SE3",
    6,
    np.array([0.0, 0, 0, 0, 0, 0, 1]),
    se3.se3_compose,
    se3.se3_inverse,
    se3.se3_between,
    se3.se3_transform,
    se3.se3_exp,
    se3.se3_log,
    se3.se3_adjoint,
    se3.se3_right_jacobian,
    _pose3,
    _from_pose3,
    se3.pose_to_matrix,
    _hat3,
    slice(0, 3),
)
GROUPS = [SE2, SE3]

# angles where sin(θ)/θ, (1 - cos θ)/θ², θ/2 cot θ/2 … change formula or lose digits, and ordinary ones
_ANGLES = st.one_of(
    st.just(0.0),
    st.floats(-1e-3, 1e-3),
    st.floats(1e-10, 1e-6),
    st.sampled_from([9.99e-5, 1.0e-4, 1.01e-4, 9.99e-4, 1.0e-3, 1.01e-3, 9.99e-3, 1.01e-2]),
    st.floats(-3.1, 3.1),
    st.floats(1e-9, 1e-3).map(lambda e: np.pi - e),
)


@st.composite
def tangents(draw: Any, group: Group, *, reach: float = 50.0) -> np.ndarray:
    """Tangent vectors with an angle in (-π, π), often near 0 and near π, about any axis."""
    angle = draw(_ANGLES)
    position = [draw(st.floats(-reach, reach)) for _ in range(2 if group is SE2 else 3)]
    if group is SE2:
        return np.array([*position, angle])
    z = draw(st.floats(-1.0, 1.0))
    azimuth = draw(st.floats(0.0, 2.0 * np.pi))
    r = np.sqrt(max(1.0 - z * z, 0.0))
    axis = np.array([r * np.cos(azimuth), r * np.sin(azimuth), z])
    return np.concatenate([angle * axis, position])
