"""Swapped axes of an IMU are found by residuals and named; right ones are left in peace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factors.imu.axes import check_imu_axes, signed_permutations

NOISE = ImuNoise(
    gyro=1e-3, gyro_bias=0.01, gyro_walk=1e-5, accelerometer=0.02, accelerometer_bias=0.05, accelerometer_walk=1e-3
)
MOUNT = np.array([0.2, 0.0, 0.5, 0.0, 0.0, np.sin(0.3), np.cos(0.3)])


def drive(tilt: float, seed: int = 0, seconds: float = 60.0, lean: float = 0.9) -> tuple[Imu, Trajectory]:
    """Readings at 50 Hz of a body that turns to and fro, with roll and pitch of that size [rad]; ``lean``: how fast the
    pitch goes to and fro [rad/s]."""
    rng, dt = np.random.default_rng(seed), 0.02
    t = dt * np.arange(round(seconds / dt))
    yaw, pitch, roll = np.sin(0.4 * t) + 0.1 * t, tilt * np.sin(lean * t), tilt * np.sin(1.3 * t + 1.0)
    zero = np.zeros_like(t)
    q = np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], 1)
    q = se3.quat_multiply(q, np.stack([zero, np.sin(pitch / 2), zero, np.cos(pitch / 2)], 1))
    q = se3.quat_multiply(q, np.stack([np.sin(roll / 2), zero, zero, np.cos(roll / 2)], 1))
    poses = np.concatenate([np.stack([t, zero, zero], 1), q], 1)
    unit = se3.quat_multiply(q, np.broadcast_to(MOUNT[3:], q.shape))
    rate = se3.so3_log(se3.quat_multiply(unit[:-1] * [-1, -1, -1, 1], unit[1:])) / dt
    rate = np.concatenate([rate, rate[-1:]])
    force = GRAVITY * se3.quat_to_matrix(unit)[:, 2, :]
    rate = rate + 0.01 * rng.standard_normal(3) + 0.01 * rng.standard_normal(rate.shape)
    force = force + 0.5 * rng.standard_normal(force.shape)
    imu = Imu(times=t, angular_rate=rate, specific_force=force, noise=NOISE, T_base_imu=MOUNT)
    error = se3.se3_exp(0.01 * rng.standard_normal((len(t[::10]), 6)))
    return imu, Trajectory(t[::10], se3.se3_compose(poses[::10], error))


def misread(imu: Imu, A: np.ndarray) -> Imu:
    return replace(imu, angular_rate=imu.angular_rate @ A.T, specific_force=imu.specific_force @ A.T)


def test_every_exchange_is_found() -> None:
    imu, path = drive(tilt=0.15)
    mountings = signed_permutations()
    assert len({tuple(A.ravel()) for A in mountings}) == 48
    np.testing.assert_array_equal(mountings[0], np.eye(3))
    assert np.sum(np.linalg.det(mountings) > 0) == 24
    for k, A in enumerate(mountings):
        found = check_imu_axes(misread(imu, A), path)
        np.testing.assert_array_equal(found.A, A)
        assert found.wrong == (k > 0)
        assert found.alike == 1


@pytest.mark.parametrize("lean", [3.5, 4.5, 5.0, 5.8, 7.0])
def test_a_body_that_balances_is_no_reproach(lean: float) -> None:
    """Where it leans to and fro once a window, the ends of a window say the opposite of what was between."""
    imu, path = drive(tilt=0.1, lean=lean)
    assert not check_imu_axes(imu, path).wrong
    for A in signed_permutations()[1:]:
        found = check_imu_axes(misread(imu, A), path)
        assert found.wrong
        np.testing.assert_array_equal(found.A, A)


def test_the_axes_are_named() -> None:
    imu, path = drive(tilt=0.15)
    A = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = check_imu_axes(misread(imu, A), path)
    assert found.words() == "x reads −y, y reads x"
    with pytest.raises(DataError, match=r"my-imu: the axes .*: x reads −y, y reads x; got"):
        found.raise_if_wrong("my-imu")
    right = check_imu_axes(imu, path)
    assert right.words() == ""
    right.raise_if_wrong()


@pytest.mark.parametrize("seed", range(5))
def test_what_cannot_be_estimated_is_no_reproach(seed: int) -> None:
    """Of a body that stays level only the vertical axis shows itself."""
    imu, path = drive(tilt=0.0, seed=seed)
    right = check_imu_axes(imu, path)
    assert not right.wrong
    assert right.alike >= 4
    flat = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
    assert not check_imu_axes(misread(imu, flat), path).wrong
    lying = np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]])
    assert check_imu_axes(misread(imu, lying), path).wrong
    upside = np.diag([1.0, -1.0, -1.0])
    assert check_imu_axes(misread(imu, upside), path).wrong


def test_too_little_in_common_is_refused() -> None:
    imu, path = drive(tilt=0.1, seconds=15.0)
    late = Trajectory(path.times + 10.0, path.poses)
    with pytest.raises(DataError, match="too little time"):
        check_imu_axes(imu, late)


def test_readings_too_thin_for_windows_are_refused() -> None:
    imu, path = drive(tilt=0.1)
    with pytest.raises(DataError, match="too little time"):
        check_imu_axes(imu.take(slice(None, None, 60)), path)


@pytest.mark.parametrize("which", ["angular_rate", "specific_force"])
def test_one_turned_sensor_is_found(which: str) -> None:
    """The other one is as it should be."""
    imu, path = drive(tilt=0.15)
    upside = np.diag([1.0, -1.0, -1.0])
    found = check_imu_axes(replace(imu, **{which: getattr(imu, which) @ upside}), path)
    assert found.wrong
    np.testing.assert_array_equal(found.A, upside)
    assert found.sensor == {"angular_rate": "gyro", "specific_force": "accelerometer"}[which]


def test_a_path_that_turns_otherwise_whatever_the_axes_is_no_word_on_them() -> None:
    """A path that follows something else than the place: its turns and its tilt are its own."""
    imu, path = drive(tilt=0.15)
    t = path.times
    leaning = np.stack([0.1 * t, np.sin(0.5 * t), np.zeros_like(t)], axis=1)
    found = check_imu_axes(imu, Trajectory(t, np.concatenate([path.poses[:, :3], se3.so3_exp(leaning)], axis=1)))
    assert found.turns is not None
    assert found.turns[1] > found.turns[0] / np.sqrt(2.0)
    assert not found.wrong
    assert not found.words()
    assert check_imu_axes(imu, path).turns is None


def test_forces_that_one_way_explains_are_a_word_on_the_mounting_whatever_the_path_turns_by() -> None:
    """The path of a filter that was led by the turned gyro turns by itself, and stays level."""
    imu, path = drive(tilt=0.05)
    odd = replace(imu, angular_rate=imu.angular_rate[:, [1, 2, 0]], specific_force=imu.specific_force[:, [1, 2, 0]])
    yaw = 0.6 * np.sin(0.7 * path.times)
    level = np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=1)
    found = check_imu_axes(odd, Trajectory(path.times, np.concatenate([path.poses[:, :3], se3.so3_exp(level)], axis=1)))
    assert found.wrong
    assert "y reads z" in found.words()
