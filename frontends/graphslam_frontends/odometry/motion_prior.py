"""How far the errors of motion and gravity that outlive a step may go, before any scan was looked at."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam_frontends.odometry.inertial_biases import DeadReckonedPath
from graphslam_frontends.odometry.recorded import RecordedErrors
from graphslam_frontends.odometry.steps import Steps


@dataclass(frozen=True, slots=True, kw_only=True)
class BiasSigmas:
    """Prior σ of the errors that outlive a step."""

    yaw_bias: float
    """Of the yaw rate [rad/s]."""
    yaw_walk: float
    """Its walk [rad/s/√s]."""
    scale: float
    """Share of the distance."""
    direction: float
    """Between the way in which the odometry says the body moves, and that in which the scanner sees it move [rad]."""
    clock: float
    """Between the clocks of motion and scans [s]."""
    tilt: float
    """Constant part of gravity's roll and pitch [rad]."""
    bend: float
    """Of wheels in the plane: what they turn too much for each metre driven, one being larger [rad/m]."""
    turn: float
    """Of wheels in the plane: share of the turns, the distance between them being known no better."""


LEAST = BiasSigmas(
    yaw_bias=2e-3, yaw_walk=5e-6, scale=0.01, direction=0.01, clock=0.02, tilt=2e-3, bend=0.03, turn=0.03
)
"""What no robot is known better to than from its own scans: consumer gyros, wheels under load, brackets, clocks."""


def bias_sigmas(steps: Steps) -> BiasSigmas:
    """Prior σ of the lasting errors of steps: those that their motion states, never less than :data:`LEAST`."""
    e, least = steps.errors, LEAST
    bias, walk, scale, tilt = 0.0, 0.0, 0.0, steps.tilt_sigma
    if isinstance(e, DeadReckonedPath):
        bias, walk, scale = e.lasting.gyro_bias, e.lasting.gyro_walk, e.lasting.wheel_scale
        tilt = e.lasting.attitude_bias
    elif isinstance(e, RecordedErrors):
        bias, scale = e.yaw_bias, e.scale
    return BiasSigmas(
        yaw_bias=max(bias, least.yaw_bias),
        yaw_walk=walk or least.yaw_walk,  # a walk that is greater than stated is found and widened
        scale=max(scale, least.scale),
        direction=least.direction,
        clock=least.clock,
        tilt=max(tilt, least.tilt),
        bend=least.bend,
        turn=least.turn,
    )
