"""Trials, executors and folders of Monte-Carlo studies."""

from graphslam.core.face import face

_FACE = {
    "trials": "trial_seed",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
