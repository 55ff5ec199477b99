"""Covariance of composed planar poses."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array, ArrayLike, se2_adjoint, se2_inverse


def se2_compose_covariance(T_ab: ArrayLike, cov_ab: ArrayLike, T_bc: ArrayLike, cov_bc: ArrayLike) -> Array:
    """Covariance of ``T_ac`` (right tangent at c) from independent ``T_ab`` and ``T_bc``.

    First order: ``Ad(T_bc⁻¹) Σ_ab Ad(T_bc⁻¹)ᵀ + Σ_bc``.
    """
    ad = se2_adjoint(se2_inverse(T_bc))
    return ad @ np.asarray(cov_ab, dtype=np.float64) @ np.swapaxes(ad, -1, -2) + np.asarray(cov_bc, dtype=np.float64)
