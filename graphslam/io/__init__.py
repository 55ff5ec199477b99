"""Layer 6: readers and writers, one file format each, and the catalogue of data sets."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "cards": "find_card",
    "catalog": "load_recording",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
