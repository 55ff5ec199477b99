"""Odometry of wheels tells the motion of scans that find no place, as long as it tells those of the others."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.records import Odometry
from graphslam_frontends.lidar_odometry.wheel_prior import NOISE, WheelMotionPrior


def wheels(scale: float = 1.0, n: int = 200, dim: int = 2) -> tuple[Odometry, np.ndarray]:
    """An arc at 20 Hz, and its poses in space at the stamps 0, 0.05, …"""
    times = 0.05 * np.arange(1, n + 1)
    step = np.array([0.05, 0.0, 0.01])
    poses = [np.array([0.0, 0, 0, 0, 0, 0, 1])]
    q = np.array([0.0, 0.0, np.sin(step[2] / 2), np.cos(step[2] / 2)])
    for _ in range(n):
        poses.append(se3.se3_compose(poses[-1], np.concatenate([step[:2], [0.0], q])))
    increments = np.tile(step * [scale, scale, 1.0], (n, 1))
    covariances = np.tile(np.diag([1e-6, 2e-6, 3e-8]), (n, 1, 1))
    if dim == 3:
        increments = np.tile(np.concatenate([step[:2] * scale, [0.0], q]), (n, 1))
        covariances = np.tile(np.diag([3e-8] * 3 + [1e-6, 2e-6, 1e-6]), (n, 1, 1))
    return Odometry(times=times, increments=increments, covariances=covariances), np.array(poses)


@pytest.mark.parametrize("dim", [2, 3])
def test_motions_are_those_of_the_records(dim: int) -> None:
    """Also between records, and where they come one by one."""
    odometry, poses = wheels(dim=dim)
    whole, parts = WheelMotionPrior(odometry), WheelMotionPrior(odometry.take(slice(0, 0)))
    for k in range(200):
        parts.more(odometry.take(slice(k, k + 1)), 0.05 * k - 9.5)
    for found in (whole, parts):
        motion, variances = found.motion(1.0, 3.0)
        assert motion.tobytes() == whole.motion(1.0, 3.0)[0].tobytes()
        np.testing.assert_allclose(motion, se3.se3_between(poses[20], poses[60]), atol=1e-9)
        np.testing.assert_allclose(variances, [40 * 3e-8, 40 * 2e-6])
        half, _ = found.motion(1.0, 1.025)
        step = se3.se3_log(se3.se3_between(poses[20], poses[21]))
        np.testing.assert_allclose(se3.se3_log(half), 0.5 * step, atol=1e-9)
    assert whole.motion(3.0, 11.0) is None
    assert whole.motion(-1.0, 1.0) is None


@pytest.mark.parametrize(("scale", "useful", "better"), [(1.0, True, True), (1.2, True, True), (-1.0, False, False)])
def test_it_is_of_use_while_it_tells_the_motions_of_scans(scale: float, useful: bool, better: bool) -> None:
    """An error of the scale leaves it useful; a wrong sign does not."""
    odometry, poses = wheels(scale)
    reckoned = WheelMotionPrior(odometry)
    assert reckoned.useful
    assert not reckoned.better
    for k in range(2, 40, 2):
        predicted, _ = reckoned.motion(0.05 * k, 0.05 * (k + 2))
        made = se3.se3_between(poses[k], poses[k + 2])
        even = made.copy()
        even[0] += 0.03  # what an even motion misses
        reckoned.learn(predicted, made, even)
    assert (reckoned.useful, reckoned.better) == (useful, better)
    turn, shift = reckoned.variances(np.zeros(2))
    assert turn == pytest.approx(NOISE[0] ** 2)
    assert shift == pytest.approx(max(NOISE[1] ** 2, (0.1 * (scale - 1.0)) ** 2 / 3), rel=0.05)
