"""Residuals and Jacobians of IMU factors: preintegrated measurements between nodes, biases, specific forces.

With the unit at ``X = x · T_node_imu`` = (R, p), gravity ``g = -G u(τ)`` (u: see
:mod:`graphslam.graph.factors.attitude`), velocities v of the unit in the frame of the first base, and ``δ = b_i - b̄``,
the residual of a preintegrated measurement is (Forster et al. 2017, eq. 45, with the random walk of the biases)::
    r_φ = Log((ΔR Exp(J_φ δ_g))ᵀ R_iᵀ R_j)
    r_p = R_iᵀ (p_j - p_i - v_i T - ½ g T²) - Δp - J_p δ
    r_v = R_iᵀ (v_j - v_i - g T) - Δv - J_v δ
    r_b = b_j - b_i

and that of a specific force at a node is ``r = Rᵀ G u(τ) + b_a - f``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY
from graphslam.core.se3 import (
    matrix_to_quat,
    quat_multiply,
    quat_to_matrix,
    se3_adjoint,
    se3_compose,
    se3_inverse,
    skew,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)
from graphslam.graph.factors.attitude import up_turn
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.factors.imu.plane import IN_PLANE, lift
from graphslam.graph.factors.imu.records import ForceRecord, GyroRecord, ImuBiasRecord, ImuRecord
from graphslam.graph.variables import VariableLayout

WIDTHS = {"x_i": 6, "v_i": 3, "b_i": 6, "x_j": 6, "v_j": 3, "b_j": 6, "tilt": 2}
XI, VI, BI, XJ, VJ, BJ, TILT = (
    slice(a, b) for a, b in zip(np.cumsum([0, *WIDTHS.values()])[:-1], np.cumsum([*WIDTHS.values()]))
)
GYRO_ROWS = np.r_[0:3, 9:15]
GYRO_COLUMNS = np.r_[XI, BI, XJ, BJ]
_BLOCKS = (("x", XI), ("velocity", VI), ("imubias", BI), ("x", XJ), ("velocity", VJ), ("imubias", BJ))
PLANE_ROWS = np.array([2, 3, 4, 6, 7, 11, 12, 13])
PLANE_COLUMNS = np.concatenate([block.start + np.array(IN_PLANE[word]) for word, block in _BLOCKS])
PLANE_GYRO_ROWS = np.array([0, 5, 6, 7])
PLANE_GYRO_COLUMNS = np.r_[0:3, 5:11, 13:16]
"""Gyro rows and columns among those of 2-D."""


class PreintegrationArrays:
    """Arrays of preintegrated measurements, one row each (:class:`~graphslam.graph.factors.imu.records.ImuRecord`)."""

    def __init__(self, records: Sequence[ImuRecord]) -> None:
        self.T = np.array([r.seconds for r in records])
        self.L_i = np.array([r.T_i_imu for r in records]).reshape(-1, 7)
        self.L_j = np.array([r.T_j_imu for r in records]).reshape(-1, 7)
        self.q = matrix_to_quat(np.array([r.R for r in records]).reshape(-1, 3, 3))
        self.p = np.array([r.p for r in records]).reshape(-1, 3)
        self.v = np.array([r.v for r in records]).reshape(-1, 3)
        self.J = np.array([r.J for r in records]).reshape(-1, 9, 6)
        self.bias = np.array([r.bias for r in records]).reshape(-1, 6)
        self.ad_i, self.ad_j = se3_adjoint(se3_inverse(self.L_i)), se3_adjoint(se3_inverse(self.L_j))


def preintegration_terms(
    arrays: PreintegrationArrays, x_i: Array, v_i: Array, b_i: Array, x_j: Array, v_j: Array, b_j: Array, tilt: Array
) -> tuple[Array, Array]:
    """Residuals ``(k, 15)`` and Jacobians ``(k, 15, 32)`` on (x_i, v_i, b_i, x_j, v_j, b_j, tilt), not whitened.

    Parameters
    ----------
    x_i, x_j : (k, 7)
    v_i, v_j : (k, 3)
    b_i, b_j : (k, 6)
    tilt : (2,)
    """
    w, T = arrays, arrays.T[:, None]
    X_i, X_j = se3_compose(x_i, w.L_i), se3_compose(x_j, w.L_j)
    Rt, E = np.swapaxes(quat_to_matrix(X_i[:, 3:]), 1, 2), None
    E = Rt @ quat_to_matrix(X_j[:, 3:])
    turn, J_r = up_turn(tilt)
    up = turn[:, 2]
    du = -turn @ skew([0.0, 0.0, 1.0]) @ J_r  # u(τ + δ) = u - Exp(ω) [e_z]× J_r δ
    d = b_i - w.bias
    theta = np.einsum("kij,kj->ki", w.J[:, :3, :3], d[:, :3])
    C = quat_multiply(w.q, so3_exp(theta))
    e = quat_multiply(C * [-1.0, -1.0, -1.0, 1.0], matrix_to_quat(E))
    phi = so3_log(e)
    a_p = np.einsum("kij,kj->ki", Rt, X_j[:, :3] - X_i[:, :3] - T * v_i + 0.5 * GRAVITY * T**2 * up)
    a_v = np.einsum("kij,kj->ki", Rt, v_j - v_i + GRAVITY * T * up)
    moved = np.einsum("kij,kj->ki", w.J[:, 3:], d)
    r = np.concatenate([phi, a_p - w.p - moved[:, :3], a_v - w.v - moved[:, 3:], b_j - b_i], axis=1)

    k = len(r)
    inverse = so3_left_jacobian_inverse(-phi)  # Log(e Exp(δ)) ≈ Log(e) + J_r⁻¹ δ
    U_i, U_j = np.zeros((k, 15, 6)), np.zeros((k, 15, 6))  # by the right tangent of the unit's own pose
    U_i[:, :3, :3] = -inverse @ np.swapaxes(E, 1, 2)
    U_i[:, 3:6, :3], U_i[:, 6:9, :3] = skew(a_p), skew(a_v)
    U_i[:, 3:6, 3:] = -np.eye(3)
    U_j[:, :3, :3] = inverse
    U_j[:, 3:6, 3:] = E
    J = np.zeros((k, 15, 32))
    J[:, :, XI], J[:, :, XJ] = U_i @ w.ad_i, U_j @ w.ad_j
    J[:, 3:6, VI] = -T[..., None] * Rt
    J[:, 6:9, VI], J[:, 6:9, VJ] = -Rt, Rt
    e_t = np.swapaxes(quat_to_matrix(e), 1, 2)
    J[:, :3, BI][:, :, :3] = -inverse @ e_t @ so3_left_jacobian(-theta) @ w.J[:, :3, :3]
    J[:, 3:9, BI] = -w.J[:, 3:]
    J[:, 9:, BI], J[:, 9:, BJ] = -np.eye(6), np.eye(6)
    J[:, 3:6, TILT] = 0.5 * GRAVITY * T[..., None] ** 2 * (Rt @ du)
    J[:, 6:9, TILT] = GRAVITY * T[..., None] * (Rt @ du)
    return r, J


def planar_terms(arrays: PreintegrationArrays, *blocks: Array) -> tuple[Array, Array]:
    """The same in 2-D: residuals ``(k, 8)`` and Jacobians ``(k, 8, 16)``, the planar components of both.

    Parameters
    ----------
    blocks : (k, 3), (k, 2), (k, 3), (k, 3), (k, 2), (k, 3)
        x_i, v_i, b_i, x_j, v_j, b_j.
    """
    lifted = [lift(word, rows) for (word, _), rows in zip(_BLOCKS, blocks)]
    r, J = preintegration_terms(arrays, *[*lifted, np.zeros(2)])
    return r[:, PLANE_ROWS], J[:, PLANE_ROWS[:, None], PLANE_COLUMNS]


def force_terms(x: Array, L: Array, bias: Array, tilt: Array, force: Array) -> tuple[Array, Array]:
    """Residuals ``(k, 3)`` and Jacobians ``(k, 3, 14)`` on (x, bias, tilt), not whitened.

    Parameters
    ----------
    x, L : (k, 7)
        Nodes, and the unit relative to them.
    bias : (k, 6)
    tilt : (2,)
    force : (k, 3)
    """
    turn, J_r = up_turn(tilt)
    Rt = np.swapaxes(quat_to_matrix(quat_multiply(x[:, 3:], L[:, 3:])), 1, 2)
    h = GRAVITY * (Rt @ turn[:, 2])
    J = np.zeros((len(x), 3, 14))
    J[:, :, :6] = skew(h) @ se3_adjoint(se3_inverse(L))[:, :3]
    J[:, :, 9:12] = np.eye(3)
    J[:, :, 12:] = GRAVITY * (Rt @ (-turn @ skew([0.0, 0.0, 1.0]) @ J_r))
    return h + bias[:, 3:] - force, J


class ImuBatch(UniformBatch):
    """Preintegrated measurements."""

    record = ImuRecord
    slots = ("x", "velocity", "imubias", "x", "velocity", "imubias", "tilt")

    def __init__(self, records: Sequence[ImuRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._preintegrated = PreintegrationArrays(records)

    @staticmethod
    def keys(record: ImuRecord) -> Sequence[int | None]:
        """Node, velocity and bias at both ends, tilt."""
        (va, vb), (ba, bb) = record.velocities, record.biases
        return record.i, va, ba, record.j, vb, bb, None if record.planar else 0

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        if self.dim == 2:
            return planar_terms(self._preintegrated, *blocks[:6])
        x_i, v_i, b_i, x_j, v_j, b_j, tilt = blocks
        return preintegration_terms(self._preintegrated, x_i, v_i, b_i, x_j, v_j, b_j, tilt[0])


class GyroBatch(UniformBatch):
    """Preintegrated rotations of the gyro alone."""

    record = GyroRecord
    slots = ("x", "imubias", "x", "imubias")

    def __init__(self, records: Sequence[GyroRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._preintegrated = PreintegrationArrays(records)

    @staticmethod
    def keys(record: GyroRecord) -> Sequence[int | None]:
        """Node and bias at both ends."""
        return record.i, record.biases[0], record.j, record.biases[1]

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x_i, b_i, x_j, b_j = blocks
        none = np.zeros((len(self), self.dim))
        if self.dim == 2:
            r, J = planar_terms(self._preintegrated, x_i, none, b_i, x_j, none, b_j)
            return r[:, PLANE_GYRO_ROWS], J[:, PLANE_GYRO_ROWS][:, :, PLANE_GYRO_COLUMNS]
        r, J = preintegration_terms(self._preintegrated, x_i, none, b_i, x_j, none, b_j, np.zeros(2))
        return r[:, GYRO_ROWS], J[:, GYRO_ROWS][:, :, GYRO_COLUMNS]


class ImuBiasBatch(UniformBatch):
    """Priors of biases, and random-walk links of biases over gaps."""

    record = ImuBiasRecord
    slots = ("imubias", "imubias")
    prior = True

    @staticmethod
    def keys(record: ImuBiasRecord) -> Sequence[int | None]:
        """The previous bias (None for a prior), the bias."""
        return record.before, record.bias

    @staticmethod
    def whitener(record: ImuBiasRecord) -> Array:
        """``1/σ``."""
        return np.diag(1.0 / record.sigma)

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        before, now = blocks
        d = now.shape[1]
        J = np.concatenate([-np.eye(d), np.eye(d)], axis=1)
        return now - before, np.broadcast_to(J, (len(self), d, 2 * d))


class ForceBatch(UniformBatch):
    """Specific forces at nodes."""

    record = ForceRecord
    slots = ("x", "imubias", "tilt")

    def __init__(self, records: Sequence[ForceRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._L = np.array([r.T_node_imu for r in records]).reshape(-1, 7)
        self._force = np.array([r.force for r in records]).reshape(-1, 3)

    @staticmethod
    def keys(record: ForceRecord) -> Sequence[int | None]:
        """Node, bias, tilt."""
        return record.node, record.bias, 0

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x, bias, tilt = blocks
        return force_terms(x, self._L, bias, tilt[0], self._force)
