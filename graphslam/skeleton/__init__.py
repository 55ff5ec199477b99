"""Layer 4: skeleton networks: landmarks are marginalised out, the pose network is optimised (urban GraphSLAM)."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "preconditioner": "PreconditionerLevels",
    "relax": "RelaxConfig",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
