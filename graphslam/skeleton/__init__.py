"""Skeleton networks: measurement nodes collapsed into landmarks, landmarks integrated out, poses relaxed."""

from graphslam.core.face import face

_FACE = {
    "preconditioner": "Levels",
    "relax": "RelaxConfig",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
