"""Layer 8: figures, from data to matplotlib axes."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "comparison": "comparison_figure",
    "consistency": "plot_consistency",
    "evidence": "plot_heights plot_section",
    "fused_map": "plot_cut plot_storey",
    "map": "plot_ellipses plot_map",
    "paths": "plot_paths",
    "refined": "plot_before_after",
    "segments": "plot_segments",
    "style": "NAMES use_palette",
    "submaps": "plot_submap_chain",
    "surface": "plot_surface",
    "terrain": "plot_terrain",
    "trajectory": "plot_gps_residuals",
    "residual_consistency": "plot_innovations plot_loop_matrix",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
