"""Layer 0: geometry, Gaussians, sensor records, the submap, configuration and errors. Imports no other layer."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "random": "SeedTree",
    "poses": "SE3 group_of heading_of remove_roll_pitch",
    "geometry": "wrap_angle",
    "se3": "align_se3 se3_transform",
    "gaussian": "chi2_mean_bounds chi2_quantile",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
