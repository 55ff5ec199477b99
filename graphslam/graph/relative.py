"""Relative poses of many pairs of nodes and their covariances, from blocks of a joint covariance."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of


def relative_poses(T_i: Array, T_j: Array, P_ii: Array, P_ij: Array, P_jj: Array) -> tuple[Array, Array]:
    """``T_ij = x_i⁻¹ x_j`` and its covariance, right tangent at j.

    ``x_i Exp δ_i`` and ``x_j Exp δ_j`` move it by ``δ_j - Ad(T_ij⁻¹) δ_i`` to first order, so with ``A = Ad(T_ji)``

        ``P = P_jj - A P_ij - P_ijᵀ Aᵀ + A P_ii Aᵀ``.

    Parameters
    ----------
    T_i, T_j : (k, 7) or (k, 3)
    P_ii, P_ij, P_jj : (k, d, d)
        Of the right tangents; zeros for a fixed node.

    Returns
    -------
    T_ij : (k, 7|3)
    P : (k, d, d)
    """
    g = group_of(T_i)
    A = g.adjoint(g.between(T_j, T_i))
    cross = A @ P_ij
    P = P_jj - cross - np.swapaxes(cross, 1, 2) + A @ P_ii @ np.swapaxes(A, 1, 2)
    return g.between(T_i, T_j), 0.5 * (P + np.swapaxes(P, 1, 2))
