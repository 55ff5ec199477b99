"""Attitude and bias of the gyro from positions: Wahba's problem over a ring, whatever the heading and the bias."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.imu import Imu
from graphslam_studies.graph.inertial_start import inertial_start, integrate_attitude
from tests.reference.imu_ring import NOISE, true_readings, true_unit

UNSURE = replace(NOISE, gyro_bias=0.1)
CONJUGATE = [-1.0, -1.0, -1.0, 1.0]


def read(rng: np.random.Generator, bias: np.ndarray, seconds: float = 40.0) -> Imu:
    t = np.arange(0.0, seconds, 0.01)
    rate, force = true_readings(t)
    noisy = rate + bias + 0.002 * rng.standard_normal(rate.shape)
    return Imu(
        times=t, angular_rate=noisy, specific_force=force + 0.02 * rng.standard_normal(force.shape), noise=UNSURE
    )


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
def test_attitude_and_bias_are_found(rng, heading):
    """The frame of the positions is turned by any heading; the bias turns the body by radians over the drive."""
    bias = np.array([0.02, -0.03, 0.08])
    turn = se3.so3_exp(np.array([0.0, 0.0, heading]))
    at = np.arange(0.5, 39.0, 1.0)
    unit = true_unit(at)
    points = se3.quat_rotate(turn, unit[:, :3]) + 0.003 * rng.standard_normal((len(at), 3))
    attitude, found = inertial_start(read(rng, bias), at, points)
    np.testing.assert_allclose(found, bias, atol=5e-3)
    true = se3.quat_multiply(turn, unit[:, 3:])
    all_of_them = integrate_attitude(attitude, read(rng, bias), at, found)
    off = np.linalg.norm(se3.so3_log(se3.quat_multiply(all_of_them * CONJUGATE, true)), axis=1)
    assert off.max() < 0.15


def test_positions_may_be_seconds_apart(rng):
    """Over eight of them an unknown bias turns by half a turn and more: several are tried."""
    bias = np.array([0.1, 0.1, -0.1])
    at = np.arange(0.5, 75.0, 5.0)
    points = true_unit(at)[:, :3] + 0.003 * rng.standard_normal((len(at), 3))
    _, found = inertial_start(read(rng, bias, 80.0), at, points)
    np.testing.assert_allclose(found, bias, atol=2e-3)


def test_three_positions_are_too_few(rng):
    with pytest.raises(DataError, match="four"):
        inertial_start(read(rng, np.zeros(3), 3.0), np.arange(0.5, 2.0, 0.5), np.zeros((3, 3)))
