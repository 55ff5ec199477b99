"""Fixes that had no part in a path, against what path and fixes say of their errors."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.geometry import se2_compose, se2_exp
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import fix_distances

RUNS = 200
SIGMA = np.array([0.05, 0.05, 0.004])
"""Of a step of a metre [m, m, rad]."""


def drive(rng: np.random.Generator, *, wrong: float = 1.0, wild: float = 0.0) -> tuple[Trajectory, Gps]:
    """Dead reckoning along a square of 200 m whose errors are ``wrong`` times as large as stated, and fixes of 1 m."""
    steps = np.tile([1.0, 0.0, 0.0], (200, 1))
    steps[49::50, 2] = np.pi / 2
    true, made, C = [np.zeros(3)], [np.zeros(3)], [np.zeros((3, 3))]
    for u in steps:
        true.append(se2_compose(true[-1], u))
        made.append(se2_compose(made[-1], se2_compose(u, se2_exp(wrong * SIGMA * rng.normal(size=3)))))
        c, s = np.cos(u[2]), np.sin(u[2])
        J = np.array([[c, s, s * u[0] - c * u[1]], [-s, c, c * u[0] + s * u[1]], [0, 0, 1]])
        C.append(J @ C[-1] @ J.T + np.diag(SIGMA**2))
    t = np.arange(201.0)
    z = np.array(true)[:, :2] + rng.normal(size=(201, 2))
    z[rng.uniform(size=201) < wild] += 80.0 * rng.normal(size=2)
    turned = z @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + [500.0, -300.0]
    return Trajectory(t, np.array(made), np.array(C)), Gps(
        times=t, positions=turned, sigma=np.ones(201), lever=np.zeros(2)
    )


def chances(**how: float) -> np.ndarray:
    out = []
    for seed in range(RUNS):
        found = fix_distances(*drive(np.random.default_rng(seed), **how))
        assert found is not None
        out.append(found.chance)
    return np.array(out)


@pytest.mark.parametrize("wild", [0.0, 0.3])
def test_an_consistent_path_is_hardly_ever_contradicted(wild: float) -> None:
    """However alike its errors are from pose to pose; also where a part of the fixes is wild."""
    p = chances(wild=wild)
    assert np.mean(p < 0.05) <= 0.05
    assert np.mean(p < 0.001) <= 0.005


def test_a_path_that_is_far_off_is_contradicted() -> None:
    assert np.mean(chances(wrong=30.0) < 0.001) > 0.8


def test_a_path_without_covariances_or_with_few_fixes_is_not_judged() -> None:
    path, gps = drive(np.random.default_rng(0))
    assert fix_distances(Trajectory(path.times, path.poses), gps) is None
    assert fix_distances(path, gps.take(slice(0, 7))) is None
    found = fix_distances(path, gps, sigma=20.0)
    assert found is not None
    assert found.expected == pytest.approx(np.sqrt(800.0), rel=0.05)
