"""The vehicle that a map of the terrain is made for, and the sensor that looks: what can be told, and how far."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array

CELLS = (0.1, 0.2, 0.4, 0.8)
"""Widths of the cells of the bands [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """What a vehicle can drive over, under and up."""

    wheel_radius: float = 0.2
    """[m]"""
    climbable_step: float = 0.06
    """Highest step that the wheels climb [m]; about 0.3 of the radius without a run-up."""
    clearance: float = 0.25
    """What is higher above the ground is an obstacle to the body, not a step of the ground [m]."""
    height: float = 1.8
    """What hangs higher above the ground than this is above reach [m]."""
    width: float = 0.7
    """[m]"""
    max_slope: float = math.radians(15.0)
    """Steepest ground that may be driven [rad]."""
    reaction_time: float = 0.5
    """From seeing to braking [s]."""
    deceleration: float = 0.5
    """When it brakes [m/s²]."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
                raise ConfigError(f"vehicle: {f.name} = {value}; wanted a number above 0")
        if not self.climbable_step < self.clearance < self.height:
            raise ConfigError(
                f"vehicle: climbable step {self.climbable_step}, clearance {self.clearance}, height {self.height} m; "
                "wanted ascending"
            )
        if self.max_slope >= math.pi / 3:
            raise ConfigError(f"vehicle: max_slope = {self.max_slope}; wanted less than π/3 rad")

    def braking_distance(self, speed: float) -> float:
        """Way from seeing something until it stands [m]."""
        return speed * self.reaction_time + speed**2 / (2.0 * self.deceleration)

    def safe_speed(self, seen: float) -> float:
        """Highest speed [m/s] from which it stops within ``seen`` metres."""
        a, t = self.deceleration, self.reaction_time
        return max(-a * t + math.sqrt((a * t) ** 2 + 2.0 * a * max(seen, 0.0)), 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSensor:
    """A sensor whose beams follow each other in upright lines.

    Parameters
    ----------
    height : float
        Above the ground [m].
    beam_step : float
        Angle between neighbouring beams of a line [rad].
    sweep_time : float
        Until it has looked everywhere once [s].
    """

    height: float = 1.1
    beam_step: float = math.radians(0.5)
    sweep_time: float = 2.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
                raise ConfigError(f"sensor: {f.name} = {value}; wanted a number above 0")

    def band_edges(self, cells: tuple[float, ...] = CELLS) -> Array:
        """Ranges ``(b,)`` at which the bands end [m]: there the beams meet level ground one cell apart.

        Neighbouring beams meet it ``r² δ / H`` apart, so ``r = sqrt(cell · H / δ)``. The last band goes on for a fifth
        more.
        """
        edges = np.sqrt(np.asarray(cells, dtype=np.float64) * self.height / self.beam_step)
        edges[-1] *= 1.2
        return edges

    def hole_reach(self, vehicle: Vehicle) -> float:
        """Range [m] beyond which a hole looks like a slope that may be driven: ``H / tan α``."""
        return self.height / math.tan(vehicle.max_slope)

    def step_reach(self, height: float, beams: float = 2.0) -> float:
        """Range [m] within which so many beams meet a riser of this height: ``b / (k δ)``."""
        return height / (beams * self.beam_step)

    def depth_seen(self, length: float, distance: float) -> float:
        """How deep [m] one sees into a hole of this length from this distance: ``L H / r``."""
        return length * self.height / distance

    def speed_bound(self, vehicle: Vehicle) -> float:
        """Highest speed [m/s] from which the vehicle stops before a hole: the last look was a sweep ago."""
        reach, low, high = self.hole_reach(vehicle), 0.0, 20.0
        for _ in range(60):
            speed = 0.5 * (low + high)
            fits = speed * self.sweep_time + vehicle.braking_distance(speed) <= reach
            low, high = (speed, high) if fits else (low, speed)
        return low
