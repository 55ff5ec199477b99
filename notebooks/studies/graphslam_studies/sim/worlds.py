"""Worlds that plug in."""

from __future__ import annotations

from typing import Any

from graphslam.core.log import SensorLog
from graphslam.sim.mesh_worlds import MeshWorld

MINE = MeshWorld("graphslam_studies.sim.mine", "mine", ("once", "twice"))
BUILDING = MeshWorld("graphslam_studies.sim.building", "building", ("usual",))


def point_field(preset: str | None, seed: int, changes: dict[str, Any]) -> SensorLog:
    """A flight through identified points."""
    from graphslam_studies.sim.point_field import point_field_preset, simulate_point_field

    return simulate_point_field(point_field_preset(preset or "flight", **changes), seed)
