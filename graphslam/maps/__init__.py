"""Layer 6: global maps: pieces of submaps, fused at the poses of the graph."""

from graphslam.core.lazy_exports import lazy_exports

_EXPORTS = {
    "run_map": "make_run_map nodes_by_submap solved_poses",
    "alternatives": "Alternative rank_alternatives",
    "minimum_entropy": "MapHypothesis",
    "terrain.lines": "lines_of_scans",
    "terrain.plan": "CostConfig cost_map",
    "terrain.pyramid": "Pyramid",
    "terrain.tables": "TerrainWeights fixed_tables read_tables",
    "terrain.vehicle": "CELLS LineSensor Vehicle",
    "surface.layer": "SurfaceLayer",
    "surface.mesh": "position_sigma zero_set",
    "surface.piece": "SurfaceConfig",
}
__getattr__, __dir__, __all__ = lazy_exports(__name__, _EXPORTS)
