"""Terrain tables learnt from maps, and paths of a vehicle over a cost map."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "plan": "plan_vehicle_path",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
