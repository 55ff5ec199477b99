"""Metric map errors with a stated gauge."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_compose, se2_transform
from graphslam.evaluate.map_error import landmark_error, match_ids
from graphslam.evaluate.statistics import ErrorStatistics


def test_statistics_by_hand() -> None:
    s = ErrorStatistics.of([3.0, 4.0, 0.0, 1.0])
    assert s.rmse == pytest.approx(np.sqrt(26 / 4))
    assert (s.mean, s.median, s.minimum, s.maximum, s.count) == (2.0, 2.0, 0.0, 4.0, 4)
    assert s.p95 == pytest.approx(3.85)
    assert s.std == pytest.approx(np.sqrt((1 + 4 + 4 + 1) / 4))
    with pytest.raises(DataError, match="no errors"):
        ErrorStatistics.of([])
    with pytest.raises(DataError, match="error 1 is not finite"):
        ErrorStatistics.of([1.0, np.nan])


def test_match_ids_with_strangers_and_duplicates() -> None:
    i, j = match_ids([7, -1, 3, 7, 50], [3, 9, 7])
    assert i.tolist() == [0, 2, 3]
    assert j.tolist() == [2, 0, 2]
    with pytest.raises(DataError, match="is repeated"):
        match_ids([1], [2, 2])


def test_landmark_error_in_both_gauges(rng: np.random.Generator) -> None:
    truth = rng.normal(size=(10, 2)) * 20
    T = np.array([1.0, -2.0, 0.3])
    ids = rng.permutation(10)
    moved = se2_transform(T, truth[ids])
    fixed = landmark_error(ids, moved, np.arange(10), truth)
    assert fixed.gauge == "first-base"
    assert np.allclose(fixed.errors, np.linalg.norm(moved - truth[ids], axis=1))
    rigid = landmark_error(ids, moved, np.arange(10), truth, gauge="rigid")
    assert rigid.statistics.maximum < 1e-9
    assert np.allclose(se2_compose(rigid.T_truth_estimate, T), 0.0, atol=1e-9)


def test_landmark_error_by_hand_counts_strangers() -> None:
    e = landmark_error([1, 2, 9], [[3.0, 4.0], [0.0, 0.0], [5.0, 5.0]], [1, 2], [[0.0, 0.0], [0.0, 1.0]])
    assert e.errors.tolist() == [5.0, 1.0]
    assert e.unmatched == 1
    assert e.as_row()["gauge"] == "first-base"
    with pytest.raises(DataError, match="no landmark has a truth"):
        landmark_error([9], [[0.0, 0.0]], [1], [[0.0, 0.0]])
    with pytest.raises(DataError, match="too few points"):
        landmark_error([1], [[0.0, 0.0]], [1], [[0.0, 0.0]], gauge="rigid")


def test_rigid_gauge_cannot_hide_a_scale_error(rng: np.random.Generator) -> None:
    truth = rng.normal(size=(50, 2)) * 20
    e = landmark_error(np.arange(50), 1.1 * truth, np.arange(50), truth, gauge="rigid")
    spread = np.sqrt(np.mean(np.sum((truth - truth.mean(0)) ** 2, axis=1)))
    assert e.statistics.rmse == pytest.approx(0.1 * spread, rel=1e-6)
