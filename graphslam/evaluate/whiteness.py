"""Whiteness test of residuals, and the effective number of independent residuals.

A map follows time-correlated errors, so their residuals are *small*, and a test of size alone would call such a map
conservative although it is wrong by several σ. The remaining residuals are correlated. Therefore the correlation is
tested first, and the size with the effective number of degrees of freedom.

Residuals at an optimum are not independent even if the noise is: their covariance is ``C = I - H``, where H is the hat
matrix of their class. A sum of products over neighbours, ``rᵀ A r``, then has the mean ``tr(A C)`` and the variance ``2
tr(A C A C)``; both are computed from C, so that the correlation caused by the fit is not counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from graphslam.core.geometry import Array

LAST = 1.5
"""Integrated correlation time, in residuals, above which errors count as time-correlated."""
LEAST = 12
"""A shorter series is not tested."""
LONGEST = 60
"""Largest lag."""


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Correlation of standardised residuals in time order.

    Parameters
    ----------
    pairs : int
        Number of pairs of neighbours.
    lag1 : float
        Correlation at lag 1, minus its mean for white noise after the fit.
    score : float
        The same in units of its σ for white noise: N(0, 1) if the noise is white.
    tau : float
        Integrated correlation time ``1 + 2 Σ ρ_k``, in residuals, up to the first ``ρ_k`` within its noise; at least 1.
    """

    pairs: int
    lag1: float
    score: float
    tau: float

    @property
    def p_value(self) -> float:
        """Probability of at least this correlation for white residuals."""
        return float(special.ndtr(-self.score))

    def correlated(self, level: float = 0.005) -> bool:
        """Whether the errors are time-correlated beyond neighbouring residuals."""
        return self.p_value < level and self.tau > LAST


def residual_whiteness(times: Array, residuals: Array, covariance: Array | None = None) -> Whiteness | None:
    """Correlation of a series; None if it is too short.

    Parameters
    ----------
    times : (n,)
        In order.
    residuals : (n, d)
        Standardised.
    covariance : (n, d, n, d), optional
        Of the residuals if the noise is white; by default the identity.
    """
    n, d = residuals.shape
    if n < 2:
        return None
    usual = float(np.median(np.diff(times)))
    C = None if covariance is None else covariance.reshape(n * d, n * d)
    size = float(np.mean(residuals**2)) or 1.0
    expected = 1.0 if C is None else max(float(np.trace(C)) / (n * d), 1e-9)
    first: tuple[int, float, float] | None = None
    tau = 1.0
    for lag in range(1, min(LONGEST, n - 1) + 1):
        near = np.flatnonzero(times[lag:] - times[:-lag] < (lag + 1) * usual)
        if len(near) < LEAST // 2:
            break
        products = float(np.sum(residuals[near] * residuals[near + lag]))
        # normalised by the observed variance, so that only correlation is tested
        mean, variance = 0.0, float(len(near) * d)
        if C is not None:
            at = ((near[:, None] * d) + np.arange(d)).ravel()
            behind = at + lag * d
            mean = float(np.sum(C[at, behind])) * size / expected
            if lag == 1:
                A = np.zeros_like(C)
                A[at, behind] += 0.5
                A[behind, at] += 0.5
                A[np.arange(n * d), np.arange(n * d)] -= mean / (size * n * d)  # in units of the observed variance
                AC = A @ C
                variance = 2.0 * float(np.sum(AC * AC.T)) / expected**2
        scale = len(near) * d * size
        rho = (products - mean) / scale
        if first is None:
            if len(near) < LEAST:
                return None
            first = len(near), rho, (products - mean) / (size * np.sqrt(max(variance, 1e-12)))
        if rho < 2.0 / np.sqrt(len(near) * d):
            break
        tau += 2.0 * rho
    return None if first is None else Whiteness(first[0], float(first[1]), float(first[2]), float(tau))
