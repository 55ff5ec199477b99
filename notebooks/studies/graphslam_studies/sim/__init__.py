"""Simulated worlds and sensors that only studies and tutorials use, truth included."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "lidar": "LidarConfig simulate_lidar",
    "laps": "LapsConfig draw_laps",
    "street": "StreetRobot draw_street drive_street",
    "street_rover": "Command RoverState StreetRover",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
