"""Noise of factors: covariances checked before GTSAM sees them, whiteners, and robust kernels.

GTSAM takes a covariance that is not positive definite, not finite or not symmetric in silence and answers with
``nan`` or with one triangle of the matrix; everything that enters a graph therefore passes here first.
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
        Wanted d.
    scale : float
        Factor on the covariance (> 0): 5 says that the front end is over-confident by a factor of 5 in variance.

    Raises
    ------
    CovarianceError
        Says which entry is wrong, or that the matrix is singular to working precision.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise CovarianceError(f"scale of the {what} is not usable", got=scale, wanted="> 0")
    P = check_covariance(cov, what=what, dim=dim)
    L = np.linalg.cholesky(scale * P)
    W, _ = sl.lapack.dtrtri(L, lower=1)
    W = np.tril(W)
    with np.errstate(over="ignore"):
        usable = np.all(np.isfinite(W.T @ W))
    if not usable:
        raise CovarianceError(f"{what} is singular to working precision", got=f"smallest pivot {np.diag(L).min():.3g}")
    return np.asarray(W, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Robust:
    """A robust kernel on the whitened norm ``d`` of one residual, with GTSAM's formulae.

    Parameters
    ----------
    kind : {"none", "huber", "cauchy"}
    k : float
        Width in standard deviations; customary are 1.345 for Huber, 2.385 for Cauchy.
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
NO_KERNEL = Robust()


def robust_terms(d2: Array, code: Any, k: Any) -> tuple[Array, Array]:
    """Losses ``2 ρ`` and weights for many residuals at once.

    Parameters
    ----------
    d2 : (n,)
        Squared whitened norms.
    code, k : (n,)
        :attr:`Robust.code` and width of each.
    """
    d2 = np.asarray(d2, dtype=np.float64)
    d = np.sqrt(d2)
    safe = np.where(d > 0, d, 1.0)
    out = d > k
    huber = np.where(out, k * (2.0 * d - k), d2), np.where(out, k / safe, 1.0)
    cauchy = k**2 * np.log1p(d2 / k**2), 1.0 / (1.0 + d2 / k**2)
    loss = np.select([code == 1, code == 2], [huber[0], cauchy[0]], d2)
    weight = np.select([code == 1, code == 2], [huber[1], cauchy[1]], np.ones_like(d2))
    return loss, weight
