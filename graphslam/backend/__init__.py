"""Submaps and streams in, a solved graph out, submap by submap; no files, and no words for the terminal."""

from graphslam.core.face import face

_FACE = {
    "config": "BackEndConfig",
    "hypotheses": "choices_of_matches solve_choice",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
