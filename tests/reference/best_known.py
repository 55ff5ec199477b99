"""Best-known objectives ``Σ rᵀ Ω r`` (GTSAM's residual, no ½) of the recorded pose networks.

docs/notes/pose-graphs.md describes how each was established.
"""

from __future__ import annotations

W20000_AS_COVARIANCE = 37.5267021485
"""That of w20000 with the noise columns read as GTSAM reads them."""
# folder/file -> objective
BEST_KNOWN: dict[str, float] = {
    "posegraphs/input_INTEL_g2o.g2o.xz": 215.838121148,
    "posegraphs/input_M3500_g2o.g2o.xz": 137.914878247,
    "posegraphs/intel.g2o.xz": 45.0042330879,
    "posegraphs/kitti_00.g2o.xz": 98.3221382304,
    "posegraphs/kitti_02.g2o.xz": 78.764623393,
    "posegraphs/kitti_06.g2o.xz": 25.9469673146,
    "posegraphs/kitti_07.g2o.xz": 12.6610360735,
    "posegraphs/manhattan.g2o.xz": 3549.04107006,
    "posegraphs/parking-garage.g2o.xz": 1.26838479927,
    "posegraphs/smallGrid3D.g2o.xz": 1035.85066472,
    "posegraphs/sphere2500.g2o.xz": 1351.40192585,
    "posegraphs/sphere_bignoise_vertex3.g2o.xz": 2988337.51053,
    "posegraphs/w20000.txt.xz": 1546.38022124,
    "victoria_park_graph/victoria_park.txt.gz": 4678.43908448,
}
# The files small enough to be solved by every solver within seconds.
SMALL = (
    "posegraphs/intel.g2o.xz",
    "posegraphs/kitti_06.g2o.xz",
    "posegraphs/kitti_07.g2o.xz",
    "posegraphs/smallGrid3D.g2o.xz",
)
