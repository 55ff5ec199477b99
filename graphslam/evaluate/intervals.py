"""Confidence limits for the means and shares that studies report."""

from __future__ import annotations

from scipy import special


def two_sided_width(confidence: float) -> float:
    """Half width, in standard deviations, of the interval that contains a normal variable with this probability."""
    return float(-special.ndtri(0.5 * (1.0 - confidence)))


def by_chance(n: int, share: float, confidence: float) -> float:
    """Quantile ``confidence`` of the binomial distribution of ``n`` cases with probability ``share``."""
    from scipy import stats  # takes half a second to load

    return float(stats.binom.ppf(confidence, n, share)) if n else 0.0
