"""Registry of the calibration methods: from landmark observations or from scan matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from graphslam.calibrate.estimate import Calibration
from graphslam.calibrate.landmark_calibration import CalibrationBudget, calibrate_observations
from graphslam.calibrate.scans import POINTS, calibrate_scans
from graphslam.calibrate.windows import ObservationLog
from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.core.records import LaserScans
from graphslam_frontends.landmarks.prepare import landmark_stream
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.motion_prior import MotionPrior, OdometryBiases


def _of_observations(log: SensorLog, config: Any, effort: CalibrationBudget, seed: int) -> Calibration:
    seen = ObservationLog.of(log, *landmark_stream(log, config.detector))
    return calibrate_observations(seen, effort, seed=seed, noise=getattr(config, "motion", None))


def _of_scans(log: SensorLog, config: Any, effort: CalibrationBudget, seed: int) -> Calibration:
    wanted = replace(config.steps, match_scans=False, yaw_per_metre=0.0)
    if log.of_type(LaserScans) is None:
        wanted = replace(wanted, most_points=max(wanted.most_points, POINTS))
    steps = make_steps(log, wanted)
    if not (isinstance(steps.errors, MotionPrior) and isinstance(steps.errors.biases, OdometryBiases)):
        raise DataError("an IMU with wheels is not calibrated: its front end estimates their errors", where=log.name)
    return calibrate_scans(steps, effort)


CALIBRATIONS: dict[str, Callable[[SensorLog, Any, CalibrationBudget, int], Calibration]] = {
    "observations": _of_observations,
    "scans": _of_scans,
}
"""Calibration methods by the data that they use in addition to the motion; none needs ground truth.

The arguments are the log, the configuration of a front end (landmark detector, conversion of scans to steps), the
budget, and the random seed.
"""
