"""Layer 8: submaps and sensor streams in, a solved graph out. Reads and writes no files."""

from graphslam.core.face import face

_FACE = {
    "config": "BackEndConfig",
    "hypotheses": "choices_of_matches solve_choice",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
