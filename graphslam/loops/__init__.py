"""Layer 5: loop closures between submaps and between sessions: candidates, gates, consistency, ledger."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "find_loops": "FindConfig",
    "measure": "Loop",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
