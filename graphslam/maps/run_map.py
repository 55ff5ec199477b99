"""The fused map of a run: pieces of submaps at the solved poses of the graph's nodes. No scan is read."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import MAX_LEVELS, half_edge
from graphslam.evidence.views import dense_view, has_dense_view
from graphslam.maps.clouds import fused_points
from graphslam.maps.coarse import coarse_piece
from graphslam.maps.contradictions import NOTHING, Contradictions, find_contradictions
from graphslam.maps.export import storeys
from graphslam.maps.fuse import FusedMap, fuse_pieces, reach_of
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.moving import static_submaps
from graphslam.maps.pieces import DivisionConfig, PieceId
from graphslam.maps.submaps import DividedSubmaps, divide_submaps


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MapConfig:
    """The fused map at the end of a run of dense submaps."""

    fuse: bool = True
    """Make the fused map."""
    low: float = 0.3
    """Floor plans begin this far above the path [m] …"""
    high: float = 1.8
    """… and end this far above it."""
    threads: int = 1
    """Threads for resampling the pieces; they do not change the map."""

    def __post_init__(self) -> None:
        if not self.high > self.low:
            raise ConfigError(f"map: floor plans from {self.low} to {self.high} m; wanted low < high")
        check_options(self, "map.", {"≥ 1": "threads"})


REACH_MARGIN = 1.0
"""Added to the sensor range [m]; voxels farther from the path were not observed."""


MOST_TILT = 0.1
"""If a base has a larger tilt [rad], the front end does not level its bases, and the nodes are used unchanged."""


@dataclass(frozen=True)
class RunMap:
    """The fused map of a run.

    Parameters
    ----------
    fused : FusedMap
        Pieces at the solved poses.
    divided : DividedSubmaps
        The pieces, and their poses along the chain of exits, before the solution.
    bands : mapping of str to (low, high)
        Height bands of the floor plans, one per floor of the path [m]; empty in 2-D.
    divide_s, fuse_s : float
        Seconds to divide the submaps into pieces, and to fuse these at the solved poses.
    points : (n, dim) or None
        Of the submaps' clouds at the solved poses [m]; None without clouds.
    passes : Contradictions
        Contradictions between submaps that reached the same place along different paths.
    moving : (int, int)
        Removed cloud points on moving objects, and all points.
    coarsened : int
        Edge of the map's voxels over that of the submaps: 1 unless the map is too large for a pool.
    knows_space : bool
        False if a submap has no free space: entropies and volumes are then of surfaces only.
    """

    fused: FusedMap
    divided: DividedSubmaps
    bands: Mapping[str, tuple[float, float]]
    divide_s: float
    fuse_s: float
    points: Array | None = None
    knows_space: bool = True
    coarsened: int = 1
    passes: Contradictions = NOTHING
    moving: tuple[int, int] = (0, 0)

    def coarse_note(self) -> str:
        """Message if the map was coarsened; otherwise empty."""
        if self.coarsened == 1:
            return ""
        size = self.fused.voxel_size
        return (
            f"The fused map is too wide for the voxels of its submaps: its own are of {size:g} m, {self.coarsened} ×."
        )

    def facts(self) -> dict[str, Any]:
        """Entries of ``fused_map.json``."""
        f = self.fused
        clouds = {} if self.points is None else {"points": len(self.points), "free_space_known": self.knows_space}
        return {
            "format": "graphslam.fused-map/1",
            "dim": f.dim,
            "voxel_size": f.voxel_size,
            "pieces": len(f),
            "entropy": f.entropy(),
            "known_volume": f.known_volume(),
            "level_nodes": self.divided.level_nodes,
            "bands": {name: list(band) for name, band in self.bands.items()},
            "bytes": f.nbytes,
            "passes": self.passes.facts(),
            **clouds,
        }

    def metrics(self) -> list[tuple[str, float, str, str]]:
        """Key, value, unit and better direction of its metrics, for ``metrics.json``."""
        f = self.fused
        unit = "m³" if f.dim == 3 else "m²"
        seconds = (("divide", self.divide_s), ("fuse", self.fuse_s))
        contradicted = self.passes.share
        return [
            ("map_entropy", f.entropy(), f"nat {unit}", "lower"),
            ("map_known_volume", f.known_volume(), unit, "none"),
            *((("map_contradicted", contradicted, "", "lower"),) if contradicted is not None else ()),
            ("map_pieces", len(f), "", "none"),
            ("map_megabytes", f.nbytes / 1e6, "MB", "lower"),
            *((f"map_{name}_seconds", value, "s", "lower") for name, value in seconds),
        ]


def has_maps(submaps: Sequence[Submap]) -> bool:
    """Whether any submap has a dense map (evidence grid or cloud); in a mixed run some have landmarks only."""
    return any(has_dense_view(s) for s in submaps)


def nodes_by_submap(submaps: Sequence[Submap], m: GlobalMap) -> dict[int, tuple[Array, Array]]:
    """Times ``(k,)`` and solved poses ``(k, 3|7)`` of each submap's nodes, the base first, without the exit."""
    bases = np.arange(len(m.node_poses)) if m.base_nodes is None else m.base_nodes
    if len(bases) != len(submaps) + 1:
        raise DataError("the solved nodes are not those of the submaps", got=len(bases) - 1, wanted=len(submaps))
    return {s.key: (m.node_times[a:b], m.node_poses[a:b]) for s, a, b in zip(submaps, bases, bases[1:])}


def solved_poses(divided: DividedSubmaps, nodes: Mapping[int, tuple[Array, Array]]) -> dict[PieceId, Array]:
    """``T_world_node`` of every piece from the graph's nodes; levelled if the pieces are."""
    out: dict[PieceId, Array] = {}
    for name in divided.pieces:
        assert isinstance(name, tuple)
        T = nodes[name[0]][1][name[1]]
        out[name] = remove_roll_pitch(T) if divided.level_nodes else T
    return out


def make_run_map(
    submaps: Sequence[Submap], m: GlobalMap, *, reach: float | None = None, config: MapConfig | None = None
) -> RunMap:
    """Fuse the maps of a run's submaps at the solved poses.

    Moving objects are removed (:func:`~graphslam.maps.moving.static_submaps`).

    Parameters
    ----------
    submaps : sequence of Submap
        With dense maps and paths; submaps with landmarks only are ignored.
    m : GlobalMap
        Solved.
    reach : float, optional
        Sensor range [m].
    config : MapConfig, optional
        Heights of the floor plans, number of threads.
    """
    config = MapConfig() if config is None else config
    if not has_maps(submaps):
        raise MissingDataError(
            "submaps have no evidence grids or clouds to make a map of",
            got=f"{len(submaps)} submaps without",
            wanted="a run of a front end with dense maps: segslam, scan-window, lidar-odometry, rbpf-grid",
        )
    nodes = nodes_by_submap(submaps, m)
    division = DivisionConfig() if reach is None else DivisionConfig(reach=reach + REACH_MARGIN)
    level_nodes = m.dim == 3 and _levelled(m.base_poses)
    begin = time.perf_counter()
    submaps, moving = static_submaps(submaps, m.base_poses[:-1])
    divided = divide_submaps(
        [_one_piece(s, nodes) for s in submaps],
        every=None,
        config=division,
        level_nodes=level_nodes,
        nodes={key: times for key, (times, _) in nodes.items()},
    )
    divide_s, begin = time.perf_counter() - begin, time.perf_counter()
    dense = [s for s in submaps if has_dense_view(s)]
    grid = dense[0].grid
    model = grid.model if isinstance(grid, EvidenceGrid) else None
    at = solved_poses(divided, nodes)
    divided, coarsened = _held(divided, at)
    fused = fuse_pieces(divided.pieces, at, model=model, threads=config.threads)
    fused.release_scratch()
    points = fused_points(submaps, nodes, level_nodes=level_nodes, config=division)
    fuse_s = time.perf_counter() - begin
    knows_space = all(dense_view(s).knows_space for s in dense)
    bands = floor_bands(m.trajectory.positions, config) if m.dim == 3 else {}
    return RunMap(
        fused,
        divided,
        bands,
        divide_s,
        fuse_s,
        points,
        knows_space,
        coarsened,
        find_contradictions(divided.pieces, at, model),
        moving,
    )


def _held(divided: DividedSubmaps, at: Mapping[PieceId, Array]) -> tuple[DividedSubmaps, int]:
    """Pieces coarsened until they fit into the largest pool at ``at``, and the factor."""
    coarsened, pieces = 1, divided.pieces
    while max(reach_of(p, at[n]) for n, p in pieces.items()) > half_edge(MAX_LEVELS):
        coarsened, pieces = 2 * coarsened, {n: coarse_piece(p) for n, p in pieces.items()}
    return dataclasses.replace(divided, pieces=pieces), coarsened


def floor_bands(positions: Array, config: MapConfig) -> dict[str, tuple[float, float]]:
    """Height band of the floor plan of every floor of a path ``(n, 3)`` [m]; of its median height if it has none."""
    heights = storeys(positions) or [float(np.median(positions[:, 2]))]
    return {f"level{k}": (z + config.low, z + config.high) for k, z in enumerate(heights)}


def _one_piece(s: Submap, nodes: Mapping[int, tuple[Array, Array]]) -> Submap:
    """Check that a submap with several nodes has a path."""
    if s.trajectory is None and len(nodes[s.key][0]) > 1:
        raise DataError(f"submap {s.key} has nodes but no path", wanted="a trajectory")
    return s


def _levelled(bases: Array) -> bool:
    """Whether all bases ``(k, 7)`` are nearly level (:data:`MOST_TILT`)."""
    group = group_of(bases)
    lean = group.log(group.between(remove_roll_pitch(bases), bases))[:, :2]
    return bool(np.all(np.linalg.norm(lean, axis=1) < MOST_TILT))
