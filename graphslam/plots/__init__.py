"""Layer 8: figures: data in, matplotlib axes out."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "comparison": "comparison_figure plot_comparison",
    "consistency": "plot_consistency",
    "evidence": "plot_heights plot_section plot_sharing",
    "fused_map": "plot_cut plot_storey",
    "gps": "plot_gps_vectors",
    "knobs": "knob",
    "local_map": "plot_correlation plot_local_map",
    "map": "plot_ellipses plot_map",
    "method_maps": "plot_method_maps",
    "particles": "plot_ancestry plot_exit plot_exit_panels plot_handovers plot_histories plot_lineage plot_pasts",
    "paths": "plot_paths",
    "refined": "plot_before_after",
    "reports": "plot_report plot_submap_chi2",
    "scans": "plot_scan",
    "segment_exits": "plot_exit_nees plot_segment_exit",
    "segmap": "plot_expansion plot_score_map plot_segmap",
    "segments": "plot_entropies plot_samples plot_scores plot_segments sample_paths",
    "solid": "plot_cloud plot_solid",
    "style": "NAMES use_palette",
    "submaps": "plot_submap_chain",
    "surface": "plot_surface",
    "terrain": "plot_bands plot_terrain",
    "trajectory": "plot_gps_residuals",
    "residual_consistency": "plot_innovations plot_loop_matrix",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
