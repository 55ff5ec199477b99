"""GPS fixes all at once, and the model of a fix in space.

In space the datum is ``[x, y, z, ψ]``: the GPS frame (east, north, up) and the level frame of the first base differ by
a turn about the vertical and a shift. Where the graph knows the tilt of its first base
(:mod:`graphslam.graph.attitude`), level is what the tilt says; else the z axis of the first base is taken as up::

    p_world = Exp(τ) R_z(ψ)ᵀ (z - bias - t),   r = arm - x⁻¹ p_world
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.poses import upright
from graphslam.core.se3 import quat_multiply, quat_normalize, quat_to_matrix, se3_transform, skew, so3_exp
from graphslam.graph.attitude import up_turn
from graphslam.graph.families import UniformFamily
from graphslam.graph.gps import gps_jacobians
from graphslam.graph.records import GpsRecord
from graphslam.graph.state import Layout, Values

Index = npt.NDArray[np.int64]


def level_datum_pose(datum: Array, tilt: Array | None = None) -> Array:
    """``T_gps_world`` ``(7,)`` of a datum ``[x, y, z, heading]`` and of the tilt of the first base."""
    pose = upright(datum[:3], datum[3])
    if tilt is not None:
        pose[3:] = quat_normalize(quat_multiply(pose[3:], so3_exp(-np.append(tilt, 0.0))))
    return pose


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


def gps_predicted_in_space(values: Values, node: Index, arm: Array) -> Array:
    """Where the GPS frame has the antennas ``(k, 3)`` of nodes ``(k,)``, biases left aside."""
    assert values.datum is not None
    return se3_transform(level_datum_pose(values.datum, values.tilt), se3_transform(values.poses[node], arm))


class GpsFamily(UniformFamily):
    """Position fixes, in the plane or in space."""

    record = GpsRecord

    def __init__(self, records: Sequence[GpsRecord], layout: Layout) -> None:
        super().__init__(records, layout)
        n, dim = len(records), layout.dim
        self._node = np.array([r.node for r in records], dtype=np.int64)
        self._arm = np.array([r.arm for r in records]).reshape(-1, dim)
        self._z = np.array([r.z for r in records]).reshape(-1, dim)
        self._W = np.array([r.whitener for r in records]).reshape(-1, dim, dim)
        self._bias = np.array([-1 if r.bias is None else r.bias for r in records], dtype=np.int64)
        self._tilt = np.array([r.tilt for r in records], dtype=bool)
        datum = np.broadcast_to(layout.datum_start + np.arange(layout.datum_dof), (n, layout.datum_dof))
        of_bias = layout.bias_start + dim * self._bias[:, None] + np.arange(dim)
        columns = [layout.pose_columns(self._node), datum, np.where(self._bias[:, None] < 0, -1, of_bias)]
        if dim == 3:
            columns.append(np.where(self._tilt[:, None], layout.tilt_start + np.arange(2), -1))
        self._set_columns(np.concatenate(columns, axis=1))

    def terms(self, values: Values) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.families.UniformFamily.terms`."""
        if self.layout.dim == 2:
            r, J = gps_jacobians(values, self._node, self._arm, self._z, self._bias)
        else:
            r, J = self._terms_in_space(values)
        return np.einsum("kij,kj->ki", self._W, r), self._W @ J

    def _terms_in_space(self, values: Values) -> tuple[Array, Array]:
        assert values.datum is not None
        b = np.zeros_like(self._z)
        has = self._bias >= 0
        b[has] = values.biases[self._bias[has]]
        r, J = np.zeros_like(self._z), np.zeros((len(self._z), 3, 15))
        for turned in (False, True):
            k = np.flatnonzero(self._tilt == turned)
            if len(k):
                tilt = values.tilt if turned else None
                r[k], J[k] = gps_terms_in_space(
                    values.poses[self._node[k]], values.datum, b[k], tilt, self._arm[k], self._z[k]
                )
        return r, J
