"""Layer 7: accuracy (ATE, RPE) and consistency (NEES, consistency index), with and without ground truth."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "consistency": "Consistency nees pose_error",
    "check_points": "power_of_test",
    "gps": "gps_residuals move_to_gps_frame",
    "gps_repeatability": "fix_segments",
    "dead_reckoning_baseline": "dead_reckoned_path",
    "trajectory_error": "ate fit_alignment",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
