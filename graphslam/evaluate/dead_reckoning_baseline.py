"""Dead-reckoned path of a log, the baseline for a solved path."""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.plan_view import plan_path
from graphslam.core.poses import SE3, group_of
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry import motion


def dead_reckoned_path(log: SensorLog, path: Trajectory | Array) -> Trajectory | None:
    """Path from the motion stream only, in the frame of the first base; None without a motion stream.

    Parameters
    ----------
    path : Trajectory, or times (n,)
        The solved path: gives times, dimension, and in 3-D the first pose, because a base can differ from the body
        pose. If only times are given, the result is 2-D.
    """
    if not isinstance(path, Trajectory):
        path = Trajectory(path, np.zeros((len(path), 3)))
    try:
        stream = motion.motion_stream(log)[1]
    except MissingDataError:
        return None
    last = stream.times[-1] if isinstance(stream, Odometry) else np.inf  # the last control is held
    times = path.times[(path.times >= stream.times[0]) & (path.times <= last)]
    if len(times) < 2:
        return None
    if isinstance(stream, Odometry) and stream.increments.shape[1] == 7:
        return _reckoned_in_space(stream, times, path)
    steps = motion.dead_reckoned_increments(log, times, motion.MotionNoise(speed=0.0, steering=0.0, yaw_rate=0.0))[
        0
    ].increments
    group = group_of(steps)
    poses = np.tile(group.identity, (len(steps), 1))
    for k in range(1, len(steps)):
        poses[k] = group.compose(poses[k - 1], steps[k])
    return Trajectory(times, poses)


def _reckoned_in_space(odometry: Odometry, times: Array, path: Trajectory) -> Trajectory:
    poses = np.tile(SE3.identity, (len(odometry.times), 1))
    for k in range(1, len(poses)):
        poses[k] = SE3.compose(poses[k - 1], odometry.increments[k])
    at = Trajectory(odometry.times, poses).interpolate(times)
    if path.dim == 2:
        return plan_path(Trajectory(times, SE3.between(np.broadcast_to(at[0], at.shape), at)))
    start = SE3.compose(path.interpolate(times[:1])[0], SE3.inverse(at[0]))
    return Trajectory(times, SE3.compose(np.broadcast_to(start, at.shape), at))
