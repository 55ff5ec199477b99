"""Layer 8: from submaps and sensor streams to a solved graph. Reads and writes no files."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "back_end": "Observer",
    "config": "BackEndConfig",
    "hypotheses": "choices_of_matches solve_choice",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
