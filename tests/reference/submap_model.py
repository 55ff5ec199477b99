"""A landmark submap as one measurement of global quantities (Combined SLAM B6, eq. 15), in plain numpy.

Two parametrisations share one residual: the *vector* form perturbs (x, y, θ) of a pose in the world frame, as the
paper and its information filter do; the *tangent* form perturbs on the right, as GTSAM does. They differ by the
rotation of the position part, so ``J_tangent = J_vector · blkdiag(R(θ), 1)``.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.charts import inverse_left_jacobian_terms, map_difference
from graphslam.core.geometry import Array, rotation2, wrap_angle


def predict_submap(start: Array, end: Array, landmarks: Array) -> Array:
    """``H(X)`` of eq. 15: what a submap starting at ``start`` (3,) would report.

    Parameters
    ----------
    start, end : (3,)
        World poses x_k and x_{k+1}.
    landmarks : (n, 2)
        World positions.

    Returns
    -------
    (3 + 2n,)
        ``[R(θ_s)ᵀ (p_e - p_s); wrap(θ_e - θ_s); R(θ_s)ᵀ (f_1 - p_s); …]``.
    """
    R = rotation2(start[2])
    out = np.empty(3 + 2 * len(landmarks))
    out[:2] = (end[:2] - start[:2]) @ R  # row vector times R is Rᵀ v
    out[2] = wrap_angle(end[2] - start[2])
    out[3:] = ((landmarks - start[:2]) @ R).ravel()
    return out


def submap_residual(start: Array, end: Array, landmarks: Array, z: Array, chart: str = "cartesian") -> Array:
    """``H(X) - z`` ``(3 + 2n,)`` in the coordinates of a chart, the heading wrapped."""
    return map_difference(predict_submap(start, end, landmarks), z, chart)


def submap_jacobians(
    start: Array, end: Array, landmarks: Array, z: Array, chart: str = "cartesian", *, tangent: bool
) -> tuple[Array, Array, Array]:
    """Jacobians of :func:`submap_residual`.

    Parameters
    ----------
    tangent : bool
        With respect to the right tangents of the poses (GTSAM) instead of their (x, y, θ) vectors.

    Returns
    -------
    J_start : (3 + 2n, 3)
    J_end : (3 + 2n, 3)
        In a Cartesian chart only its first three rows are non-zero.
    J_landmark : (2, 2)
        The same ``V⁻¹ R(θ_s)ᵀ`` for every landmark, in that landmark's own two rows (``V = I`` in a Cartesian chart).
    """
    n = len(landmarks)
    Rt = rotation2(start[2]).T
    p = np.empty((1 + n, 2))
    p[0] = end[:2] - start[:2]
    p[1:] = landmarks - start[:2]
    q = p @ Rt.T  # everything in the start frame
    Vi, bent = np.eye(2), np.zeros((1 + n, 2))
    if chart == "group":
        d = wrap_angle(end[2] - start[2] - z[2])
        a, b, slope = (float(v) for v in inverse_left_jacobian_terms(d))
        Vi = np.array([[a, b], [-b, a]])
        e = q - np.concatenate([z[:2], z[3:]]).reshape(-1, 2)
        bent = e @ np.array([[slope, 0.5], [-0.5, slope]]).T  # d(V⁻¹ e)/dd
    dq = np.stack([q[:, 1], -q[:, 0]], -1) @ Vi.T - bent  # d(Rᵀ v)/dθ_s = Rᵀ rotated by -90°
    J_start = np.zeros((3 + 2 * n, 3))
    A = -Vi if tangent else -Vi @ Rt
    J_start[0:2, :2], J_start[0:2, 2] = A, dq[0]
    J_start[2, 2] = -1.0
    J_start[3:, :2] = np.tile(A, (n, 1))
    J_start[3:, 2] = dq[1:].ravel()
    J_end = np.zeros((3 + 2 * n, 3))
    J_end[:2, :2] = Vi @ Rt @ rotation2(end[2]) if tangent else Vi @ Rt
    J_end[:2, 2], J_end[3:, 2] = bent[0], bent[1:].ravel()
    J_end[2, 2] = 1.0
    return J_start, J_end, Vi @ Rt
