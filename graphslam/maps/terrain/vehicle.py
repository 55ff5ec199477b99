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

    def hole_reach(self, vehicle: Vehicle, depth: float = math.inf) -> float:
        """Range [m] within which a fall of this depth does not look like a slope that may be driven.

        A beam that passes the edge at range ``r`` meets the ground below ``r · depth / H`` farther on. The steepest
        slope α that may be driven leads ``tan α`` times that down. The rest, ``depth · (1 − r tan α / H)``, tells a
        fall when it is more than the vehicle climbs: ``r = H / tan α · (1 − step / depth)``.

        Parameters
        ----------
        depth : float
            [m]; without end by default, which is the limit for any fall.
        """
        return self.height / math.tan(vehicle.max_slope) * max(1.0 - vehicle.climbable_step / depth, 0.0)

    def step_reach(self, height: float, beams: float = 2.0) -> float:
        """Range [m] within which so many beams meet a riser of this height: ``b / (k δ)``."""
        return height / (beams * self.beam_step)

    def speed_bound(self, vehicle: Vehicle, depth: float | None = None) -> float:
        """Highest speed [m/s] from which the vehicle stops before a fall.

        The last look at a place may be a sweep ago, and then the place was just out of reach. So the path of one sweep,
        the braking distance and half the width of the vehicle, by which its front is ahead of the sensor, lie within
        `hole_reach`.

        Parameters
        ----------
        depth : float, optional
            Of the fall [m]; default the vehicle's clearance, over which it would hang.
        """
        reach = self.hole_reach(vehicle, vehicle.clearance if depth is None else depth) - 0.5 * vehicle.width
        a = vehicle.deceleration  # v (sweep + reaction) + v² / 2a = reach
        b = a * (self.sweep_time + vehicle.reaction_time)
        return max(math.sqrt(b**2 + 2.0 * a * max(reach, 0.0)) - b, 0.0)
