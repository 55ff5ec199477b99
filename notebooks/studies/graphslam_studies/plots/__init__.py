"""Figures of studies and tutorials: data in, Axes out."""

from graphslam.core.face import face

_FACE = {
    "gap": "plot_convergence plot_gap_along plot_tree_gap",
    "segslam_study": "plot_by_particles",
    "study_growth": "plot_growth_panels",
    "study_local": "plot_local_honesty",
}
__getattr__, __dir__, __all__ = face(__name__, _FACE)
