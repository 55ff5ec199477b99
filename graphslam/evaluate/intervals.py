"""Intervals of confidence for the means, shares and ratios that studies report."""

from __future__ import annotations

from scipy import special


def two_sided_width(confidence: float) -> float:
    """Standard deviations within which a normal variable stays with this probability."""
    return float(-special.ndtri(0.5 * (1.0 - confidence)))


def by_chance(n: int, share: float, confidence: float) -> float:
    """Number of n cases, each of which happens with probability ``share``, that is exceeded with ``1 − confidence``."""
    from scipy import stats  # takes half a second to load

    return float(stats.binom.ppf(confidence, n, share)) if n else 0.0
