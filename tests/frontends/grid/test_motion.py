"""Particles move as the odometry says, with the noise that is asked for, no more and no less."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.poses import group_of, heading_of
from graphslam.core.se3 import quat_multiply, se3_exp
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.motion import (
    motion_covariance,
    move_poses,
    roll_pitch_of,
    square_root,
    walk_tilt_errors,
    with_roll_pitch,
)

QUIET = {"motion_scale": 0.0, "position_walk": 0.0, "height_walk": 0.0, "heading_walk": 0.0, "heading_turn": 0.0,
         "tilt_walk": 0.0}  # fmt: skip


def test_noise_is_the_odometrys_plus_walks_of_the_path() -> None:
    config = GridFilterConfig(motion_scale=2.0, position_walk=0.03, height_walk=0.02, heading_walk=0.01,
                              heading_turn=0.1, tilt_walk=0.005)  # fmt: skip
    angle = 0.3
    T = np.array([0.3, 0.0, 0.4, 0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])  # half a metre
    odometry = np.diag([1e-6, 2e-6, 3e-6, 4e-4, 5e-4, 6e-4])
    wanted = 4 * np.diag(odometry) + np.array(
        [0.005**2 / 2, 0.005**2 / 2, 0.01**2 / 2 + 0.1**2 * 0.3, 0.03**2 / 2, 0.03**2 / 2, 0.02**2 / 2]
    )
    assert np.allclose(motion_covariance(T, odometry, config), np.diag(wanted), rtol=1e-12)
    flat = motion_covariance(np.array([0.3, 0.4, -0.3]), np.zeros((3, 3)), config)
    assert np.allclose(flat, np.diag(wanted[[3, 4, 2]] - 4 * np.diag(odometry)[[3, 4, 2]]), rtol=1e-12)
    still = motion_covariance(np.array([0.0, 0, 0, 0, 0, 0, 1]), odometry, GridFilterConfig(**QUIET))
    assert np.array_equal(still, np.zeros((6, 6)))


def test_the_path_of_a_step_is_that_of_its_position_and_its_turn_that_about_the_vertical() -> None:
    """A body that rolls over a kerb goes no further and turns no more for it."""
    config = GridFilterConfig(heading_turn=0.2)
    level = np.array([0.3, 0.0, 0.1, 0.0, 0.0, np.sin(0.2), np.cos(0.2)])
    rolled = np.concatenate([level[:3], quat_multiply(level[3:], np.array([np.sin(0.25), 0.0, 0.0, np.cos(0.25)]))])
    none = np.zeros((6, 6))
    np.testing.assert_allclose(
        motion_covariance(rolled, none, config), motion_covariance(level, none, config), rtol=1e-9
    )
    back = np.concatenate([level[:3], -level[3:]])
    np.testing.assert_allclose(motion_covariance(back, none, config), motion_covariance(level, none, config), rtol=1e-9)


def test_models_are_those_of_the_configuration() -> None:
    """Whatever is set is handed on: nothing falls back on a default of its own."""
    c = GridFilterConfig(hit=0.8, floor=0.11, unknown=0.2, endpoint_effective_beams=60.0)
    model = c.beam_model()
    assert (model.hit, model.miss, model.clamp) == (0.8, 0.4, (0.1192, 0.971))
    end, cast = c.by_end_points(120), c.by_casting(30)
    assert (end.exponent, end.floor, end.unknown, end.interpolation) == (0.5, 0.11, 0.2, "trilinear")
    assert c.by_end_points(30).exponent == 1.0
    assert (cast.exponent, cast.sigma, cast.clip) == (4.0 / 30, 0.2, 3.0)
    GridFilterConfig(particles=1, weight_beams=1, threads=1, map_beams=0, young=0, lift=1.0, ess_fraction=1.0)
    GridFilterConfig(lift=0.0, walk_scale=0.0, motion_scale=0.0)


def test_walks_are_scaled_and_the_odometrys_own_noise_is_not() -> None:
    step, none = np.array([1.0, 0.0, 0.2]), np.zeros((3, 3))
    full = motion_covariance(step, none, GridFilterConfig())
    np.testing.assert_allclose(motion_covariance(step, none, GridFilterConfig(walk_scale=0.5)), full / 4)
    odometry = np.diag([1e-4, 1e-4, 1e-6])
    added = motion_covariance(step, odometry, GridFilterConfig(walk_scale=0.5)) - odometry
    np.testing.assert_allclose(added, full / 4)


@pytest.mark.parametrize("planar", [True, False])
def test_sampled_motion_has_the_covariance_it_was_sampled_from(planar: bool, rng: np.random.Generator) -> None:
    d = 3 if planar else 6
    A = rng.normal(size=(d, d)) * 0.05
    cov = A @ A.T
    start = np.array([1.0, 2.0, 0.5]) if planar else se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    step = np.array([0.3, 0.1, 0.2]) if planar else se3_exp(np.array([0.02, 0.01, 0.1, 0.3, 0.1, 0.02]))
    n = 20_000
    moved = move_poses(np.tile(start, (n, 1)), step, rng.normal(size=(n, d)) @ square_root(cov).T)
    group = group_of(start)
    e = group.log(group.between(np.broadcast_to(group.compose(start, step), moved.shape), moved))
    nees = np.einsum("na,ab,nb->n", e, np.linalg.inv(cov), e)
    assert 0.97 * d < nees.mean() < 1.03 * d  # σ of the mean: 0.6 … 0.8 %
    assert np.allclose(np.cov(e.T), cov, atol=4 * np.diag(cov).max() * np.sqrt(2 / n))


def test_the_square_root_of_a_covariance_with_a_direction_without_noise() -> None:
    P = np.array([[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    L = square_root(P)
    assert np.allclose(L @ L.T, P, atol=1e-12)
    assert np.array_equal(square_root(np.zeros((6, 6))), np.zeros((6, 6)))


def test_gravity_replaces_roll_and_pitch_and_nothing_else(rng: np.random.Generator) -> None:
    poses = se3_exp(rng.normal(size=(50, 6)) * np.array([0.4, 0.4, 2.0, 5.0, 5.0, 5.0]))
    new = rng.normal(size=(50, 2)) * 0.3
    level = with_roll_pitch(poses, new)
    assert np.allclose(roll_pitch_of(level), new, atol=1e-12)
    assert np.allclose(np.exp(1j * heading_of(level)), np.exp(1j * heading_of(poses)), atol=1e-12)
    assert np.array_equal(level[:, :3], poses[:, :3])
    assert np.allclose(np.linalg.norm(level[:, 3:], axis=1), 1.0, atol=1e-12)
    # what gravity says already changes nothing
    again = with_roll_pitch(poses, roll_pitch_of(poses))
    assert np.allclose(np.abs(np.sum(again[:, 3:] * poses[:, 3:], axis=1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("time", [0.5, 3.0])
def test_errors_of_gravity_keep_their_spread_and_forget_in_time(time: float, rng: np.random.Generator) -> None:
    n, sigma, dt = 40_000, 0.004, 0.4 * time / 3.0
    first = sigma * rng.normal(size=(n, 2))
    e = first
    for _ in range(5):
        e = walk_tilt_errors(e, dt, sigma, time, rng.normal(size=(n, 2)))
    assert e.std() == pytest.approx(sigma, rel=0.02)
    correlation = np.mean(e * first) / sigma**2
    assert correlation == pytest.approx(np.exp(-5 * dt / time), abs=0.02)
    assert np.mean(walk_tilt_errors(first, dt, sigma, 0.0, rng.normal(size=(n, 2))) * first) == pytest.approx(
        0.0, abs=0.02 * sigma**2
    )


@pytest.mark.parametrize(
    "bad",
    [
        {"particles": 0}, {"threads": 0}, {"ess_fraction": 0.0}, {"voxel_size": float("nan")}, {"heading_walk": -1.0},
        {"ess_fraction": 1.01}, {"lift": 1.01}, {"lift": -0.01}, {"map_beams": -1}, {"young": -1}, {"walk_scale": -1.0},
        {"motion_scale": float("inf")}, {"tilt_walk": float("nan")},
        {"likelihood": "guess"}, {"endpoint_effective_beams": 0.0}, {"hit": 0.4}, {"floor": 0.0}, {"weight_beams": 0},
    ],
)  # fmt: skip
def test_impossible_configurations_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        GridFilterConfig(**bad)  # type: ignore[arg-type]
