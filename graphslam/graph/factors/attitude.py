"""Gravity direction in the frame of a node: constrains roll and pitch, without drift.

The frame of the first base was levelled like every other one, with its own error, so its z axis is not exactly up. The
variable *tilt* τ ``(2,)`` is the up direction in that frame, ``u(τ) = Exp([τ_x, τ_y, 0]) e_z``. It is constrained by
the gravity measured at the first base (a factor on x_0) and by all others. Without it, the error of one levelling would
rotate the whole map without any effect on its covariances.

The residual of a node is the part of the predicted direction ``h = -R_kᵀ u(τ)`` that is perpendicular to the measured
one, ``r = Bᵀ h`` with ``B`` ``(3, 2)`` perpendicular to ``direction``: the sine of the angle between them, up to 90°.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.se3 import quat_rotate, quat_to_matrix, skew, so3_exp, so3_left_jacobian
from graphslam.graph.factors.batch import Fixed, UniformBatch, safe_factor, unit_noise
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import gtsam_key

DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of gravity in a level frame."""

LEVELLED = "levelled"
"""Ledger kind and class of the attitude factors of levelled bases."""

GIVEN_UP = 1.0
"""σ of relative roll and pitch after they were replaced by absolute ones [rad]."""


def without_tilt(covariance: Array) -> Array:
    """An end-pose covariance ``(6, 6)`` without information on roll and pitch.

    A large variance added to two components does not change the marginal of the others: only the information on
    relative roll and pitch is removed.
    """
    out = covariance.copy()
    out[[0, 1], [0, 1]] += GIVEN_UP**2
    return out


def tangent_basis(direction: ArrayLike) -> Array:
    """Two orthonormal columns ``(..., 3, 2)`` perpendicular to unit vectors ``(..., 3)``; for :data:`DOWN` x and y."""
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
    Bt = np.swapaxes(tangent_basis(direction), 1, 2)
    J = np.zeros((len(poses), 2, 8))
    J[:, :, :3] = Bt @ skew(h)  # R Exp(δ): h → Exp(-δ) h = h + h × δ
    # u(τ + δ) = Exp(ω) Exp(J_r δ) e_z = u - Exp(ω) [e_z]× J_r δ, and h = -Rᵀ u
    J[:, :, 6:] = Bt @ np.swapaxes(quat_to_matrix(poses[:, 3:]), 1, 2) @ (E @ skew([0.0, 0.0, 1.0]) @ J_r)
    return (Bt @ h[..., None])[..., 0], J


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeRecord:
    """Direction of gravity at a node; see :mod:`graphslam.graph.factors.attitude` for the residual.

    Parameters
    ----------
    direction : (3,)
        Unit vector of gravity (down) in the node's frame.
    whitener : (2, 2)
        Of the two components perpendicular to ``direction`` [1/rad].
    """

    factor_id: int
    node: int
    direction: Array
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "attitude"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 2

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}", "tilt"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} of x{self.node} (factor {self.factor_id})"


class AttitudeBatch(UniformBatch):
    """Directions of gravity."""

    record = AttitudeRecord
    relative = True
    slots = ("x", "tilt")

    def __init__(self, records: Sequence[AttitudeRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._direction = np.array([r.direction for r in records]).reshape(-1, 3)

    @staticmethod
    def keys(record: AttitudeRecord) -> Sequence[int | None]:
        """Node, tilt."""
        return record.node, 0

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`UniformBatch.terms`."""
        x, tilt = blocks
        return attitude_terms(x, tilt[0], self._direction)

    @classmethod
    def gtsam(cls, record: AttitudeRecord, fixed: Fixed) -> gtsam.NonlinearFactor:
        """``W Bᵀ (-Rᵀ u(τ))`` in small matrices: the terms of the batch would take ten times as long for one row."""
        names = record.variables()
        rotation, tilt, known = _rotation(names[0], fixed), gtsam_key("tilt"), fixed.get("tilt")
        free = [n for n in names if n not in fixed]
        WB = record.whitener @ tangent_basis(record.direction).T
        down = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # [e_z]×

        def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
            R = rotation(values)
            E, J_r = level_turn(*(values.atVector(tilt) if known is None else known))
            h = -(R.T @ E[:, 2])
            if H is not None:
                if names[0] not in fixed:
                    J = np.zeros((2, 6), order="F")
                    J[:, :3] = WB @ skew_of(h)
                    H[0] = J
                if known is None:
                    H[-1] = np.asfortranarray(WB @ R.T @ E @ down @ J_r)
            return np.asarray(WB @ h)

        return safe_factor(unit_noise(record), free, [6 if n[0] == "x" else 2 for n in free], 2, terms)


def _rotation(name: str, fixed: Fixed) -> Callable[[gtsam.Values], Array]:
    """Rotation matrix of a node, which may be constant."""
    if name in fixed:
        constant = quat_to_matrix(fixed[name][3:])
        return lambda _: constant
    key = gtsam_key(name)
    return lambda values: values.atPose3(key).rotation().matrix()


def skew_of(v: Array) -> Array:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def level_turn(x: float, y: float) -> tuple[Array, Array]:
    """``Exp([x, y, 0])`` and the first two columns of its right Jacobian ``I - a Ω + b Ω²`` (Rodrigues)."""
    t2 = x * x + y * y
    t = math.sqrt(t2)
    small = t < 1e-4
    sinc = 1.0 - t2 / 6.0 if small else math.sin(t) / t
    a = 0.5 - t2 / 24.0 if small else 2.0 * (math.sin(0.5 * t) / t) ** 2
    b = 1.0 / 6.0 - t2 / 120.0 if t < 1e-3 else (t - math.sin(t)) / (t2 * t)
    O = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    O2 = O @ O
    return np.eye(3) + sinc * O + a * O2, (np.eye(3) - a * O + b * O2)[:, :2]
