"""Simulated worlds by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from graphslam.core.errors import UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field


def _landmark_field(preset: str, seed: int, **changes: Any) -> SensorLog:
    return simulate_landmark_field(landmark_field_preset(preset, **changes), seed)


# name -> (maker, default preset)
WORLDS: dict[str, tuple[Callable[..., SensorLog], str]] = {"landmark-field": (_landmark_field, "A")}


def simulate(world: str, *, seed: int = 0, preset: str | None = None, **changes: Any) -> SensorLog:
    """Simulate a world, truth included.

    Parameters
    ----------
    world : str
        ``landmark-field``.
    seed : int
    preset : str, optional
        ``A``, ``B``, ``C``, ``demo``, ``quick``; ``clutter``, ``pairs``, ``rows`` and ``hard`` confuse an association.
    **changes
        Any figure of the world's configuration.

    Raises
    ------
    UnknownNameError, ConfigError
    """
    if world not in WORLDS:
        raise UnknownNameError("world", world, WORLDS)
    make, default = WORLDS[world]
    return make(preset or default, seed, **changes)
