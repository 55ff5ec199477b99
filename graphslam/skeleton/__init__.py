"""Layer 4: skeleton networks: landmarks are integrated out, the pose network is relaxed (urban GraphSLAM)."""

from graphslam.core.face import face

_FACE = {
    "preconditioner": "Levels",
    "relax": "RelaxConfig",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
