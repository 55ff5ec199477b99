"""Layer 6: simulated worlds, vehicles and sensors with known noise and ground truth."""

from graphslam.core.face import face

_FACE = {
    "mesh_worlds": "mesh_world",
    "crawler": "simulate_crawler",
    "lidar": "LidarConfig simulate_lidar",
    "laps": "LapsConfig draw_laps",
    "street": "StreetRobot draw_street drive_street",
    "street_rover": "Command RoverState StreetRover",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
