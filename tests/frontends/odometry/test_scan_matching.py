"""Odometry mended by neighbouring scans: better than it was, consistent, and left alone where scans say nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_log
from graphslam.core.log import DropCounter
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.scan_matching import fuse_motions, match_neighbours
from graphslam_frontends.odometry.steps import Steps
from tests.frontends.grid_world import ring


def slipping() -> Steps:
    """The ring of corridors with odometry that is off by 2 cm and 2° a step, and says so."""
    steps = ring(0, 2, length=40.0, yaw_bias=0.0)
    noise = np.random.default_rng(5).normal(size=(len(steps), 3)) * [0.02, 0.02, 0.035]
    noise[0] = 0.0
    o = steps.odometry
    covariances = o.covariances + np.diag([0.02**2, 0.02**2, 0.035**2])
    increments = se2_compose(o.increments, se2_exp(noise))
    return dataclasses.replace(
        steps, odometry=dataclasses.replace(o, increments=increments, covariances=covariances), errors=None
    )


def errors(steps: Steps) -> np.ndarray:
    """Of each increment in the tangent."""
    assert steps.truth is not None
    true = steps.truth.interpolate(steps.times)
    return se2_log(se2_between(se2_between(true[:-1], true[1:]), steps.odometry.increments[1:]))


def test_headings_are_mended_and_covariances_stay_consistent() -> None:
    steps, drops = slipping(), DropCounter()
    mended = match_neighbours(steps, drops=drops)
    before, after = errors(steps), errors(mended)
    assert np.sqrt(np.mean(after[:, 2] ** 2)) < 0.35 * np.sqrt(np.mean(before[:, 2] ** 2))
    assert np.sqrt(np.mean(after[:, :2] ** 2)) <= 1.02 * np.sqrt(np.mean(before[:, :2] ** 2))
    nees = np.einsum("ni,nij,nj->n", after, np.linalg.inv(mended.odometry.covariances[1:]), after) / 3
    assert 0.1 < np.mean(nees) < 2.0
    assert mended.errors is None
    np.testing.assert_array_equal(mended.points, steps.points)


def test_without_beams_and_where_the_robot_stands_the_odometry_stays() -> None:
    steps = slipping()
    blind = dataclasses.replace(steps, returns=np.zeros_like(steps.returns))
    np.testing.assert_array_equal(match_neighbours(blind).odometry.increments, steps.odometry.increments)
    o = steps.odometry
    standing = dataclasses.replace(
        steps, odometry=dataclasses.replace(o, increments=np.zeros_like(o.increments)), errors=None
    )
    assert np.abs(chain_odometry(match_neighbours(standing).odometry).poses).max() == 0.0


def test_a_scan_of_another_place_is_counted_and_left_out() -> None:
    steps = slipping()
    points = steps.points.copy()
    rows = slice(int(steps.offsets[10]), int(steps.offsets[11]))
    points[rows] = np.random.default_rng(0).uniform(-8, 8, points[rows].shape)
    drops = DropCounter()
    mended = match_neighbours(dataclasses.replace(steps, points=points, errors=None), drops=drops)
    np.testing.assert_array_equal(mended.odometry.increments[10:12], steps.odometry.increments[10:12])
    assert sum(n for what, n in drops.counts.items() if "does not match" in what) >= 2


def test_fusion_lies_between_and_equals_the_information_form() -> None:
    P, R = np.diag([0.04, 0.01, 0.02]), np.diag([0.01, 100.0, 0.001])
    T, Q = fuse_motions(np.zeros(3), P, np.array([0.1, 0.5, 0.0]), R)
    np.testing.assert_allclose(Q, np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(R)))
    np.testing.assert_allclose(T, Q @ np.linalg.inv(R) @ [0.1, 0.5, 0.0], atol=1e-9)
    assert abs(T[1]) < 1e-3  # a direction that the match does not hold


def test_steps_in_space_are_refused() -> None:
    with pytest.raises(ConfigError, match="in space"):
        match_neighbours(ring(0, 3, length=8.0))
