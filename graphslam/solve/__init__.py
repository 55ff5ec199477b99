"""Layer 4: incremental and batch solvers of factor graphs and pose networks."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "batch": "BatchSolver",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
