"""Simulated worlds by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphslam.core.atomic import check_file_target
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
"""Entry points of worlds: a :class:`~graphslam.sim.mesh_worlds.MeshWorld`, or a function as in :data:`WORLDS`; if its
logs have a mesh, it also has ``world_of(log)``."""


def _landmark_field(preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
    from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field

    return simulate_landmark_field(landmark_field_preset(preset or "A", **_with_layout_seed(changes)), seed)


def _mixed(preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
    from graphslam.sim.mixed import mixed_preset, simulate_mixed

    return simulate_mixed(mixed_preset(preset or "full", **_with_layout_seed(changes)), seed)


def _with_layout_seed(changes: dict[str, Any]) -> dict[str, Any]:
    return {("layout_seed" if name == "world_seed" else name): value for name, value in changes.items()}


# name -> function that simulates it from a preset, a seed and changed values
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
    """Simulate a world, with ground truth.

    Parameters
    ----------
    world : str
        ``mixed``: a building in a park, planar, with every kind of sensor; ``landmark-field``; ``garage``; ``court``, a
        small one. From the studies: ``point-field``, 3-D landmarks; ``mine``, ``building``; ``campus``.
    seed : int
        Of all errors, and of movable objects in the world.
    preset : str, optional
        Of the landmark field: ``A``, ``B``, ``C``, ``demo``, ``quick``; with ambiguous association: ``clutter``,
        ``pairs``, ``rows`` and ``hard``. Of the point field: ``flight``, ``drift``, ``quick``. Of the campus: ``full``,
        ``three-blocks``, ``block``, ``quick``. Of the mixed world: ``full``, ``quick``. Of the robot in the other
        worlds: ``light``, ``full``, ``two-scanners``.
    layout : str, optional
        Of the garage: ``A``, ``B``, ``C`` or ``D``. Of the mine: ``once`` or ``twice`` round. ``drawn-17``: a random
        plan of the garage, or random walls of the mine or of the building, with that number as seed.
    world_seed : int, optional
        Of the layout, or of movable objects, if other than ``seed``.
    progress : bool
        Show a progress bar on stderr.
    **changes
        Any value of the configuration of the world or the robot.

    Returns
    -------
    SensorLog
        With ground truth, in the frame of the first base [m, rad].

    Raises
    ------
    UnknownNameError, ConfigError

    Examples
    --------
    >>> gs.simulate("landmark-field", preset="quick", seed=1)
    SensorLog('landmark-field': controls (2080), landmarks (260); truth known)
    """
    for name, value in (("seed", seed), ("world_seed", world_seed)):
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 0):
            raise ConfigError(f"{name} = {value}; wanted a whole number ≥ 0")
    made = _made_by(world)
    if not isinstance(made, MeshWorld):
        if layout is not None:
            raise ConfigError(f"world {world!r} has no layouts: leave {layout!r} out")
        log: SensorLog = made(preset, seed, changes if world_seed is None else {**changes, "world_seed": world_seed})
        return log
    from graphslam.sim.crawler import crawler_preset, simulate_crawler

    moved = seed if world_seed is None else world_seed
    config = crawler_preset(preset or "light", **changes)
    log = simulate_crawler(mesh_world(world, layout=layout, seed=moved), seed, config, progress=progress)
    return replace(log, meta={**log.meta, "made_with": {"name": world, "layout": layout, "seed": moved}})


def _made_by(world: str) -> Any:
    return WORLDS.get(world) or MESH_WORLDS.get(world) or load_plugin(GROUP, "world", world, [*WORLDS, *MESH_WORLDS])


def world_of(log: SensorLog) -> World:
    """Make the world again in which a log of :func:`simulate` was recorded."""
    made = log.meta.get("made_with")
    if not isinstance(made, dict):
        raise ConfigError(f"log {log.name!r} does not say which world it was recorded in")
    by = _made_by(str(made.get("name")))
    if not isinstance(by, MeshWorld):
        world: World = by.world_of(log)
        return world
    return mesh_world(str(made.get("name")), layout=made.get("layout"), seed=int(made.get("seed", 0)))


def mesh_of(log: SensorLog) -> tuple[Array, Triangles]:
    """Mesh of the world of a log, in the frame of its ground truth: vertices ``(v, 3)`` [m], triangles ``(t, 3)``."""
    world = world_of(log)
    T_world_frame = log.meta["T_world_frame"]
    return se3_transform(se3_inverse(T_world_frame), world.vertices), world.triangles


def write_simulated(log: SensorLog, folder: str | Path) -> Path:
    """Write a log of :func:`simulate`, with the mesh of its world if it has one."""
    from graphslam.io.log_folder import write_log_folder

    return write_log_folder(log, folder, mesh=mesh_of(log) if "made_with" in log.meta else None)


SAMPLE_START = 1_767_225_600.0
"""Time of the first record of the sample log [s since 1970]: 2026-01-01."""


def write_sample(out: str | Path) -> tuple[Path, Path]:
    """Write the sample log, an MCAP file of ROS 2, and beside it its true path: ``NAME-truth.tum``.

    A robot in a building in a park, with laser, wheels, IMU and GPS: 212 s, 248 m. Nothing is downloaded; the bytes are
    the same each time.

    Raises
    ------
    MissingExtraError
        The extra ``ros`` is not installed.
    """
    from graphslam.core.trajectory import Trajectory
    from graphslam.io.bag_log import log_records
    from graphslam.io.bag_writer import MessageFactory, write_bag
    from graphslam.io.tum import write_tum

    bag = check_file_target(out)
    truth = check_file_target(bag.with_name(f"{bag.stem}-truth.tum"))
    factory = MessageFactory()
    log = simulate("mixed", preset="quick", seed=1)
    assert log.truth is not None
    assert log.truth.trajectory is not None
    path = log.truth.trajectory
    write_bag(bag, log_records(log, factory, start=SAMPLE_START, origin=(0.0, 0.0)), "mcap", factory)
    write_tum(truth, Trajectory(path.times[::5] + SAMPLE_START, path.poses[::5]))  # at the rate of the wheels
    return bag, truth
