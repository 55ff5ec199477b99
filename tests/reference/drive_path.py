"""Path of a robot that drives through a world."""

from __future__ import annotations

from graphslam.core.trajectory import Trajectory
from graphslam.sim.drive import DriveConfig, drive_motion
from graphslam.sim.raycast import RayCaster
from graphslam.sim.world import World


def drive_through_world(world: World, config: DriveConfig | None = None, caster: RayCaster | None = None) -> Trajectory:
    """Drive through a world: ``T_world_base(t)``, the base on the floor between the wheels.

    Straight lines and arcs over the waypoints, smoothed over the wheelbase; from rest to rest, more slowly where the
    way turns sharply. Pitch follows the way; roll follows the floor where a ray caster shows it.

    Parameters
    ----------
    caster : RayCaster, optional
        Of the world's mesh.

    Returns
    -------
    Trajectory
        In the frame of the world, ``config.rate`` poses a second.
    """
    return drive_motion(world, config or DriveConfig(), caster).trajectory()
