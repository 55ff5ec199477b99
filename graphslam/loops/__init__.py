"""Layer 5: loop closures between submaps and between sessions: candidates, gates, consistency, ledger."""

from graphslam.core.face import face

_FACE = {
    "find_loops": "FindConfig",
    "measure": "Loop",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
