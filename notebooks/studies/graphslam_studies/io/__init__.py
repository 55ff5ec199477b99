"""Readers of single data sets."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "notebook": "load_or_stop",
    "victoria_park_published": "match_observations",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
