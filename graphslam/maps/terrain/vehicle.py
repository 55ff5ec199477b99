"""Parameters of the vehicle and the line sensor of a terrain map, with detection ranges and safe speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array

CELLS = (0.1, 0.2, 0.4, 0.8)
"""Cell widths of the range bands [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """Dimensions and limits of a vehicle."""

    wheel_radius: float = 0.2
    """[m]"""
    climbable_step: float = 0.06
    """Highest step that the wheels can climb [m]; about 0.3 of the wheel radius without a run-up."""
    clearance: float = 0.25
    """Points higher above the ground are obstacles for the body, not steps of the ground [m]."""
    height: float = 1.8
    """Points higher above the ground are above the vehicle [m]."""
    width: float = 0.7
    """[m]"""
    max_slope: float = math.radians(15.0)
    """Steepest drivable ground [rad]."""
    reaction_time: float = 0.5
    """Time from detection to braking [s]."""
    deceleration: float = 0.5
    """Braking deceleration [m/s²]."""

    def __post_init__(self) -> None:
        check_options(self, "vehicle: ", {"> 0": "*"})
        if not self.climbable_step < self.clearance < self.height:
            raise ConfigError(
                f"vehicle: climbable step {self.climbable_step}, clearance {self.clearance}, height {self.height} m; "
                "wanted ascending"
            )
        if self.max_slope >= math.pi / 3:
            raise ConfigError(f"vehicle: max_slope = {self.max_slope}; wanted less than π/3 rad")

    def braking_distance(self, speed: float) -> float:
        """Path length from detection to standstill [m]."""
        return speed * self.reaction_time + speed**2 / (2.0 * self.deceleration)

    def safe_speed(self, seen: float) -> float:
        """Highest speed [m/s] with a braking distance of ``seen`` metres."""
        a, t = self.deceleration, self.reaction_time
        return max(-a * t + math.sqrt((a * t) ** 2 + 2.0 * a * max(seen, 0.0)), 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSensor:
    """A sensor that scans in vertical lines.

    Parameters
    ----------
    height : float
        Height above the ground [m].
    beam_step : float
        Angle between neighbouring beams of a line [rad].
    sweep_time : float
        Time for one complete sweep [s].
    """

    height: float = 1.1
    beam_step: float = math.radians(0.5)
    sweep_time: float = 2.0

    def __post_init__(self) -> None:
        check_options(self, "sensor: ", {"> 0": "*"})

    def band_edges(self, cells: tuple[float, ...] = CELLS) -> Array:
        """Ranges ``(b,)`` at which the bands end [m]: there neighbouring beams hit level ground one cell apart.

        They hit it ``r² δ / H`` apart, so ``r = sqrt(cell · H / δ)``. The last band is longer by a fifth.
        """
        edges = np.sqrt(np.asarray(cells, dtype=np.float64) * self.height / self.beam_step)
        edges[-1] *= 1.2
        return edges

    def hole_reach(self, vehicle: Vehicle, depth: float = math.inf) -> float:
        """Range [m] up to which a drop of this depth is distinguishable from a drivable slope.

        A beam that passes the edge at range ``r`` hits the lower ground ``r · depth / H`` farther on. The steepest
        drivable slope α descends by ``tan α`` times that. The rest, ``depth · (1 − r tan α / H)``, must exceed the
        climbable step: ``r = H / tan α · (1 − step / depth)``.

        Parameters
        ----------
        depth : float
            [m]; default infinite, the upper limit for any drop.
        """
        return self.height / math.tan(vehicle.max_slope) * max(1.0 - vehicle.climbable_step / depth, 0.0)

    def step_reach(self, height: float, beams: float = 2.0) -> float:
        """Range [m] up to which ``beams`` beams hit a riser of this height: ``b / (k δ)``."""
        return height / (beams * self.beam_step)

    def speed_bound(self, vehicle: Vehicle, depth: float | None = None) -> float:
        """Highest speed [m/s] from which the vehicle stops before a drop.

        The last observation of a place can be one sweep old, and the place was then just out of range. So the path
        length of one sweep, the braking distance and half the vehicle width (its front is ahead of the sensor) must be
        within `hole_reach`.

        Parameters
        ----------
        depth : float, optional
            Depth of the drop [m]; default the vehicle's clearance.
        """
        reach = self.hole_reach(vehicle, vehicle.clearance if depth is None else depth) - 0.5 * vehicle.width
        a = vehicle.deceleration  # v (sweep + reaction) + v² / 2a = reach
        b = a * (self.sweep_time + vehicle.reaction_time)
        return max(math.sqrt(b**2 + 2.0 * a * max(reach, 0.0)) - b, 0.0)
