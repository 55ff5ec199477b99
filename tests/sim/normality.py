"""Is a sample normal with the stated spread? Two-sided."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

# two-sided: the chance that an honest sample falls outside is 1e-4 per assertion (seeds are fixed)
P_VALUE = 1e-4


def assert_normal(x: np.ndarray, sigma: float, what: str) -> None:
    """Zero mean, the stated variance from both sides, a normal shape, and white."""
    z = np.asarray(x) / sigma
    n = len(z)
    low, high = stats.chi2.ppf([P_VALUE / 2, 1 - P_VALUE / 2], n)
    assert low < np.sum(z**2) < high, f"{what}: standard deviation is {np.sqrt(np.mean(z**2)):.3f} × the stated one"
    limit = stats.norm.ppf(1 - P_VALUE / 2)
    assert abs(z.sum()) / math.sqrt(n) < limit, f"{what}: biased by {z.mean():.4f} σ"
    assert stats.kstest(z, "norm").pvalue > P_VALUE, f"{what}: not normal"
    assert abs(np.sum(z[1:] * z[:-1])) / math.sqrt(n) < limit, f"{what}: correlated in time"
