"""Gravity seen from a node: two degrees of freedom, roll and pitch, that do not drift.

The frame of the first base was levelled by the same gravity as every other one, with an error of its own, so its z axis
is not exactly up. The *tilt* τ ``(2,)`` says where up is in that frame, ``u(τ) = Exp([τ_x, τ_y, 0]) e_z``, and is a
variable: held by what the first base itself saw of gravity (a factor on x_0) and by all others. Without it the error
of one levelling would turn the whole map, unnoticed by its covariances.

The residual of a node is the part of the predicted direction ``h = -R_kᵀ u(τ)`` that lies across the measured one,
``r = Bᵀ h`` with ``B`` ``(3, 2)`` across ``direction``: the sine of the angle between the two, within a quarter turn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.se3 import quat_rotate, quat_to_matrix, skew, so3_exp, so3_left_jacobian
from graphslam.graph.families import UniformFamily
from graphslam.graph.records import AttitudeRecord
from graphslam.graph.state import Layout, Values

DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of gravity in a level frame."""


def across(direction: ArrayLike) -> Array:
    """Two orthonormal columns ``(..., 3, 2)`` across unit vectors ``(..., 3)``; for :data:`DOWN` the axes x and y."""
    d = np.asarray(direction, dtype=np.float64)
    axis = np.where(np.abs(d[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    first = axis - np.sum(axis * d, axis=-1, keepdims=True) * d
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(first, d)], axis=-1)


def up_turn(tilt: ArrayLike) -> tuple[Array, Array]:
    """Rotation ``Exp([τ_x, τ_y, 0])`` ``(3, 3)`` from level axes to those of the first base, and ``J_r`` ``(3, 2)``."""
    w = np.append(np.asarray(tilt, dtype=np.float64), 0.0)
    return quat_to_matrix(so3_exp(w)), so3_left_jacobian(-w)[:, :2]


def attitude_terms(poses: Array, tilt: Array, direction: Array) -> tuple[Array, Array]:
    """Residuals ``(k, 2)`` and Jacobians ``(k, 2, 8)`` on (pose (6), tilt (2)), not whitened.

    Parameters
    ----------
    poses : (k, 7)
    tilt : (2,)
    direction : (k, 3)
    """
    E, J_r = up_turn(tilt)
    conjugate = poses[:, 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    h = quat_rotate(conjugate, -E[:, 2])
    Bt = np.swapaxes(across(direction), 1, 2)
    J = np.zeros((len(poses), 2, 8))
    J[:, :, :3] = Bt @ skew(h)  # R Exp(δ): h → Exp(-δ) h = h + h × δ
    # u(τ + δ) = Exp(ω) Exp(J_r δ) e_z = u - Exp(ω) [e_z]× J_r δ, and h = -Rᵀ u
    J[:, :, 6:] = Bt @ np.swapaxes(quat_to_matrix(poses[:, 3:]), 1, 2) @ (E @ skew([0.0, 0.0, 1.0]) @ J_r)
    return (Bt @ h[..., None])[..., 0], J


class AttitudeFamily(UniformFamily):
    """Directions of gravity."""

    record = AttitudeRecord

    def __init__(self, records: Sequence[AttitudeRecord], layout: Layout) -> None:
        super().__init__(records, layout)
        self._node = np.array([r.node for r in records], dtype=np.int64)
        self._direction = np.array([r.direction for r in records]).reshape(-1, 3)
        self._W = np.array([r.whitener for r in records]).reshape(-1, 2, 2)
        tilt = np.broadcast_to(layout.tilt_start + np.arange(2), (len(records), 2))
        self._set_columns(np.concatenate([layout.pose_columns(self._node), tilt], axis=1))

    def terms(self, values: Values) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.families.UniformFamily.terms`."""
        assert values.tilt is not None
        r, J = attitude_terms(values.poses[self._node], values.tilt, self._direction)
        return np.einsum("kij,kj->ki", self._W, r), self._W @ J
