"""Storey 3: classical submap joiners (EIF in sequence and by binary tree, EKF) and landmark association."""

from graphslam.core.face import face

_FACE = {
    "registry": "join",
    "online": "RelinearisationPolicy join_online",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
