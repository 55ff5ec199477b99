"""Trials, executors and folders of Monte-Carlo studies."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "trials": "trial_seed",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
