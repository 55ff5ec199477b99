"""Layer 6: simulated worlds, vehicles and sensors with known noise and ground truth."""

from graphslam.core.face import face

_FACE = {
    "mesh_worlds": "mesh_world",
    "crawler": "simulate_crawler",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
