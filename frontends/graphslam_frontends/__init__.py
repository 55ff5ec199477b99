"""Layer 2: front ends: sensor data in, submaps out. Imports no gtsam."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "odometry.make_steps": "make_steps",
    "detectors.trees": "TreeDetectorConfig detect_trees",
    "grid.config": "GridFilterConfig",
    "grid.filter": "GridFilter",
    "segslam.segslam": "run_segslam",
    "segslam.config": "HandoverConfig",
    "segslam.front_end": "submaps_of_best_particle",
    "segslam.submaps": "exits_of_interval common_ancestor_chain",
    "segslam.sampling": "grow_sample root_of_segment",
    "lidar_odometry.config": "LidarOdometryConfig",
    "lidar_odometry.odometry": "LidarOdometry",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
