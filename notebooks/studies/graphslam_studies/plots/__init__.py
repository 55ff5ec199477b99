"""Figures of studies and tutorials: data in, Axes out."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "gap": "plot_convergence plot_gap_along plot_tree_gap",
    "segslam_study": "plot_by_particles",
    "study_growth": "plot_growth_panels",
    "study_local": "plot_local_consistency",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
