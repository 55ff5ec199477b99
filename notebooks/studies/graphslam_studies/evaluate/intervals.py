"""Confidence intervals of means, shares and ratios over trials."""

from __future__ import annotations

import numpy as np
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike


def _numbers(values: ArrayLike, least: int, what: str) -> Array:
    v = np.asarray(values, dtype=np.float64).ravel()
    if len(v) < least or not np.all(np.isfinite(v)):
        raise DataError(
            f"no interval of {what}", got=f"{len(v)} values, finite {int(np.isfinite(v).sum())}",
            wanted=f"at least {least}, all finite",
        )  # fmt: skip
    return v


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, float, float]:
    """Mean of ``(n,)`` values and the bounds of Student's interval; of one value, nan bounds."""
    v = _numbers(values, 1, "a mean")
    mean = float(v.mean())
    if len(v) < 2:
        return mean, float("nan"), float("nan")
    half = float(stats.t.ppf(0.5 + 0.5 * confidence, len(v) - 1) * v.std(ddof=1) / np.sqrt(len(v)))
    return mean, mean - half, mean + half


def share_interval(count: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Bounds of a probability: ``count`` of ``total`` independent trials were successes (Clopper and Pearson 1934)."""
    if total < 1 or not 0 <= count <= total:
        raise DataError("no interval of a share", got=f"{count} of {total}", wanted="0 … total, total ≥ 1")
    a = 0.5 * (1.0 - confidence)
    low = 0.0 if count == 0 else float(stats.beta.ppf(a, count, total - count + 1))
    high = 1.0 if count == total else float(stats.beta.ppf(1.0 - a, count + 1, total - count))
    return low, high


def ratio_of_means(
    a: ArrayLike, b: ArrayLike, rng: np.random.Generator, *, confidence: float = 0.95, draws: int = 4000
) -> tuple[float, float, float]:
    """Ratio of the means of two figures of the same runs, with percentile bootstrap bounds over the runs.

    Parameters
    ----------
    a, b : (n,)
        Row k of both is of run k.
    """
    x, y = _numbers(a, 1, "a ratio"), _numbers(b, 1, "a ratio")
    if len(x) != len(y) or y.mean() <= 0:
        raise DataError("no ratio of means", got=(len(x), len(y), float(y.mean())), wanted="equal lengths, b above 0")
    ratio = float(x.mean() / y.mean())
    if len(x) < 2:
        return ratio, float("nan"), float("nan")
    at = rng.integers(len(x), size=(draws, len(x)))
    below = y[at].mean(axis=1)
    drawn = np.divide(x[at].mean(axis=1), below, out=np.full(draws, np.inf), where=below > 0)
    tail = 0.5 * (1.0 - confidence)
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return ratio, float(low), float(high)


def grouped_mean_interval(
    values: ArrayLike, groups: ArrayLike, rng: np.random.Generator, *, confidence: float = 0.95, draws: int = 4000
) -> tuple[float, float, float]:
    """Mean of ``(n,)`` values, with percentile bootstrap bounds over groups: values of one group hang together.

    Parameters
    ----------
    values : (n,)
    groups : (n,)
        Label of each, as the number of its run.
    """
    v, g = _numbers(values, 1, "a mean"), np.asarray(groups).ravel()
    if len(g) != len(v):
        raise DataError("values and groups differ in number", got=len(g), wanted=len(v))
    _, label = np.unique(g, return_inverse=True)
    sums, counts = np.bincount(label, v), np.bincount(label).astype(np.float64)
    mean = float(v.mean())
    if len(sums) < 2:
        return mean, float("nan"), float("nan")
    at = rng.integers(len(sums), size=(draws, len(sums)))
    drawn = sums[at].sum(axis=1) / counts[at].sum(axis=1)
    tail = 0.5 * (1.0 - confidence)
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return mean, float(low), float(high)
