"""Layer 1: evidence grids, i.e. occupancy maps in log-odds with copy-on-write (SegSLAM, section 2)."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "grid": "EvidenceGrid",
    "batch": "update_grids",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
