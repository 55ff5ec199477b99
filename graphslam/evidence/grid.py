"""EvidenceGrid: a log-odds map of occupied and free space that copies in constant time.

This is the octree of SegSLAM (section 2) with deferred reference counting. A grid is a handle on a tree in a shared
pool. A copy shares the tree; a write copies only the nodes and bricks that it changes. So every particle of a filter
has its own map, resampled particles share unchanged parts, and a re-entered submap starts as a copy of its last map.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import write_npz
from graphslam.core.errors import GridError
from graphslam.core.geometry import Array
from graphslam.core.markup import html_element, join_parts, pair_list
from graphslam.evidence import contents, queries
from graphslam.evidence.batch import insert_scan, update_report, write_packed
from graphslam.evidence.compact import grid_pieces
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS
from graphslam.evidence.memory import MemoryUse, measure_memory
from graphslam.evidence.merge import merge_grids
from graphslam.evidence.scan import UpdateReport, pose_row, scan_rows
from graphslam.evidence.tree_kernels import gather_bricks

FORMAT = "graphslam.evidence/1"


class EvidenceGrid(GridTree):
    """A log-odds occupancy map, 3-D or 2-D, with O(1) copies.

    Voxel (i, j, k) covers ``[i v, (i + 1) v) × …`` in the grid frame, with voxel size v. A 2-D grid is the layer
    k = 0 of such a grid.

    Parameters
    ----------
    voxel_size : float
        Edge of a voxel [m].
    model : BeamModel, optional
    pool : GridPool, optional
        Storage shared with other grids; default: a new pool.
    dim : {3, 2}

    Examples
    --------
    >>> grid = EvidenceGrid(0.1)
    >>> report = grid.insert_scan([[2.0, 0.0, 0.0], [2.0, 0.5, 0.0]])
    >>> before = grid.copy()
    >>> report = grid.insert_scan([[2.0, 0.0, 0.0]])
    >>> float(before.values_at([[2.05, 0.05, 0.05]])[0]) < float(grid.values_at([[2.05, 0.05, 0.05]])[0])
    True
    """

    __slots__ = ()

    # --- writing ---------------------------------------------------------------------------------------------

    def insert_scan(
        self,
        points: Any,
        origin: Any = None,
        *,
        pose: Any = None,
        max_range: float | None = None,
        returns: Any = None,
    ) -> UpdateReport:
        """Insert beams with the beam model; each voxel is updated at most once per scan.

        Voxels from the origin up to, but not including, the end voxel get the miss update; the end voxel gets the hit
        update. If some beams end in a voxel and others cross it, it gets the hit update. Unusable beams are dropped
        and counted.

        Parameters
        ----------
        points : (n, 3) or (n, 2)
            End points of the beams in the scan frame [m].
        origin : (3,) or (n, 3), (2,) or (n, 2)
            Start points of the beams in the scan frame [m]; one per beam if the sensor moved. Default 0.
        pose : (7,), (4, 4), or (3,) in 2-D
            ``T_grid_scan``; default identity.
        max_range : float, optional
            Longer beams are cut at this range and mark free space only [m].
        returns : (n,) bool, optional
            False for a beam without a return: it marks free space up to its point. Default all True.
        """
        self.check_writable()
        scan = scan_rows(points, origin, returns, max_range, self.dim, self.voxel_size)
        T = pose_row(pose, self.dim)[None]
        with self.pool.lock:
            return update_report(insert_scan((self,), T, scan, 1))

    def write_bricks(self, coordinates: Any, values: Any) -> None:
        """Replace whole bricks, e.g. when a file is read.

        Parameters
        ----------
        coordinates : (n, 3) int
            Signed; brick b holds voxels 8b … 8b + 7. No brick twice.
        values : (n, 512) int16
            In units of `layout.STEP`, x fastest; `layout.UNKNOWN` for unknown voxels.
        """
        self.check_writable()
        c = np.ascontiguousarray(coordinates, dtype=np.int64)
        v = np.ascontiguousarray(values)
        if c.ndim != 2 or c.shape[1] != 3 or v.shape != (len(c), BRICK_VOXELS) or v.dtype != np.int16:
            raise GridError(
                "bricks have the wrong shape or type",
                got=f"{c.shape}, {v.shape} {v.dtype}",
                wanted=f"(n, 3) and (n, {BRICK_VOXELS}) int16",
            )
        half = self.pool.half // BRICK_EDGE
        if len(c) == 0:
            return
        if c.min() < -half or c.max() >= half:
            k = int(np.argwhere((c < -half) | (c >= half))[0][0])
            raise GridError(
                f"brick {k} lies outside the addressable cube of {self.pool.levels} levels",
                got=c[k].tolist(),
                wanted=f"[{-half}, {half})",
            )
        u = c + half
        keys = (u[:, 2] << 40) | (u[:, 1] << 20) | u[:, 0]
        if len(np.unique(keys)) != len(keys):
            raise GridError("a brick is repeated in one write", wanted="each brick once")
        write_packed(self, keys, v)

    def merge(self, other: EvidenceGrid, pose: Any = None) -> int:
        """Add the log-odds of another map under ``T_self_other``; see `merge.merge_grids`."""
        return merge_grids(self, other, pose)

    # --- reading ---------------------------------------------------------------------------------------------

    def brick_values(self) -> npt.NDArray[np.int16]:
        """Values of the bricks ``(n, 512)``, in the order of :meth:`brick_coordinates`, in units of `layout.STEP`."""
        with self.pool.lock:
            ids = self.packed_bricks()[:, 1]
            out = np.empty((len(ids), BRICK_VOXELS), np.int16)
            gather_bricks(np.ascontiguousarray(ids), self.pool.tree.bricks, out)
        return out

    def brick_blocks(self, size: int = 4096) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.int16]]]:
        """Coordinates ``(m, 3)`` and values ``(m, 512)`` of the bricks, in order, ``size`` bricks at a time."""
        pool = self.pool
        coordinates = self.brick_coordinates()
        with pool.lock:
            ids = self.packed_bricks()[:, 1]
            for k in range(0, len(ids), size):
                yield coordinates[k : k + size], pool.tree.bricks[ids[k : k + size]]

    # --- queries ---------------------------------------------------------------------------------------------

    def cast(
        self,
        origins: Any,
        directions: Any,
        max_range: float,
        *,
        pose: Any = None,
        ignore_unknown: bool = True,
        voxels: bool = False,
    ) -> queries.CastResult:
        """Expected ranges of beams (`queries.cast_beams`); for many grids at once, `queries.cast_grids`."""
        return queries.cast_beams(
            self, origins, directions, max_range, pose=pose, ignore_unknown=ignore_unknown, voxels=voxels
        )

    def log_odds_at(self, points: Any) -> npt.NDArray[np.float32]:
        """Log-odds ``(n,)`` of the voxels that contain points ``(n, dim)`` [m], NaN where unknown."""
        return queries.log_odds_at(self, points)

    def occupied_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """Whether points ``(n, dim)`` [m] lie in occupied voxels."""
        return queries.occupied_at(self, points)

    def known_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """Whether points ``(n, dim)`` [m] lie in voxels that were observed."""
        return queries.known_at(self, points)

    def box_query(self, lower: Any, upper: Any) -> contents.BoxCounts:
        """Numbers of occupied, known and all voxels in boxes with corners ``(m, dim)`` [m]: `contents.box_query`."""
        return contents.box_query(self, lower, upper)

    def bounding_box(self) -> tuple[Array, Array] | None:
        """Corners ``(dim,)`` of the smallest box that contains all known voxels [m]; None for an empty map."""
        return contents.bounding_box(self)

    def occupied_cloud(self, *, with_log_odds: bool = False) -> Any:
        """Centres of the occupied voxels ``(n, dim)`` [m]; with ``with_log_odds`` also their log-odds ``(n,)``."""
        return contents.occupied_cloud(self, with_log_odds=with_log_odds)

    def binned_cloud(self, level: int, *, minimum: int = 1) -> contents.BinnedCloud:
        """Occupied voxels grouped in cells with an edge of ``2**level`` voxels: `contents.binned_cloud`."""
        return contents.binned_cloud(self, level, minimum=minimum)

    def voxel_counts(self) -> contents.VoxelCounts:
        """Numbers of occupied and free voxels."""
        return contents.voxel_counts(self)

    def known_volume(self) -> float:
        """Volume of the voxels that were observed [m³], in 2-D their area [m²]."""
        return contents.known_volume(self)

    def entropy(self) -> float:
        """Entropy of the observed voxels times their volume (SegSLAM eq. 20–22) [nat m³]: `contents.entropy`."""
        return contents.entropy(self)

    def memory(self) -> MemoryUse:
        """Memory of this grid, private and shared; for sets of grids, `memory.measure_memory`."""
        return measure_memory(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an npz archive for `formats.load_npz`, atomically; equal maps give equal bytes.

        Unknown bricks are not stored. A cube with one value is stored as corner, size and value. Format
        ``graphslam.evidence/1``: arrays ``voxel_size``, ``dim``, ``levels``, ``model`` (hit, miss, clamp low, clamp
        high, threshold), and those of `compact.GridPieces`.
        """
        pieces, m = grid_pieces(self), self.model
        write_npz(
            path,
            {
                "format": FORMAT,
                "voxel_size": np.float64(self.voxel_size),
                "dim": np.int64(self.dim),
                "levels": np.int64(self.pool.levels),
                "model": np.array([m.hit, m.miss, *m.clamp, m.threshold], np.float64),
                "bricks": pieces.bricks.astype(np.int32),
                "values": pieces.values,
                "cubes": pieces.cubes.astype(np.int32),
                "cube_log_edges": pieces.log_edges.astype(np.uint8),
                "cube_values": pieces.cube_values.astype(np.int16),
            },
        )

    def _repr_html_(self) -> str:
        counts, box, m = self.voxel_counts(), self.bounding_box(), self.memory()
        extent = "empty" if box is None else " × ".join(f"{d:.1f}" for d in box[1] - box[0]) + " m"
        facts = {
            "extent of known space": extent,
            "voxels occupied / free": f"{counts.occupied:,} / {counts.free:,}",
            "memory, own / shared": f"{m.private / 1e6:.2f} / {m.shared / 1e6:.2f} MB",
        }
        summary = f" {self.dim}-D, {self.voxel_size:g} m voxels{', locked' if self.locked else ''}"
        return join_parts([html_element("b", "EvidenceGrid"), summary, pair_list(facts)])

    def __repr__(self) -> str:
        state = ", locked" if self.locked else ""
        return f"EvidenceGrid({self.voxel_size:g} m, {self.dim}-D, {len(self.brick_coordinates())} bricks{state})"
