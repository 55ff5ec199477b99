"""Layer 5: map joining: extended information filters in sequence and by binary tree, and an EKF."""

from graphslam.core.face import face

_FACE = {
    "registry": "join",
    "online": "RelinearisationPolicy join_online",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
