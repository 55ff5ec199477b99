"""Layer 1: evidence grids, log-odds maps of occupied and free space with copy on write (SegSLAM, section 2)."""

from graphslam.core.face import face

_FACE = {
    "grid": "EvidenceGrid",
    "memory": "shared_bricks",
    "batch": "update_grids",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
