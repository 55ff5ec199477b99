"""Simulated worlds and sensors that only studies and tutorials use, truth included."""

from graphslam.core.face import face

_FACE = {
    "lidar": "LidarConfig simulate_lidar",
    "laps": "LapsConfig draw_laps",
    "street": "StreetRobot draw_street drive_street",
    "street_rover": "Command RoverState StreetRover",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
