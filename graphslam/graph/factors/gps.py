"""GPS fixes as factors on the submap of their time, 2-D and 3-D.

At time t inside submap k the antenna is at ``arm = T_start_body(t) · lever`` in the base frame of the submap, so its
world position is ``x_k ∘ arm`` and the measurement is ``z = T_gps_world ∘ x_k ∘ arm + bias + noise``. The first base
stays fixed; the *datum* ``T_gps_world`` is a variable, so the heading of the GPS frame is estimated, not assumed.

The residual is in the base frame of the submap: ``r = arm - x_k⁻¹ T_gps_world⁻¹ (z - bias)``. The covariance of an
isotropic fix does not change by rotation, and in this frame the covariance of the arm (from the submap's own
trajectory) is constant, so the two are added. A fix with a full covariance has its residual in the frame in which that
is constant, ``r = T_gps_world x_k arm + bias - z``; the arm's covariance is rotated into it with the map at the time at
which the fix is added.

In 3-D the datum is ``[x, y, z, ψ]``: the GPS frame (east, north, up) and the level frame of the first base differ by
a rotation about the vertical and a translation. If the graph has the tilt of its first base
(:mod:`~graphslam.graph.factors.attitude`), it defines the level frame; otherwise the z axis is assumed to be up::

    p_world = Exp(τ) R_z(ψ)ᵀ (z - bias - t),   r = arm - x⁻¹ p_world
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array, rotation2
from graphslam.core.poses import level_poses
from graphslam.core.se3 import quat_multiply, quat_normalize, quat_to_matrix, skew, so3_exp
from graphslam.graph.factors.attitude import up_turn
from graphslam.graph.factors.batch import Fixed, UniformBatch, WhitenedRecord, custom_factor, with_kernel
from graphslam.graph.noise import NO_KERNEL, RobustKernel, whitener
from graphslam.graph.variables import Values, gtsam_key


class AntennaRecord(WhitenedRecord):
    """A measured antenna position in the GPS frame: it constrains the datum, and has a field ``tilt``."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, eq=False)
class GpsRecord(AntennaRecord):
    """One position fix inside a submap; see :mod:`graphslam.graph.sensors.gps` for the residual.

    Parameters
    ----------
    node : int
        Node that the fix is attached to: the base of the submap of its time, or the nearest inner node.
    arm : (dim,)
        Antenna in the node's frame, ``T_node_body(t) · lever``.
    z : (dim,)
        Fix in the GPS frame, relative to the first fix.
    whitener : (dim, dim)
        Of fix and arm combined, in the node's frame.
    bias : int or None
        Number of its bias.
    tilt : bool
        The graph has the variable ``tilt``, which rotates the level datum.
    uneven : bool
        Residual and whitener are in the GPS frame, because the fix is not isotropic there.
    point : int or None
        Antenna position as a variable: a point of its submap's path (2-D). Residual ``T_gps_world point + bias - z``
        and whitener are then in the GPS frame, and node and arm are for information only.
    stated : (dim, dim) or None
        Covariance of the fix alone, in the GPS frame.
    """

    factor_id: int
    node: int
    time: float
    arm: Array
    z: Array
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    bias: int | None = None
    group: str = "gps"
    tilt: bool = False
    uneven: bool = False
    point: int | None = None
    stated: Array | None = None

    def variables(self) -> list[str]:
        """Names of the variables."""
        bias = [] if self.bias is None else [f"bias{self.bias}"]
        if self.point is not None:
            return ["datum", *bias, f"point{self.point}"]
        return [f"x{self.node}", "datum", *bias, *(["tilt"] if self.tilt else [])]

    def label(self) -> str:
        """Name for messages."""
        return f"GPS fix at {self.time:.3f} s on x{self.node} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class BiasPriorRecord:
    """Prior on a bias of fixes: ``bias - keep · before ~ N(0, sigma² shape)``.

    Parameters
    ----------
    sigma : float
        [m]
    before : int or None
        The previous bias; None: zero.
    keep : float
        Factor on the previous bias, ``exp(-Δt/τ)``.
    shape : (dim, dim) or None
        If the bias is not isotropic; None: the identity.
    """

    factor_id: int
    bias: int
    sigma: float
    group: str = "gps-bias"
    dim: int = 2
    before: int | None = None
    keep: float = 0.0
    shape: Array | None = None

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return self.dim

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [*([] if self.before is None else [f"bias{self.before}"]), f"bias{self.bias}"]

    def label(self) -> str:
        """Name for messages."""
        return f"prior on bias{self.bias} (factor {self.factor_id})"


def gps_terms(x: Array, datum: Array, bias: Array, arm: Array, z: Array) -> tuple[Array, Array]:
    """Residuals ``(k, 2)`` and Jacobians ``(k, 2, 8)`` on (pose 3, datum 3, bias 2) in right tangents, not whitened.

    Parameters
    ----------
    x : (k, 3)
    datum : (3,)
    bias, arm, z : (k, 2)
    """
    Rx, RD = rotation2(x[:, 2]), rotation2(datum[2])
    p = (z - bias - datum[:2]) @ RD  # world position of the fix
    q = np.einsum("kji,kj->ki", Rx, p - x[:, :2])  # in the base frame
    J = np.zeros((len(z), 2, 8))
    RxT = np.swapaxes(Rx, 1, 2)
    J[:, :, :2] = np.eye(2)  # x Exp(ξ): q → Exp(-ξ) q
    J[:, 0, 2], J[:, 1, 2] = -q[:, 1], q[:, 0]
    J[:, :, 3:5] = RxT  # datum Exp(ξ): p → Exp(-ξ) p, rotated by R_xᵀ
    J[:, :, 5] = np.einsum("kij,kj->ki", RxT, np.stack([-p[:, 1], p[:, 0]], -1))
    J[:, :, 6:8] = RxT @ RD.T
    return arm - q, J


def gps_terms_in_space(
    poses: Array, datum: Array, bias: Array, tilt: Array | None, arm: Array, z: Array
) -> tuple[Array, Array]:
    """Residuals ``(k, 3)`` and Jacobians ``(k, 3, 15)`` on (pose 6, datum 4, bias 3, tilt 2), not whitened.

    Parameters
    ----------
    poses : (k, 7)
    datum : (4,)
    bias, arm, z : (k, 3)
    tilt : (2,) or None
    """
    E, J_r = up_turn(np.zeros(2) if tilt is None else tilt)
    c, s = np.cos(datum[3]), np.sin(datum[3])
    Rz = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    w = (z - bias - datum[:3]) @ Rz  # in the level frame at the first base
    p = w @ E.T
    Rt = np.swapaxes(quat_to_matrix(poses[:, 3:]), 1, 2)
    q = (Rt @ (p - poses[:, :3])[..., None])[..., 0]  # in the node's frame
    RtE = Rt @ E
    J = np.zeros((len(z), 3, 15))
    J[:, :, :3] = -skew(q)  # x Exp(ξ): q → Exp(-ξ) q = q + q × ω - v
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6:9] = RtE @ Rz.T
    J[:, :, 9] = np.einsum("kij,kj->ki", RtE, np.stack([-w[:, 1], w[:, 0], np.zeros(len(w))], -1))
    J[:, :, 10:13] = J[:, :, 6:9]
    J[:, :, 13:] = RtE @ skew(w) @ J_r  # Exp(ω) Exp(J_r δ) w = p - Exp(ω) [w]× J_r δ
    return arm - q, J


def antenna_terms(
    poses: Array, datum: Array, tilt: Array | None, arm: Array, level: npt.NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Antennas in the GPS frame, and their Jacobians.

    Parameters
    ----------
    poses : (k, 3) or (k, 7)
    datum : (3,) or (4,)
    tilt : (2,) or None
        3-D only.
    arm : (k, dim)
        In the frames of the poses.
    level : (k,) bool, optional
        Rows that assume the z axis of the first base as up, whatever the tilt.

    Returns
    -------
    positions : (k, dim)
    J : (k, dim, 6) or (k, dim, 12)
        On (pose 3, datum 3), or on (pose 6, datum 4, tilt 2).
    """
    k = len(poses)
    if poses.shape[1] == 3:
        Rx, RD = rotation2(poses[:, 2]), rotation2(datum[2])
        lever = np.einsum("kij,kj->ki", Rx, arm)
        a = poses[:, :2] + lever
        J = np.zeros((k, 2, 6))
        J[:, :, :2], J[:, :, 3:5] = RD @ Rx, RD
        J[:, :, 2] = np.stack([-lever[:, 1], lever[:, 0]], -1) @ RD.T
        J[:, :, 5] = np.stack([-a[:, 1], a[:, 0]], -1) @ RD.T
        return a @ RD.T + datum[:2], J
    R = quat_to_matrix(poses[:, 3:])
    a = (R @ arm[..., None])[..., 0] + poses[:, :3]
    known = np.full(k, tilt is not None) if level is None or tilt is None else ~level
    E, J_r = up_turn(np.zeros(2) if tilt is None else tilt)
    Et = np.where(known[:, None, None], E.T, np.eye(3))
    w = (Et @ a[..., None])[..., 0]  # in the level frame at the first base
    c, s = np.cos(datum[3]), np.sin(datum[3])
    Rz = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    v = w @ Rz.T
    J = np.zeros((k, 3, 12))
    J[:, :, :3], J[:, :, 3:6] = -Rz @ Et @ R @ skew(arm), Rz @ Et @ R
    J[:, :, 6:9] = np.eye(3)
    J[:, 0, 9], J[:, 1, 9] = -v[:, 1], v[:, 0]
    # (Exp(τ) Exp(J_r δ))ᵀ a = w - (J_r δ) × w
    J[:, :, 10:] = np.where(known[:, None, None], Rz @ skew(w) @ J_r, 0.0)
    return v + datum[:3], J


def level_datum_pose(datum: Array, tilt: Array | None = None) -> Array:
    """``T_gps_world`` ``(7,)`` of a datum ``[x, y, z, heading]`` and of the tilt of the first base."""
    pose = level_poses(datum[:3], datum[3])
    if tilt is not None:
        pose[3:] = quat_normalize(quat_multiply(pose[3:], so3_exp(-np.append(tilt, 0.0))))
    return pose


def datum_of(T_gps_world: Array) -> tuple[Array, Array | None]:
    """Datum and tilt of a ``T_gps_world``: the inverse of :func:`level_datum_pose`."""
    if len(T_gps_world) == 3:
        return T_gps_world, None
    R = quat_to_matrix(T_gps_world[3:])
    lean = math.hypot(R[2, 0], R[2, 1])
    tilt = np.array([-R[2, 1], R[2, 0]]) * (math.atan2(lean, R[2, 2]) / lean if lean > 0 else 0.0)
    R = R @ up_turn(tilt)[0]
    return np.append(T_gps_world[:3], math.atan2(R[1, 0], R[0, 0])), tilt


class GpsBatch(UniformBatch):
    """GPS fixes, 2-D or 3-D."""

    record = GpsRecord
    relative = True
    slots = ("x", "datum", "bias", "tilt", "point")

    def __init__(self, records: Sequence[GpsRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._arm = np.array([r.arm for r in records]).reshape(-1, layout.dim)
        self._z = np.array([r.z for r in records]).reshape(-1, layout.dim)
        self._uneven = np.array([r.uneven for r in records], dtype=np.bool_)

    @staticmethod
    def keys(record: GpsRecord) -> Sequence[int | None]:
        """Node or point of the path, datum, bias if there is one, tilt if the graph has it."""
        return (
            None if record.point is not None else record.node,
            0,
            record.bias,
            0 if record.tilt else None,
            record.point,
        )

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`UniformBatch.terms`."""
        x, datum, bias, tilt, point = blocks
        r, J = self._in_node_frame(x, datum, bias, tilt)
        if self.dim == 2:
            J = np.concatenate([J, np.zeros((len(J), 2, 2))], axis=2)
        inside = np.flatnonzero(self._rows[:, 4] >= 0)
        if len(inside):
            RD, p = rotation2(datum[0, 2]), point[inside]
            r[inside] = p @ RD.T + datum[0, :2] + bias[inside] - self._z[inside]
            J[inside] = 0.0
            J[inside, :, 3:5], J[inside, :, 8:10] = RD, RD
            J[inside, :, 5] = np.stack([-p[:, 1], p[:, 0]], -1) @ RD.T
            J[inside, :, 6:8] = np.where((self._rows[inside, 2] >= 0)[:, None, None], np.eye(2), 0.0)
        some = np.flatnonzero(self._uneven & (self._rows[:, 4] < 0))
        if len(some):
            known, d = self._rows[some, 3] >= 0, self.dim
            up = tilt[some[np.argmax(known)]] if d == 3 else None
            y, by = antenna_terms(x[some], datum[0], up, self._arm[some], ~known)
            r[some] = y + bias[some] - self._z[some]
            split = 6 if d == 2 else 10
            I = np.where((self._rows[some, 2] >= 0)[:, None, None], np.eye(d), 0.0)
            J[some, :, : by.shape[2] + d] = np.concatenate([by[:, :, :split], I, by[:, :, split:]], axis=2)
        return r, J

    def turns(self, values: Values) -> Array:
        """Rotations ``(k, dim, dim)`` from the axes of the residuals into those of the fixes."""
        x, datum, _, _, _ = self.gather(values)
        known = self._rows[:, 3] >= 0
        J = antenna_terms(x, datum[0], values.tilt, self._arm, ~known)[1]
        turn = J[:, :, :2] if self.dim == 2 else J[:, :, 3:6]
        in_theirs = self._uneven | (self._rows[:, 4] >= 0)
        return np.where(in_theirs[:, None, None], np.eye(self.dim), turn)

    def _in_node_frame(self, x: Array, datum: Array, bias: Array, tilt: Array) -> tuple[Array, Array]:
        """Residuals and Jacobians as if all fixes were isotropic."""
        if self.dim == 2:
            r, J = gps_terms(x, datum[0], bias, self._arm, self._z)
            J[self._rows[:, 2] < 0, :, 6:] = 0.0
            return r, J
        r, J = np.zeros_like(self._z), np.zeros((len(self._z), 3, 15))
        turned = self._rows[:, 3] >= 0
        for level in (False, True):
            k = np.flatnonzero(turned != level)
            if len(k):
                up = None if level else tilt[k[0]]
                r[k], J[k] = gps_terms_in_space(x[k], datum[0], bias[k], up, self._arm[k], self._z[k])
        return r, J

    @classmethod
    def gtsam(cls, record: GpsRecord, fixed: Fixed) -> gtsam.NonlinearFactor:
        """GTSAM's own in the GPS frame; with a free datum or a bias a custom factor."""
        plane = record.rows == 2
        inside = record.point is not None
        if "datum" not in fixed or record.bias is not None or (plane and record.uneven and not inside):
            return custom_factor(cls, record, fixed)
        noise = with_kernel(gtsam.noiseModel.Gaussian.Information(record.whitener.T @ record.whitener), record.robust)
        if inside:
            return gtsam.PriorFactorPoint2(gtsam_key(f"point{record.point}"), record.z, noise)
        key = gtsam_key(f"x{record.node}")
        if record.uneven:
            return gtsam.GPSFactorArm(key, record.z, record.arm, noise)
        known = gtsam.KnownLandmarkFactorPose2 if plane else gtsam.KnownLandmarkFactorPose3
        return known(key, record.z, record.arm, noise)


class BiasPriorBatch(UniformBatch):
    """Priors on the biases of GPS fixes, and links between consecutive biases."""

    record = BiasPriorRecord
    relative = True
    slots = ("bias", "bias")
    prior = True

    def __init__(self, records: Sequence[BiasPriorRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._keep = np.array([0.0 if r.before is None else r.keep for r in records])

    @staticmethod
    def keys(record: BiasPriorRecord) -> Sequence[int | None]:
        """The previous bias, if there is one, and the bias."""
        return record.before, record.bias

    @staticmethod
    def whitener(record: BiasPriorRecord) -> Array:
        """Of the prior's σ and shape."""
        if record.shape is None:
            return np.eye(record.dim) / record.sigma
        return whitener(record.sigma**2 * record.shape, what=record.label())

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`UniformBatch.terms`."""
        before, now = blocks
        keep, one = self._keep[:, None], np.broadcast_to(np.eye(self.dim), (len(self), self.dim, self.dim))
        return now - keep * before, np.concatenate([-keep[:, None] * one, one], axis=2)

    @classmethod
    def gtsam(cls, record: BiasPriorRecord, fixed: Fixed) -> gtsam.NonlinearFactor:
        """GTSAM's own prior, if the mean is zero and the covariance isotropic."""
        if record.before is not None or record.shape is not None:
            return super().gtsam(record, fixed)
        noise = gtsam.noiseModel.Isotropic.Sigma(record.dim, record.sigma)
        prior = gtsam.PriorFactorPoint2 if record.dim == 2 else gtsam.PriorFactorPoint3
        return prior(gtsam_key(f"bias{record.bias}"), np.zeros(record.dim), noise)
