"""Evaluation that only studies use: joints of SegSLAM, joiners against the optimum, tables."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "gap": "gap_along gap_by_tree polish_history pose_consistency_along",
    "segslam_judge": "dead_reckoned exit_errors fused_grid match_errors path_errors relative",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
