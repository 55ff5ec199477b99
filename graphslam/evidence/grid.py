"""EvidenceGrid: a log-odds map of occupied and free space that copies in constant time.

The deferred-reference-count octree of SegSLAM (section 2): a grid is a value-like handle on a tree in a shared pool.
Copying shares the tree; writing copies only what it changes. So every particle of a filter owns a map, resampled
particles share their history, and a submap that is entered again starts as a copy of what it was.
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

    Voxel (i, j, k) covers ``[i v, (i + 1) v) × …`` of the grid's frame, v the voxel size. A 2-D grid is the layer
    k = 0 of the same thing.

    Parameters
    ----------
    voxel_size : float
        Edge of a voxel [m].
    pool : GridPool, optional
        Storage shared with other grids; default a pool of its own.
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
        """Insert beams by the beam model: free along the way, occupied at the end, each voxel once a scan.

        All voxels from that of the origin up to, not including, that of the end are passed; that of the end is hit. A
        voxel some beam hit counts as hit, whatever passed through it. Beams that cannot be used are dropped and
        counted.

        Parameters
        ----------
        points : (n, 3) or (n, 2)
            Ends of the beams in the frame of the scan [m].
        origin : (3,) or (n, 3), (2,) or (n, 2)
            Where the beams start, in the same frame; one for each beam if the sensor moved. Default 0.
        pose : (7,), (4, 4), or (3,) in 2-D
            ``T_grid_scan``; default identity.
        max_range : float, optional
            Longer beams are cut there and give free space only [m].
        returns : (n,) bool, optional
            False where a beam met nothing: it is free up to its point. Default all True.
        """
        self.check_writable()
        scan = scan_rows(points, origin, returns, max_range, self.dim, self.voxel_size)
        T = pose_row(pose, self.dim)[None]
        with self.pool.lock:
            return update_report(insert_scan((self,), T, scan, 1))

    def write_bricks(self, coordinates: Any, values: Any) -> None:
        """Replace whole bricks: the bulk way in for readers.

        Parameters
        ----------
        coordinates : (n, 3) int
            Signed; brick b holds voxels 8b … 8b + 7. None twice.
        values : (n, 512) int16
            In units of `layout.STEP`, x fastest; `layout.UNKNOWN` where nothing is known.
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
        """Add the log-odds of another map under ``T_self_other``; see `merge.merge`."""
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
        """Coordinates ``(m, 3)`` and values ``(m, 512)`` of the bricks, so many at a time, in their order."""
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
        """Expected ranges of beams: `queries.cast`; for many grids at once, `queries.cast_grids`."""
        return queries.cast_beams(
            self, origins, directions, max_range, pose=pose, ignore_unknown=ignore_unknown, voxels=voxels
        )

    def log_odds_at(self, points: Any) -> npt.NDArray[np.float32]:
        """Log-odds ``(n,)`` of the voxels that points ``(n, dim)`` [m] lie in, NaN where unknown."""
        return queries.log_odds_at(self, points)

    def occupied_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """Whether points ``(n, dim)`` [m] lie in occupied voxels."""
        return queries.occupied_at(self, points)

    def known_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """Whether points ``(n, dim)`` [m] lie in voxels that were observed."""
        return queries.known_at(self, points)

    def box_query(self, lower: Any, upper: Any) -> contents.BoxCounts:
        """Occupied, known and all voxels in boxes between corners ``(m, dim)`` [m]: `contents.box_query`."""
        return contents.box_query(self, lower, upper)

    def bounding_box(self) -> tuple[Array, Array] | None:
        """Corners ``(dim,)`` of the smallest box that holds all known voxels [m]; None of an empty map."""
        return contents.bounding_box(self)

    def occupied_cloud(self, *, with_log_odds: bool = False) -> Any:
        """Centres of the occupied voxels ``(n, dim)`` [m]; with their log-odds ``(n,)`` if asked for."""
        return contents.occupied_cloud(self, with_log_odds=with_log_odds)

    def binned_cloud(self, level: int, *, minimum: int = 1) -> contents.BinnedCloud:
        """Occupied voxels gathered in cells of ``2**level`` voxels: `contents.binned_cloud`."""
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
        """Memory of this grid, and what of it no other grid shares; for sets of grids, `memory.memory`."""
        return measure_memory(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an npz archive that `formats.load_npz` reads: whole or not at all, the same map always as the same
        bytes.

        The archive holds no unknown brick, and a cube of one value as its corner, size and value only (format
        ``graphslam.evidence/1``: arrays ``voxel_size``, ``dim``, ``levels``, ``model`` (hit, miss, clamp low, clamp
        high, threshold), and those of `compact.Pieces`).
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
        said = f" {self.dim}-D, {self.voxel_size:g} m voxels{', locked' if self.locked else ''}"
        return join_parts([html_element("b", "EvidenceGrid"), said, pair_list(facts)])

    def __repr__(self) -> str:
        state = ", locked" if self.locked else ""
        return f"EvidenceGrid({self.voxel_size:g} m, {self.dim}-D, {len(self.brick_coordinates())} bricks{state})"
