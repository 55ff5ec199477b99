"""Methods to compare with: all poses and landmarks at once, links between poses, an online sequence of joins."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {"online": "RelinearisationPolicy join_online"}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
