"""Layer 6: readers and writers, one file format each, and the catalogue of data sets."""

from graphslam.core.face import face

_FACE = {
    "cards": "card",
    "notebook": "load_or_stop",
    "catalog": "load",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
