"""Layer 5: map joining: extended information filters in sequence and by binary tree, and an EKF."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "registry": "join_by_method",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
