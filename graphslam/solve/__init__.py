"""Layer 4: incremental and batch solvers of factor graphs and pose networks."""

from graphslam.core.face import face

_FACE = {
    "batch": "BatchSolver",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
