"""Evaluation that only studies use: end poses of SegSLAM, map joining against the optimum, submaps, tables."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "gap": "gap_along gap_by_tree polish_history pose_consistency_along",
    "gps_repeatability": "revisit_disagreement segment_table",
    "segslam_judge": "dead_reckoned exit_errors fused_grid match_errors path_errors relative",
    "submap_consistency": "submap_nees submaps_consistency",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
