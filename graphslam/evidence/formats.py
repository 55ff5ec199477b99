"""Lossless conversion of evidence grids to dense arrays, and reading of npz files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import read_npz
from graphslam.core.errors import ConfigError, FormatError, GridError
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.compact import GridPieces, check_reach, fill_grid, find_overlap
from graphslam.evidence.dense_kernels import dense_log_odds, dense_values, known_box
from graphslam.evidence.grid import FORMAT, EvidenceGrid
from graphslam.evidence.layout import (
    BRICK_EDGE,
    BRICK_VOXELS,
    LARGEST_VOXEL,
    MAX_LEVELS,
    SMALLEST_VOXEL,
    UNKNOWN,
    half_edge,
)
from graphslam.evidence.pool import GridPool

DENSE_LIMIT = 1 << 34
"""Largest dense array that is allocated [bytes]; a larger request is probably an error in the bounds."""

Ints = npt.NDArray[np.int64]


# --- dense -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DenseGrid:
    """A box of voxels as an array.

    Parameters
    ----------
    values : (nx, ny, nz), in 2-D (nx, ny)
        int16 in units of `layout.STEP` with `layout.UNKNOWN`, or float32 log-odds with NaN for unknown. From
        :func:`to_dense`, x is the fastest axis in memory.
    first_voxel : (dim,) int64
        Signed coordinates of the first voxel: it covers ``[i v, (i + 1) v) × …``.
    voxel_size : float
        [m]
    """

    values: npt.NDArray[Any]
    first_voxel: Ints
    voxel_size: float

    @property
    def origin(self) -> npt.NDArray[np.float64]:
        """Lower corner of the box ``(dim,)`` [m]."""
        return np.asarray(self.first_voxel * self.voxel_size)


def known_bounds(grid: EvidenceGrid) -> tuple[Ints, Ints]:
    """First known voxel and the one after the last, on each axis ``(3,)``; both 0 for an empty map."""
    pool = grid.pool
    box = np.empty(6, np.int64)
    with pool.lock:
        known_box(grid.root, pool.levels, pool.tree.children, pool.tree.bricks, box)
    if box[3] <= box[0]:
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    return box[:3] - pool.half, box[3:] - pool.half


def to_dense(grid: EvidenceGrid, *, bounds: npt.ArrayLike | None = None, dtype: Any = np.int16) -> DenseGrid:
    """Convert a map, or a box of it, to an array, without loss.

    Parameters
    ----------
    bounds : (2, dim) int, optional
        First voxel and the one after the last; may extend beyond the map and its addressable cube. Default: the
        bounding box of the known voxels.
    dtype : int16 or float32
        Units of `layout.STEP`, or log-odds.
    """
    kind = np.dtype(dtype)
    if kind not in (np.dtype(np.int16), np.dtype(np.float32)):
        raise GridError("impossible type of a dense grid", got=kind, wanted="int16 or float32")
    with grid.pool.lock:
        if bounds is None:
            low, high = known_bounds(grid)
            if grid.dim == 2:
                high[2] = 1  # the layer k = 0, also for an empty map
        else:
            low, high = _checked_bounds(bounds, grid.dim)
        shape = tuple((high - low).tolist())
        size = kind.itemsize * shape[0] * shape[1] * shape[2]
        if size > DENSE_LIMIT:
            raise GridError(f"a dense grid of {shape} voxels takes {size / 1e9:.0f} GB", wanted="narrower bounds")
        pool, first = grid.pool, low + grid.pool.half
        values = np.empty(shape[::-1], kind)
        if kind == np.int16:
            dense_values(grid.root, first, pool.levels, pool.tree.children, pool.tree.bricks, values)
        else:  # a few layers at a time, which fit in the cache
            layers = np.empty((BRICK_EDGE, *values.shape[1:]), np.int16)
            for z in range(0, len(values), BRICK_EDGE):
                part = layers[: len(values) - z]
                dense_values(grid.root, first + [0, 0, z], pool.levels, pool.tree.children, pool.tree.bricks, part)
                dense_log_odds(part.reshape(-1), values[z : z + BRICK_EDGE].reshape(-1))
    out = values.transpose(2, 1, 0)
    return DenseGrid(out if grid.dim == 3 else out[:, :, 0], low[: grid.dim], grid.voxel_size)


def _checked_bounds(bounds: npt.ArrayLike, dim: int) -> tuple[Ints, Ints]:
    box = np.asarray(bounds)
    if box.shape != (2, dim) or box.dtype.kind not in "iu" or np.any(box[0] > box[1]):
        raise GridError(
            "impossible bounds of a dense grid",
            got=np.array2string(box, threshold=8),
            wanted=f"(2, {dim}) integers, [first voxel, the one after the last]",
        )
    # bounds far outside every tree: clipped, because sums may overflow
    far = 1 << 40
    box = (
        np.clip(box.astype(np.float64), -far, far).astype(np.int64) if np.any(np.abs(box.astype(float)) > far) else box
    )
    layer = np.zeros((2, 3), np.int64)
    layer[1, 2] = 1  # a 2-D grid is the layer k = 0
    layer[:, :dim] = box
    return layer[0], layer[1]


# --- npz ---------------------------------------------------------------------------------------------------------


def load_npz(path: str | os.PathLike[str], *, pool: GridPool | None = None) -> EvidenceGrid:
    """Read a file that was written by `EvidenceGrid.save`.

    Parameters
    ----------
    pool : GridPool, optional
        Pool to read into; the map must fit in its addressable cube. Default: a new pool with the number of levels
        stored in the file.
    """
    where = str(path)
    arrays = read_npz(path, fmt=FORMAT)
    model, voxel_size, dim, levels = _read_head(arrays, where)
    pieces = _read_pieces(arrays, where)
    reach = 0
    for corner, edge in ((pieces.bricks, 1), (pieces.cubes, 1 << pieces.log_edges[:, None] - 3)):
        if len(corner):
            reach = max(reach, BRICK_EDGE * int(max(-corner.min(), (corner + edge).max())))
    if reach > half_edge(levels):
        raise FormatError(f"voxels {reach} from the origin do not fit the {levels} levels named", where=where)
    wrong = find_overlap(pieces)
    if wrong:
        raise FormatError(wrong, where=where)
    if dim == 2 and (len(pieces.cubes) or np.any(pieces.bricks[:, 2]) or np.any(pieces.values[:, 64:] != UNKNOWN)):
        raise FormatError("a 2-D grid has voxels beside the layer k = 0", where=where)
    pool = GridPool(levels) if pool is None else pool
    check_reach(reach, pool, where)
    return fill_grid(EvidenceGrid(voxel_size, model=model, pool=pool, dim=dim), pieces)


def _field(arrays: dict[str, npt.NDArray[Any]], name: str, dtype: Any, shape: tuple[int, ...], where: str) -> Any:
    """Array of a file, checked for type and shape; -1 in a shape means any number."""
    if name not in arrays:
        raise FormatError(f"array {name!r} is missing", where=where)
    a = arrays[name]
    fits = a.ndim == len(shape) and all(w in (-1, n) for n, w in zip(a.shape, shape))
    if not fits or a.dtype != np.dtype(dtype):
        raise FormatError(
            f"array {name!r} has the wrong shape or type",
            where=where,
            got=f"{a.shape} {a.dtype}",
            wanted=f"{shape} {np.dtype(dtype)}",
        )
    return a


def _read_head(arrays: dict[str, npt.NDArray[Any]], where: str) -> tuple[BeamModel, float, int, int]:
    hit, miss, low, high, threshold = _field(arrays, "model", np.float64, (5,), where).tolist()
    try:
        model = BeamModel(hit, miss, (low, high), threshold)
    except ConfigError as error:
        raise FormatError(f"array 'model' is impossible ({error})", where=where) from None
    voxel_size = float(_field(arrays, "voxel_size", np.float64, (), where))
    dim, levels = (int(_field(arrays, name, np.int64, (), where)) for name in ("dim", "levels"))
    if not SMALLEST_VOXEL <= voxel_size <= LARGEST_VOXEL:
        wanted = f"{SMALLEST_VOXEL:g} to {LARGEST_VOXEL:g} m"
        raise FormatError("voxel size is impossible", where=where, got=voxel_size, wanted=wanted)
    if dim not in (2, 3):
        raise FormatError("dimension is impossible", where=where, got=dim, wanted="2 or 3")
    if not 2 <= levels <= MAX_LEVELS:
        raise FormatError("number of levels is impossible", where=where, got=levels, wanted=f"2 … {MAX_LEVELS}")
    return model, voxel_size, dim, levels


def _read_pieces(arrays: dict[str, npt.NDArray[Any]], where: str) -> GridPieces:
    bricks = _field(arrays, "bricks", np.int32, (-1, 3), where).astype(np.int64)
    values = _field(arrays, "values", np.int16, (len(bricks), BRICK_VOXELS), where)
    cubes = _field(arrays, "cubes", np.int32, (-1, 3), where).astype(np.int64)
    edges = _field(arrays, "cube_log_edges", np.uint8, (len(cubes),), where).astype(np.int64)
    cube_values = _field(arrays, "cube_values", np.int16, (len(cubes),), where).astype(np.int64)
    if edges.max(initial=3) > 2 * MAX_LEVELS + 2 or edges.min(initial=3) < 3:
        raise FormatError(
            "edge of a cube is impossible", where=where, got=f"2^{edges.min()} … 2^{edges.max()}", wanted="2^3 … 2^16"
        )
    if np.any(cube_values == UNKNOWN) or not (values != UNKNOWN).any(axis=1).all():
        raise FormatError("a cube or brick of unknown voxels is listed", where=where)
    return GridPieces(bricks, values, cubes, edges, cube_values)
