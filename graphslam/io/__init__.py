"""Storey 4: one reader or writer a file format, and the data-set catalogue."""

from graphslam.core.face import face

_FACE = {
    "cards": "card",
    "notebook": "load_or_stop",
    "catalog": "load",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
