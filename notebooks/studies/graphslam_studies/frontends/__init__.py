"""Front ends with a single map over the whole log: baselines to compare submaps with."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "rbpf_grid": "run_rbpf",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
