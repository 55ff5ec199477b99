"""Worlds that plug in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from graphslam.core.log import SensorLog
from graphslam.sim.mesh_worlds import MeshWorld
from graphslam.sim.world import World

MINE = MeshWorld("graphslam_studies.sim.mine", "mine", ("once", "twice"))
BUILDING = MeshWorld("graphslam_studies.sim.building", "building", ("usual",))


def point_field(preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
    """A flight through identified points."""
    from graphslam_studies.sim.point_field import point_field_preset, simulate_point_field

    return simulate_point_field(point_field_preset(preset or "flight", **changes), seed)


class CampusWorld:
    """Streets and buildings, with a robot of their own (:mod:`graphslam_studies.sim.campus`)."""

    def __call__(self, preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
        """A session; ``world_seed`` among the changes is that of the place."""
        from graphslam_studies.sim.campus import simulate_campus
        from graphslam_studies.sim.campus_config import campus_preset

        changes = dict(changes)
        place = changes.pop("world_seed", seed)
        log = simulate_campus(campus_preset(preset or "full", **changes), seed, world_seed=place)
        return replace(log, meta={**log.meta, "made_with": {"name": "campus", "seed": place}})

    def world_of(self, log: SensorLog) -> World:
        """The campus that a log was recorded on, made again."""
        from graphslam_studies.sim.campus_config import campus_preset
        from graphslam_studies.sim.campus_world import campus

        return campus(campus_preset(**log.meta["config"]), seed=int(log.meta["made_with"]["seed"]))


CAMPUS = CampusWorld()
