"""Triangle-mesh worlds by name."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from graphslam.core.errors import ConfigError, GraphSlamError, UnknownNameError
from graphslam.core.plugins import load_plugin
from graphslam.sim.world import DRAWN, World, layout_number


@dataclass(frozen=True, slots=True)
class MeshWorld:
    """A triangle-mesh world that a robot drives through.

    Parameters
    ----------
    module, function : str
        Function that builds it; imported when used.
    layouts : tuple of str
        Named layouts, the default first; empty if there is only one. If not empty, others are generated: ``drawn-17``
        from that number.
    """

    module: str
    function: str
    layouts: tuple[str, ...] = ()

    def build(self, name: str, layout: str | None, seed: int) -> World:
        """The world; the seed determines its movable objects."""
        if layout is not None and layout not in self.layouts and not (self.layouts and layout_number(layout)):
            if not self.layouts:
                raise ConfigError(f"world {name!r} has one layout only: leave {layout!r} out")
            raise UnknownNameError(f"layout of world {name!r}", layout, (*self.layouts, f"{DRAWN}N"))
        try:
            make = getattr(importlib.import_module(self.module), self.function)
        except ImportError as error:
            raise GraphSlamError(f"world {name!r} cannot be imported ({error})") from error
        world: World = make(layout or self.layouts[0], seed=seed) if self.layouts else make(seed=seed)
        return world


MESH_WORLDS: dict[str, MeshWorld] = {
    "garage": MeshWorld("graphslam.sim.garage", "garage", ("A", "B", "C", "D")),
    "court": MeshWorld("graphslam.sim.ring_hall", "ring_hall"),
}


def mesh_world(name: str, *, layout: str | None = None, seed: int = 0) -> World:
    """A triangle-mesh world by name.

    Parameters
    ----------
    name : str
        ``garage``, ``court``, or a world of a plug-in (group ``graphslam.worlds``) such as ``mine`` or ``building``.
    layout : str, optional
        Of the garage: ``A``, ``B``, ``C`` or ``D``. Of the mine: ``once`` or ``twice`` round. Of these and of the
        building: ``drawn-17``, generated from that number.
    seed : int
        Of its movable objects.
    """
    found = MESH_WORLDS[name] if name in MESH_WORLDS else load_plugin("graphslam.worlds", "world", name, MESH_WORLDS)
    if not isinstance(found, MeshWorld):
        raise UnknownNameError("world of triangles", name, MESH_WORLDS)
    return found.build(name, layout, seed)
