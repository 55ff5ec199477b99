"""LiDAR odometry on the first scans of HKU 1, as they are and spoilt."""

import numpy as np
import pytest

import graphslam as gs
from graphslam.core import se3
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.odometry import LidarOdometry
from graphslam_frontends.odometry.recorded import chain_odometry

SCANS = 90


@pytest.fixture(scope="module")
def recorded(data_dir):
    log = gs.load("lidar3d-hku1")
    clouds = log["clouds"]
    rows = [(k, float(clouds.times[k]), clouds.cloud(k)) for k in range(SCANS)]
    other = gs.load("lidar3d-hku-mb")["clouds"]
    return rows, chain_odometry(log["odometry"]).poses, [other.cloud(k) for k in (200, 201)]


def _followed(rows):
    odometry = LidarOdometry(LidarOdometryConfig())
    states, poses = {}, {}
    for k, time, cloud in rows:
        states[k] = odometry.step(cloud, time).state
        poses[k] = odometry.pose
    return states, poses


def _ate(poses, truth, rows):
    path, true = np.array([poses[k] for k in rows]), truth[list(rows)]
    T, _ = se3.align_se3(path[:, :3], true[:, :3])
    return np.sqrt(np.mean(np.sum((se3.se3_transform(T, path[:, :3]) - true[:, :3]) ** 2, axis=1)))


def test_the_recording_as_it_is_and_spoilt(recorded):
    rows, truth, foreign = recorded
    states, poses = _followed(rows)
    assert _ate(poses, truth, range(SCANS)) < 0.08
    assert set(states.values()) <= {"first", "matched", "new space"}
    later = range(52, SCANS)
    clean = _ate(poses, truth, later)
    empty = [(k, t, c[:0] if 40 <= k < 46 else c) for k, t, c in rows]
    strange = [(k, t, foreign[k - 40] if k in (40, 41) else c) for k, t, c in rows]
    for spoilt, bad in (
        ([r for r in rows if not 40 <= r[0] < 45], {}),
        (empty, dict.fromkeys(range(40, 46), "empty")),
        (strange, {40: "lost", 41: "lost"}),
    ):
        states, poses = _followed(spoilt)
        assert {k: states[k] for k in bad} == bad
        assert _ate(poses, truth, later) < 2.0 * clean
