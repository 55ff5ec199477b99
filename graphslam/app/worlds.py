"""Simulated worlds by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphslam.core.errors import ConfigError
from graphslam.core.log import SensorLog
from graphslam.core.plugins import load_plugin
from graphslam.core.se3 import se3_inverse, se3_transform
from graphslam.sim.mesh_worlds import MESH_WORLDS as MESH_WORLDS
from graphslam.sim.mesh_worlds import MeshWorld
from graphslam.sim.mesh_worlds import mesh_world as mesh_world

if TYPE_CHECKING:
    from graphslam.core.geometry import Array
    from graphslam.core.mesh import Triangles
    from graphslam.sim.world import World


GROUP = "graphslam.worlds"
"""Entry points of worlds: a :class:`~graphslam.sim.mesh_worlds.MeshWorld`, or a function as in :data:`WORLDS`."""
CAMPUS = "campus"
"""Streets and buildings, with a robot of their own (:mod:`graphslam.sim.campus`)."""


def _landmark_field(preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
    from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field

    return simulate_landmark_field(landmark_field_preset(preset or "A", **changes), seed)


def _mixed(preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
    from graphslam.sim.mixed import mixed_preset, simulate_mixed

    return simulate_mixed(mixed_preset(preset or "full", **changes), seed)


# name -> what simulates it from a preset, a seed and changed figures
WORLDS: dict[str, Callable[[str | None, int, dict[str, Any]], SensorLog]] = {
    "landmark-field": _landmark_field,
    "mixed": _mixed,
}


def simulate(
    world: str,
    *,
    seed: int = 0,
    preset: str | None = None,
    layout: str | None = None,
    world_seed: int | None = None,
    progress: bool = False,
    **changes: Any,
) -> SensorLog:
    """Simulate a world, truth included.

    Parameters
    ----------
    world : str
        ``landmark-field``; ``point-field``, landmarks in space; ``garage``, ``mine``, ``building``; ``court``, the
        small one; ``campus``; ``mixed``, a building in a park, in the plane, with every kind of sensor.
    seed : int
        Of every error, and of what can be moved in the world.
    preset : str, optional
        Of the landmark field: ``A``, ``B``, ``C``, ``demo``, ``quick``; ``clutter``, ``pairs``, ``rows`` and ``hard``
        confuse an association. Of the point field: ``flight``, ``drift``, ``quick``. Of the campus: ``full``,
        ``three-blocks``, ``block``, ``quick``. Of the mixed world: ``full``, ``quick``. Of the robot in the other
        worlds: ``light``, ``full``, ``two-scanners``.
    layout : str, optional
        Of the garage: ``A``, ``B``, ``C`` or ``D``. Of the mine: ``once`` or ``twice`` round. ``drawn-17``: a plan
        of the garage, or walls of the mine or of the building, drawn by that number.
    world_seed : int, optional
        Of what can be moved in a world of triangles, and of the campus, where it shall not be ``seed``.
    progress : bool
        Show a progress bar on stderr.
    **changes
        Any figure of the world's or the robot's configuration.

    Returns
    -------
    SensorLog
        With its truth, in the frame of the first base [m, rad].

    Raises
    ------
    UnknownNameError, ConfigError

    Examples
    --------
    >>> gs.simulate("landmark-field", preset="quick", seed=1)
    SensorLog('landmark-field': controls (2080), landmarks (260); truth known)
    """
    made: Any = WORLDS.get(world)
    if made is None and world not in MESH_WORLDS and world != CAMPUS:
        made = load_plugin(GROUP, "world", world, [*WORLDS, *MESH_WORLDS, CAMPUS])
    if made is not None and not isinstance(made, MeshWorld):
        if layout is not None or world_seed is not None:
            raise ConfigError(f"world {world!r} has neither layout nor world_seed")
        log: SensorLog = made(preset, seed, changes)
        return log
    moved = seed if world_seed is None else world_seed
    for name, value in (("seed", seed), ("world_seed", moved)):
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            raise ConfigError(f"{name} = {value}; wanted a whole number ≥ 0")
    if world == CAMPUS:
        return _campus(preset, seed, moved, changes, layout=layout, progress=progress)
    from graphslam.sim.crawler import crawler_preset, simulate_crawler

    config = crawler_preset(preset or "light", **changes)
    log = simulate_crawler(mesh_world(world, layout=layout, seed=moved), seed, config, progress=progress)
    return replace(log, meta={**log.meta, "made_with": {"name": world, "layout": layout, "seed": moved}})


def _campus(
    preset: str | None, seed: int, world_seed: int, changes: dict[str, Any], *, layout: str | None, progress: bool
) -> SensorLog:
    from graphslam.sim.campus import simulate_campus
    from graphslam.sim.campus_config import campus_preset

    if layout is not None:
        raise ConfigError(f"world {CAMPUS!r} has no layouts: leave {layout!r} out, and choose a size by its preset")
    log = simulate_campus(campus_preset(preset or "full", **changes), seed, world_seed=world_seed, progress=progress)
    return replace(log, meta={**log.meta, "made_with": {"name": CAMPUS, "seed": world_seed}})


def world_of(log: SensorLog) -> World:
    """The world that a log of :func:`simulate` was recorded in, made again."""
    made = log.meta.get("made_with")
    if not isinstance(made, dict):
        raise ConfigError(f"log {log.name!r} does not say which world it was recorded in")
    if made.get("name") == CAMPUS:
        from graphslam.sim.campus_config import campus_preset
        from graphslam.sim.campus_world import campus

        return campus(campus_preset(**log.meta["config"]), seed=int(made.get("seed", 0)))
    return mesh_world(str(made.get("name")), layout=made.get("layout"), seed=int(made.get("seed", 0)))


def mesh_of(log: SensorLog) -> tuple[Array, Triangles]:
    """Mesh of the world of a log, in the frame of its truth: vertices ``(v, 3)`` [m] and triangles ``(t, 3)``."""
    world = world_of(log)
    T_world_frame = log.meta["T_world_frame"]
    return se3_transform(se3_inverse(T_world_frame), world.vertices), world.triangles


def write_simulated(log: SensorLog, folder: str | Path) -> Path:
    """Write a log of :func:`simulate`, with the mesh of its world if it has one."""
    from graphslam.io.log_folder import write_log_folder

    return write_log_folder(log, folder, mesh=mesh_of(log) if "made_with" in log.meta else None)
