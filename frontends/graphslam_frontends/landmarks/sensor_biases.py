"""Constant errors of wheels and sensor of a smoothed submap, for a graph to estimate
(:mod:`graphslam.core.sensor_biases`).

Model of the measurements: rotations are ``b`` too large per second of motion, or per metre; distances are too long by
the factor ``e^s``; ranges are too long by ``o``; the sensor is rotated to the left by ``y``, or ranges without bearing
are too long by the factor ``e^y``; the sensor is ``x`` further ahead, and ``y`` further to the left.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array, rotation2, se2_between
from graphslam.core.log import SensorLog
from graphslam.core.records import SteeringControls
from graphslam.core.sensor_biases import CONSTANTS, SensorBiases
from graphslam_frontends.detectors.trees import TreeDetectorConfig
from graphslam_frontends.landmarks.config import SensorBiasConfig
from graphslam_frontends.landmarks.fix_points import FixPlacement
from graphslam_frontends.landmarks.prepare import landmark_stream
from graphslam_frontends.landmarks.sensitivity_kernels import bias_sensitivities
from graphslam_frontends.landmarks.summarise import SmoothingResult
from graphslam_frontends.odometry.motion import motion_stream

MOVING = 1e-6
"""An increment of the odometry with smaller translation and rotation is rest [m, rad]."""

STEERING = float(np.deg2rad(1.0))
"""σ of the systematic steering error after calibration [rad/m]: 1° of the wheel at 1 m wheelbase."""
TYRES, RANGE_SCALE = 0.01, 0.05
"""σ of the logarithm of the scale of wheel distances, and of radio ranges."""
MOUNT = 0.3
"""σ of the position of a sensor if it is not given [m]."""


def possible_biases(log: SensorLog, detector: TreeDetectorConfig) -> SensorBiasConfig:
    """Systematic errors that a log of landmarks may have.

    A steered vehicle has a rotation error per metre, a robot with a gyro or two driven wheels one per second. Ranges
    without bearings have no yaw, but may have a scale; the scale of the map is then that of the wheels, within the
    uncertainty by load and tyre pressure.
    """
    steers = isinstance(motion_stream(log)[1], SteeringControls)
    turn = {"yaw_bias": 0.0, "turn_per_metre": STEERING} if steers else {}
    seen = landmark_stream(log, detector)[1]
    blind = not np.any(seen.has_bearing)
    ranges = {"distance_scale": TYRES, "range_scale": RANGE_SCALE, "sensor_yaw": 0.0, "mount": 0.0} if blind else {}
    place = {} if blind or np.any(seen.T_base_sensor[:2] != 0.0) else {"mount": MOUNT}
    return SensorBiasConfig(**turn, **ranges, **place)


def estimate_sensor_biases(
    config: SensorBiasConfig, smoothed: SmoothingResult, seconds: Array, fix: FixPlacement | None, *, base: bool
) -> SensorBiases:
    """Sensitivity of a smoothed submap to constant errors, and its information on them.

    Parameters
    ----------
    seconds : (T,)
        Duration of each increment of the odometry.
    fix : FixPlacement or None
        Points of the path at fixes.
    base : bool
        The trajectory begins with the base, which is fixed.
    """
    names, sigmas = config.chosen()
    evidence, T = smoothed.evidence, len(smoothed.poses)
    ob, x = evidence.ob, smoothed.poses
    # errors relative to smoothed motion and ranges: measurement noise would cause a spurious scale
    u = se2_between(np.concatenate([np.zeros((1, 3)), x[:-1]]), x)
    still = np.hypot(evidence.u[:, 0], evidence.u[:, 1]) + np.abs(evidence.u[:, 2]) < MOVING
    at = x[evidence.ob_pose]
    off = np.einsum("kji,kj->ki", rotation2(at[:, 2]), smoothed.landmarks[evidence.ob_lm] - at[:, :2])
    off -= evidence.sensor[:2]  # from the sensor, in the axes of the body
    ranges = np.maximum(np.linalg.norm(off, axis=1), 1e-6)
    metres = np.hypot(u[:, 0], u[:, 1])
    R_end = rotation2(u[:, 2])
    along, seen = np.zeros((T, 3, len(CONSTANTS))), np.zeros((len(ob), 2, len(CONSTANTS)))
    if names[0]:
        weight = metres if names[0] == "turn_per_metre" else seconds * ~still
        half = 0.5 * np.stack([-u[:, 1], u[:, 0]], -1)  # on average over the step the heading error is half of it
        along[:, :2, 0] = weight[:, None] * np.einsum("kji,kj->ki", R_end, half)
        along[:, 2, 0] = weight
    if names[1]:
        along[:, :2, 1] = np.einsum("kji,kj->ki", R_end, u[:, :2])
    if names[2]:
        seen[:, 0, 2] = -1.0
    if names[3] == "range_scale":
        seen[:, 0, 3] = -ranges
    elif names[3]:
        seen[:, 1, 3] = 1.0
    if names[4]:  # bearing effects grow with 1/range without bound: the range is limited to its σ
        ahead, near = off / ranges[:, None], np.maximum(ranges, np.sqrt(ob[:, 2]))
        seen[:, 0, 4], seen[:, 0, 5] = ahead[:, 0], ahead[:, 1]
        seen[:, 1, 4], seen[:, 1, 5] = -ahead[:, 1] / near, ahead[:, 0] / near
    moved, shifted, score, information = bias_sensitivities(smoothed.poses, smoothed.landmarks, evidence, along, seen)
    exit_moved = moved[-1].copy()
    exit_moved[:2] = rotation2(smoothed.poses[-1, 2]) @ exit_moved[:2]  # right tangent → plain vector of eq. 15
    points, before = np.zeros((0, len(CONSTANTS))), np.concatenate([np.zeros((1, 3, len(CONSTANTS))), moved])
    if fix is not None:
        points = (fix.by_first @ before[fix.at + 1] + fix.by_second @ before[fix.at + 2]).reshape(-1, len(CONSTANTS))
    return SensorBiases(
        names=names, sigmas=sigmas, response=np.concatenate([exit_moved, shifted]), score=score,
        information=information, path=before if base else moved, points=points,
    )  # fmt: skip
