"""Intervals hold what they promise: coverage of known laws, and tables from the literature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from graphslam.core.errors import DataError
from graphslam_studies.evaluate.intervals import grouped_mean_interval, mean_interval, ratio_of_means, share_interval


def test_students_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    draws = 3000
    inside = 0
    for row in rng.normal(2.0, 3.0, (draws, 6)):
        mean, low, high = mean_interval(row, 0.9)
        assert mean - low == pytest.approx(high - mean)
        inside += low <= 2.0 <= high
    sigma = np.sqrt(0.9 * 0.1 / draws)
    assert abs(inside / draws - 0.9) < 3.5 * sigma
    assert np.isnan(mean_interval([1.0])[1:]).all()


def test_share_against_sums_of_the_binomial() -> None:
    for count, total in ((0, 20), (3, 20), (18, 20), (20, 20), (1, 1)):
        low, high = share_interval(count, total)
        if count:
            assert stats.binom.sf(count - 1, total, low) == pytest.approx(0.025, rel=1e-6)
        else:
            assert low == 0.0
        if count < total:
            assert stats.binom.cdf(count, total, high) == pytest.approx(0.025, rel=1e-6)
        else:
            assert high == 1.0
    assert share_interval(20, 20)[0] == pytest.approx(0.025 ** (1 / 20))


def test_ratio_of_means_covers_and_respects_pairs() -> None:
    rng = np.random.default_rng(1)
    inside = 0
    trials = 300
    for _ in range(trials):
        common = rng.lognormal(0.0, 0.8, 40)
        a, b = common * rng.lognormal(0, 0.1, 40), 4.0 * common * rng.lognormal(0, 0.1, 40)
        ratio, low, high = ratio_of_means(a, b, rng, draws=400)
        inside += low <= 0.25 <= high
        assert high - low < 0.3 * ratio  # paired: the spread of the runs cancels
    assert 0.87 < inside / trials < 0.985
    loose = ratio_of_means(a, rng.permutation(b), np.random.default_rng(2))
    assert loose[2] - loose[1] > 3 * (high - low)


def test_values_of_one_group_hang_together() -> None:
    rng = np.random.default_rng(3)
    offsets = rng.normal(size=12)
    groups = np.repeat(np.arange(12), 30)
    values = offsets[groups] + 0.01 * rng.normal(size=len(groups))
    mean, low, high = grouped_mean_interval(values, groups, rng)
    assert mean == pytest.approx(values.mean())
    expected = 2 * 1.96 * offsets.std() / np.sqrt(12)
    assert high - low == pytest.approx(expected, rel=0.15)
    _, l2, h2 = grouped_mean_interval(values, np.arange(len(values)), rng)
    assert h2 - l2 < 0.3 * (high - low)
    assert np.isnan(grouped_mean_interval(values, np.zeros(len(values)), rng)[1])


def test_what_cannot_be_is_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(DataError):
        mean_interval([])
    with pytest.raises(DataError):
        mean_interval([1.0, np.nan])
    with pytest.raises(DataError):
        share_interval(3, 2)
    with pytest.raises(DataError):
        ratio_of_means([1.0, 2.0], [1.0], rng)
    with pytest.raises(DataError):
        ratio_of_means([1.0, 2.0], [0.0, 0.0], rng)
    with pytest.raises(DataError):
        grouped_mean_interval([1.0, 2.0], [1], rng)
