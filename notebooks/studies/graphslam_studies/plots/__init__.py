"""Figures of studies and tutorials: data in, Axes out."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "comparison": "plot_comparison",
    "evidence": "plot_sharing shared_bricks",
    "gap": "plot_convergence plot_gap_along plot_tree_gap",
    "gps": "plot_gps_vectors",
    "setting_plots": "plot_settings",
    "local_map": "plot_correlation plot_local_map",
    "method_maps": "plot_method_maps",
    "particles": "plot_ancestry plot_exit plot_exit_panels plot_handovers plot_histories plot_lineage plot_pasts",
    "reports": "plot_report plot_submap_chi2",
    "scans": "plot_scan",
    "segment_exits": "plot_exit_nees plot_segment_exit",
    "segments": "plot_entropies plot_samples plot_scores sample_paths",
    "segmap": "plot_expansion plot_score_map plot_segmap",
    "segslam_study": "plot_by_particles",
    "solid": "plot_cloud plot_solid",
    "study_growth": "plot_growth_panels",
    "study_local": "plot_local_consistency",
    "terrain": "plot_bands",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
