"""The simulated flight through points: what it states is what it draws, and the same seed gives the same log."""

from __future__ import annotations

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import ConfigError, DataError, UnknownNameError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.records import PointObservations
from graphslam.core.se3 import se3_between, se3_inverse, se3_log, se3_transform


def test_noise_is_what_is_stated() -> None:
    log = gs.simulate("point-field", seed=2, seconds=60.0)
    truth, odometry, seen = log.truth, log["odometry"], log["points"]
    exact = se3_between(truth.trajectory.poses[:-1], truth.trajectory.poses[1:])
    e = se3_log(se3_between(exact, odometry.increments[1:]))
    d2 = np.einsum("ki,kij,kj->", e, np.linalg.inv(odometry.covariances[1:]), e)
    assert chi2_quantile(0.001, e.size) < d2 < chi2_quantile(0.999, e.size)
    poses = truth.trajectory.interpolate(seen.times)
    d2 = 0.0
    for k in range(len(seen.times)):
        rows = seen.scan(k)
        d = seen.points[rows] - se3_transform(se3_inverse(poses[k]), truth.landmarks[seen.ids[rows]])
        d2 += float(np.einsum("ki,kij,kj->", d, np.linalg.inv(seen.covariances[rows]), d))
    assert chi2_quantile(0.001, seen.points.size) < d2 < chi2_quantile(0.999, seen.points.size)


def test_the_same_seed_gives_the_same_log() -> None:
    a, b = (gs.simulate("point-field", preset="quick", seed=7) for _ in range(2))
    np.testing.assert_array_equal(a["points"].points, b["points"].points)
    np.testing.assert_array_equal(a["odometry"].increments, b["odometry"].increments)


def test_figures_that_make_no_world_are_refused() -> None:
    with pytest.raises(ConfigError, match="speed"):
        gs.simulate("point-field", speed=0.0)
    with pytest.raises(ConfigError, match="scan_rate"):
        gs.simulate("point-field", scan_rate=100.0)
    with pytest.raises(UnknownNameError):
        gs.simulate("point-field", colour=1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ids": np.array([1, 1])}, "is repeated"),
        ({"ids": np.array([1, -1])}, "negative"),
        ({"covariances": np.zeros((2, 3, 3))}, "positive definite"),
        ({"points": np.array([[1.0, np.nan, 0], [1, 2, 3]])}, "point"),
        ({"offsets": np.array([0, 1])}, "partition"),
    ],
)
def test_odd_observations_of_points_are_refused(change: dict, said: str) -> None:
    good = {
        "times": np.array([0.0]), "offsets": np.array([0, 2]), "points": np.ones((2, 3)),
        "covariances": np.tile(np.eye(3), (2, 1, 1)), "ids": np.array([1, 2]),
    }  # fmt: skip
    PointObservations(**good)
    with pytest.raises(DataError, match=said):
        PointObservations(**{**good, **change})
