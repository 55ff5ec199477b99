"""Which path makes the sharper map: a room, seen along the true path and along ones that are off."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.point_clouds import ArrayClouds, PointClouds
from graphslam.core.trajectory import Trajectory
from graphslam_studies.evaluate.sharpness import sharpness


@pytest.fixture(scope="module")
def room():
    """30 scans from within a box of 6 m × 5 m × 3 m, points with σ of 1 cm, and the true path."""
    rng = np.random.default_rng(5)
    times = np.arange(30.0)
    xi = np.zeros((30, 6))
    xi[:, 2] = 0.1 * times
    xi[:, 3:5] = np.column_stack([np.sin(0.3 * times), np.cos(0.2 * times)])
    poses = se3.se3_exp(xi)
    scans = []
    for T in poses:
        x = rng.uniform(-1.0, 1.0, (900, 3)) * [3.0, 2.5, 1.5]
        side = rng.integers(0, 3, 900)
        at = np.arange(900), side
        x[at] = np.where(x[at] < 0, -1.0, 1.0) * np.array([3.0, 2.5, 1.5])[side]
        scans.append(se3.se3_transform(se3.se3_inverse(T), x + 0.01 * rng.standard_normal(x.shape)))
    offsets = np.arange(31, dtype=np.int64) * 900
    return PointClouds(times=times, source=ArrayClouds(np.concatenate(scans), offsets)), Trajectory(times, poses), rng


def test_the_path_that_is_off_makes_thicker_walls(room) -> None:
    clouds, true, rng = room
    off = 0.02 * rng.standard_normal((30, 6)) * [0.2, 0.2, 0.2, 1.0, 1.0, 1.0]
    moved = Trajectory(true.times, se3.se3_compose(true.poses, se3.se3_exp(off)))
    found = sharpness(clouds, {"moved": moved, "true": true}, places=800, apart=5.0)
    assert found["true"].thickness == pytest.approx(0.01, rel=0.15)
    assert found["moved"].thickness == pytest.approx(np.hypot(0.01, 0.02), rel=0.25)
    assert found["moved"].revisited > 1.5 * found["true"].revisited
    gain, sigma = found["true"].gain
    assert gain > 10.0 * sigma > 0.0
    assert found["moved"].gain[0] == 0.0
    assert found["true"].entropy == pytest.approx(found["moved"].entropy - gain)


def test_a_path_that_is_off_as_a_whole_is_as_sharp(room) -> None:
    clouds, true, _ = room
    T = se3.se3_exp(np.array([0.3, -0.2, 1.0, 5.0, 2.0, -1.0]))
    turned = Trajectory(true.times, se3.se3_compose(np.broadcast_to(T, true.poses.shape), true.poses))
    found = sharpness(clouds, {"true": true, "turned": turned}, places=300)
    assert abs(found["turned"].gain[0]) < 1e-6


def test_clouds_that_share_no_surface_are_refused(room) -> None:
    clouds, true, _ = room
    far = true.poses.copy()
    far[:, 0] += 100.0 * np.arange(30)
    with pytest.raises(DataError, match="same surfaces"):
        sharpness(clouds, {"far": Trajectory(true.times, far)}, places=100)
