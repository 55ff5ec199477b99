"""Recorded odometry that saw gravity: roll and pitch stay right where the heading is spoilt."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.records import LaserScans, Odometry
from graphslam_frontends.grid.motion import roll_pitch_of
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.step_config import StepConfig
from tests.frontends.odometry.test_recorded import winding


def rolling() -> SensorLog:
    """A body that leans to all sides on its way."""
    odometry = winding(3)
    angle = 0.2 * np.sin(np.outer(np.arange(101), [0.15, 0.11, 0.0]))
    poses = chain_odometry(odometry).poses
    poses[:, 3:] = se3.quat_multiply(poses[:, 3:], se3.so3_exp(angle))
    increments = np.concatenate([odometry.increments[:1], se3.se3_between(poses[:-1], poses[1:])])
    motion = Odometry(times=odometry.times, increments=increments, covariances=odometry.covariances)
    clouds = PointClouds.from_arrays(odometry.times, np.tile([[5.0, 1, 0]], (101, 1)), np.arange(102))
    return SensorLog(name="rolling", streams={"clouds": clouds, "odometry": motion})


def test_a_yaw_bias_turns_the_heading_and_leaves_roll_and_pitch() -> None:
    log = rolling()
    true = roll_pitch_of(chain_odometry(log["odometry"]).poses)
    config = StepConfig(period=None, yaw_bias=0.02, odometry_tilt_sigma=0.004)
    steps = make_steps(log, config)
    assert steps.tilt is not None
    assert (steps.tilt_sigma, steps.tilt_time) == (0.004, 10.0)
    np.testing.assert_allclose(steps.tilt, true, atol=1e-9)
    assert np.abs(true).max() > 0.25
    # the motion itself has the bias: its own chain is off in heading by the bias, and leans wrongly
    spoilt = chain_odometry(steps.odometry).poses
    off = se3.se3_log(se3.se3_between(chain_odometry(log["odometry"]).poses[-1], spoilt[-1]))
    assert abs(np.linalg.norm(off[:3]) - 0.02 * 20.0) < 0.1
    assert np.abs(roll_pitch_of(spoilt) - true).max() > 0.02
    assert make_steps(log, StepConfig(period=None, yaw_bias=0.02)).tilt is None


def test_odometry_in_the_plane_has_no_tilt() -> None:
    odometry = winding(2)
    scans = LaserScans(times=odometry.times, ranges=np.ones((101, 3)), bearings=np.array([-1.0, 0, 1]), max_range=5.0)
    log = SensorLog(name="flat", streams={"laser": scans, "odometry": odometry})
    with pytest.raises(ConfigError, match="no roll and pitch"):
        make_steps(log, StepConfig(odometry_tilt_sigma=0.01))
