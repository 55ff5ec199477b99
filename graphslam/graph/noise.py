"""Noise of factors: checks of covariances before GTSAM uses them, whiteners, and robust kernels.

GTSAM accepts a covariance that is not positive definite, not finite or not symmetric without a message, and returns
``nan`` or uses one triangle of the matrix. So all covariances of a graph are checked here first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg as sl

from graphslam.core.errors import ConfigError, CovarianceError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array, ArrayLike


def whitener(cov: ArrayLike, *, what: str = "covariance", dim: int | None = None, scale: float = 1.0) -> Array:
    """``W = L⁻¹`` of ``scale · cov = L Lᵀ``, so that ``‖W r‖² = rᵀ (scale · cov)⁻¹ r``.

    Parameters
    ----------
    cov : (d, d)
        Symmetric positive definite.
    what : str
        Name for the message.
    dim : int, optional
        Expected d.
    scale : float
        Factor on the covariance (> 0).
    """
    if not (np.isfinite(scale) and scale > 0):
        raise CovarianceError(f"scale of the {what} is not usable", got=scale, wanted="> 0")
    P = check_covariance(cov, what=what, dim=dim)
    L = np.linalg.cholesky(scale * P)
    W, _ = sl.lapack.dtrtri(L, lower=1)
    if not np.isfinite(np.vdot(W, W)):
        raise CovarianceError(f"{what} is singular to working precision", got=f"smallest pivot {np.diag(L).min():.3g}")
    return np.asarray(W, dtype=np.float64)


def whiteners(information: Array) -> Array:
    """Upper triangular ``W`` ``(m, d, d)`` with ``Wᵀ W`` = information, which may be singular in some directions."""
    if len(information) == 0:
        return information
    try:
        return np.asarray(np.swapaxes(np.linalg.cholesky(information), 1, 2))
    except np.linalg.LinAlgError:
        w, V = np.linalg.eigh(information)
        R = np.linalg.qr(np.sqrt(np.maximum(w, 0.0))[:, :, None] * np.swapaxes(V, 1, 2), mode="r")
        # GTSAM reads a diagonal one as standard deviations, and refuses negative ones
        return np.asarray(np.where(np.diagonal(R, axis1=1, axis2=2) < 0.0, -1.0, 1.0)[:, :, None] * R)


# Number of matrices that are converted at a time.
_PART = 1 << 15


def covariance_whiteners(covariances: ArrayLike, count: int, dim: int, *, what: str = "factor") -> Array:
    """:func:`whitener` of many covariances, or of one that is common to all.

    Parameters
    ----------
    covariances : (count, dim, dim) or (dim, dim)

    Returns
    -------
    (count, dim, dim)
        A view of one matrix if it is common to all.
    """
    P = np.asarray(covariances, dtype=np.float64)
    if P.shape == (dim, dim):
        return np.broadcast_to(whitener(P, what=f"covariance of every {what}", dim=dim), (count, dim, dim))
    if P.shape != (count, dim, dim):
        raise CovarianceError(f"covariances of the {what}s do not fit", got=P.shape, wanted=(count, dim, dim))
    W = np.zeros((count, dim, dim))
    for first in range(0, count, _PART):
        part, out = P[first : first + _PART], W[first : first + _PART]
        scale = np.sqrt(np.abs(np.diagonal(part, axis1=1, axis2=2)))
        off = np.abs(part - np.swapaxes(part, 1, 2)) > 1e-6 * scale[:, :, None] * scale[:, None, :]
        bad = np.asarray(off.any(axis=(1, 2)) | ~np.isfinite(part).all(axis=(1, 2)))
        try:
            L = np.linalg.cholesky(np.where(bad[:, None, None], np.eye(dim), part))
        except np.linalg.LinAlgError:
            bad |= np.linalg.eigvalsh(np.where(bad[:, None, None], np.eye(dim), part))[:, 0] <= 0.0
        if bad.any():
            k = int(bad.argmax())
            check_covariance(part[k], what=f"covariance of {what} {first + k}", dim=dim)
            raise CovarianceError(f"covariance of {what} {first + k} is not usable", got=part[k])
        for j in range(dim):  # columns of the inverse by forward substitution, all matrices at once
            out[:, j, j] = 1.0 / L[:, j, j]
            for i in range(j + 1, dim):
                known = np.einsum("mk,mk->m", L[:, i, j:i], out[:, j:i, j])
                out[:, i, j] = -known / L[:, i, i]
    return W


@dataclass(frozen=True, slots=True)
class RobustKernel:
    """A robust kernel on the whitened norm ``d`` of one residual, with GTSAM's formulas.

    Parameters
    ----------
    kind : {"none", "huber", "cauchy"}
    k : float
        Width in standard deviations; usual values are 1.345 for Huber, 2.385 for Cauchy.
    """

    kind: Literal["none", "huber", "cauchy"] = "none"
    k: float = 1.345

    def __post_init__(self) -> None:
        if self.kind not in ("none", "huber", "cauchy"):
            raise ConfigError(f"unknown robust kernel {self.kind!r}; known: none, huber, cauchy")
        if not (np.isfinite(self.k) and self.k > 0):
            raise ConfigError(f"robust kernel width must be positive, got {self.k}")

    def loss(self, d2: Array) -> Array:
        """``2 ρ(d)`` of squared whitened norms ``d2``; equals ``d2`` without a kernel."""
        return robust_terms(d2, np.full(np.shape(d2), _CODE[self.kind]), np.full(np.shape(d2), self.k))[0]

    def weight(self, d2: Array) -> Array:
        """Weight of iteratively reweighted least squares, in (0, 1]."""
        return robust_terms(d2, np.full(np.shape(d2), _CODE[self.kind]), np.full(np.shape(d2), self.k))[1]

    @property
    def code(self) -> int:
        """Small integer for arrays of kernels (see :func:`robust_terms`)."""
        return _CODE[self.kind]


_CODE = {"none": 0, "huber": 1, "cauchy": 2}
NO_KERNEL = RobustKernel()


def robust_terms(d2: Array, code: Any, k: Any) -> tuple[Array, Array]:
    """Losses ``2 ρ`` and weights for many residuals at once.

    Parameters
    ----------
    d2 : (n,)
        Squared whitened norms.
    code, k : (n,)
        :attr:`RobustKernel.code` and width of each.
    """
    d2 = np.asarray(d2, dtype=np.float64)
    if not np.any(code):
        return d2, np.ones_like(d2)
    d = np.sqrt(d2)
    safe = np.where(d > 0, d, 1.0)
    out = d > k
    huber = np.where(out, k * (2.0 * d - k), d2), np.where(out, k / safe, 1.0)
    cauchy = k**2 * np.log1p(d2 / k**2), 1.0 / (1.0 + d2 / k**2)
    loss = np.select([code == 1, code == 2], [huber[0], cauchy[0]], d2)
    weight = np.select([code == 1, code == 2], [huber[1], cauchy[1]], np.ones_like(d2))
    return loss, weight
