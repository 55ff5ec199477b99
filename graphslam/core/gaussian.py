"""Gaussians, and chi-square quantiles.

Headings are periodic: functions with differences or means have an argument ``angular``, the indices of these
components.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import special

from graphslam.core.errors import CovarianceError
from graphslam.core.geometry import Array, ArrayLike, circular_mean, wrap_angle
from graphslam.core.reading import finite_mask


def check_covariance(
    cov: ArrayLike, *, what: str = "covariance", where: str | None = None, dim: int | None = None
) -> Array:
    """Return a symmetric positive-definite copy of ``cov`` ``(n, n)``, or raise a specific error.

    Rounding asymmetry (1e-6 relative) is averaged; more is refused, because GTSAM would read only one triangle without
    a warning.
    """
    P = np.array(cov, dtype=np.float64)
    if P.ndim != 2 or P.shape[0] != P.shape[1] or dim not in (None, len(P)):
        wanted = f"({dim}, {dim})" if dim is not None else "a square matrix"
        raise CovarianceError(f"{what} has the wrong shape", where=where, got=P.shape, wanted=wanted)
    if not np.all(finite_mask(P)):
        i, j = np.argwhere(~finite_mask(P))[0]
        raise CovarianceError(
            f"{what} is not finite", where=where, got=f"{P[i, j]} at ({i}, {j})", wanted="finite numbers"
        )
    if not np.array_equal(P, P.T):
        scale = np.sqrt(np.abs(np.diag(P)))
        bound = 1e-6 * np.outer(scale, scale)
        if np.any(np.abs(P - P.T) > bound):
            i, j = np.argwhere(np.abs(P - P.T) > bound)[0]
            raise CovarianceError(
                f"{what} is not symmetric",
                where=where,
                got=f"{P[i, j]} and {P[j, i]} at ({i}, {j})",
                wanted="a symmetric matrix",
            )
        P = 0.5 * (P + P.T)
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        low = float(np.linalg.eigvalsh(P)[0])
        raise CovarianceError(
            f"{what} is not positive definite",
            where=where,
            got=f"smallest eigenvalue {low:.3g}",
            wanted="> 0; check units and time stamps",
        ) from None
    return P


@dataclass(frozen=True, slots=True)
class Gaussian:
    """A Gaussian in moment form.

    Parameters
    ----------
    mean : (n,)
    covariance : (n, n)
        Symmetric positive definite.
    angular : tuple of int
        Components that are angles [rad].
    """

    mean: Array
    covariance: Array
    angular: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        mean = np.asarray(self.mean, dtype=np.float64)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", check_covariance(self.covariance, dim=len(mean)))

    def difference(self, x: ArrayLike) -> Array:
        """``x - mean`` with angular components wrapped."""
        d = np.asarray(x, dtype=np.float64) - self.mean
        for i in self.angular:
            d[..., i] = wrap_angle(d[..., i])
        return d

    def mahalanobis2(self, x: ArrayLike) -> float:
        """``(x - mean)ᵀ Σ⁻¹ (x - mean)`` (Combined SLAM eq. 18)."""
        d = self.difference(x)
        return float(d @ np.linalg.solve(self.covariance, d))

    def marginal(self, indices: ArrayLike) -> Gaussian:
        """Marginal of the components ``indices`` in that order."""
        ix = np.asarray(indices, dtype=np.intp)
        angular = tuple(int(k) for k in np.flatnonzero(np.isin(ix, self.angular)))
        return Gaussian(self.mean[ix], self.covariance[np.ix_(ix, ix)], angular)

    def kl_from(self, other: Gaussian) -> float:
        """Kullback–Leibler divergence ``KL(self ‖ other)`` in nats."""
        n = len(self.mean)
        d = other.difference(self.mean)
        sign_s, logdet_s = np.linalg.slogdet(self.covariance)
        sign_o, logdet_o = np.linalg.slogdet(other.covariance)
        assert sign_s > 0
        assert sign_o > 0
        trace = np.trace(np.linalg.solve(other.covariance, self.covariance))
        return float(0.5 * (trace + d @ np.linalg.solve(other.covariance, d) - n + logdet_o - logdet_s))


def moment_match(
    weights: ArrayLike, means: ArrayLike, covariances: ArrayLike, angular: tuple[int, ...] = ()
) -> Gaussian:
    """Mixture → single Gaussian by moment matching (Combined SLAM eq. 7–8).

    Parameters
    ----------
    weights : (m,)
        Non-negative; normalised here.
    means : (m, n)
    covariances : (m, n, n) or (n, n)
    angular : tuple of int
        Components averaged on the circle, with wrapped differences.
    """
    w = np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    X = np.asarray(means, dtype=np.float64)
    mean = w @ X
    for i in angular:
        mean[i] = circular_mean(X[:, i], w)  # eq. 7 on the circle
    D = X - mean
    for i in angular:
        D[:, i] = wrap_angle(D[:, i])
    C = np.asarray(covariances, dtype=np.float64)
    within = C if C.ndim == 2 else np.einsum("m,mij->ij", w, C)
    Q = within + (w[:, None] * D).T @ D  # eq. 8: within + between
    return Gaussian(mean, 0.5 * (Q + Q.T), angular)


@cache
def chi2_quantile(probability: float, dof: float) -> float:
    """Quantile of the chi-square distribution; NaN without degrees of freedom.

    ``scipy.stats`` takes half a second to load, so the package uses ``scipy.special``.
    """
    return math.nan if not dof > 0 else float(2.0 * special.gammaincinv(0.5 * dof, probability))


def equal_tail_gate(gate: float, dof: int, other_dof: int) -> float:
    """χ² gate for ``other_dof`` with the same false-rejection rate as ``gate`` for ``dof``."""
    return float(special.chdtri(other_dof, special.chdtrc(dof, gate)))


def chi2_mean_bounds(dof: float, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of the *mean* of ``runs`` independent chi-square values of ``dof`` each.

    An estimator whose mean NEES lies below the lower bound is conservative; above the upper, overconfident.
    """
    a = (1.0 - confidence) / 2.0
    n = dof * runs
    return chi2_quantile(a, n) / runs, chi2_quantile(1.0 - a, n) / runs


def ellipse_rings(centres: ArrayLike, covariances: ArrayLike, confidence: float, corners: int) -> Array:
    """Closed polygons ``(n, corners + 1, 2)`` of the confidence ellipses of points ``(n, 2)``, counter-clockwise."""
    turn = np.linspace(0.0, 2.0 * np.pi, corners + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    circle[-1] = circle[0]
    # c + √χ² L u with L Lᵀ = P; L has a positive determinant, so rings keep their orientation
    L = np.linalg.cholesky(np.asarray(covariances, dtype=np.float64))
    return np.asarray(centres)[:, None] + np.sqrt(chi2_quantile(confidence, 2)) * circle @ L.swapaxes(1, 2)


def largest_sigmas(covariances: ArrayLike) -> Array:
    """Standard deviation ``(n,)`` along the most uncertain direction of each of the covariances ``(n, d, d)``."""
    P = np.asarray(covariances, dtype=np.float64)
    return np.sqrt(np.linalg.eigvalsh(P)[:, -1]) if len(P) else np.zeros(0)


def first_no_covariance(covariances: Array) -> int | None:
    """Index of the first of ``(n, d, d)`` that is not symmetric, or has a negative eigenvalue beyond rounding."""
    if not covariances.size:
        return None
    skew = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2))
    values = np.linalg.eigvalsh(covariances)
    bad = np.flatnonzero((skew > 1e-6 * values[:, -1]) | (values[:, 0] < -1e-6 * np.abs(values[:, -1])))
    return int(bad[0]) if len(bad) else None
