"""Layer 6: simulated worlds, vehicles and sensors with known noise and ground truth."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "mesh_worlds": "mesh_world",
    "crawler": "simulate_crawler",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
