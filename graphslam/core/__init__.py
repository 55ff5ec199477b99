"""Layer 0: geometry, Gaussians, sensor records, the submap, configuration and errors. Imports no other layer."""

from graphslam.core.face import face

_FACE = {
    "random": "SeedTree",
    "poses": "SE3 group_of heading_of level",
    "geometry": "wrap_angle",
    "se3": "align_se3 se3_transform",
    "gaussian": "chi2_mean_bounds chi2_quantile",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
