"""Triangle mesh of the zero set of a surface, its position uncertainty, and mesh files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.atomic import atomic_open
from graphslam.core.errors import DataError, FormatError
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.maps.surface.layer import PieceId, SurfaceLayer
from graphslam.maps.surface.piece import SurfacePiece

Ints = npt.NDArray[np.int64]
TILE = 8
"""Bricks along the edge of a mesh tile; only changed tiles are recomputed."""
FORMATS = (".ply", ".glb", ".obj")
_SPAN = 8 * TILE


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles.

    Parameters
    ----------
    vertices : (v, 3)
        [m]
    triangles : (t, 3)
        Counter-clockwise as seen from the free side.
    """

    vertices: Array
    triangles: Ints

    def area(self) -> float:
        """[m²]"""
        return float(np.sum(self._areas()))

    def _areas(self) -> Array:
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))

    def samples(self, number: int, rng: np.random.Generator) -> Array:
        """Points ``(number, 3)``, evenly over the area."""
        areas = self._areas()
        if not areas.sum() > 0.0:
            raise DataError("a mesh without area has no points", got=f"{len(self.triangles)} triangles")
        which = rng.choice(len(areas), number, p=areas / areas.sum())
        u, v = rng.random((2, number))
        flip = u + v > 1.0
        u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
        a, b, c = (self.vertices[self.triangles[which, k]] for k in range(3))
        return np.asarray(a + u[:, None] * (b - a) + v[:, None] * (c - a))


def zero_set(bricks: tuple[Ints, Array, npt.NDArray[np.bool_]], voxel: float) -> Mesh:
    """Triangles of the zero set of bricks ``(coordinates, distances, known)``; see :meth:`SurfaceLayer.bricks`.

    Only cells with eight known corners have triangles, so a surface ends at unknown space.
    """
    mesher = Mesher(voxel)
    mesher.update(*bricks)
    return mesher.mesh()


class Mesher:
    """Mesh in tiles: after a change only the tiles around it are recomputed.

    Parameters
    ----------
    voxel : float
        [m]
    """

    def __init__(self, voxel: float) -> None:
        self.voxel = voxel
        self.tiles: dict[tuple[int, int, int], tuple[Array, Ints]] = {}

    def update(self, coordinates: Ints, phi: Array, known: npt.NDArray[np.bool_], changed: Ints | None = None) -> int:
        """Recompute triangles; returns the number of tiles.

        Parameters
        ----------
        coordinates : (n, 3)
            Coordinates of all bricks.
        phi, known : (n, 512)
        changed : (m, 3), optional
            Bricks that changed or were removed; default all.
        """
        if changed is None:
            self.tiles.clear()
            changed = coordinates
        # the cells of a tile extend to the first layer of the next one
        dirty = np.unique(np.concatenate([changed // TILE, (changed - 1) // TILE, *_edges(changed)]), axis=0)
        owner: dict[tuple[int, int, int], list[int]] = {}
        wanted = {(int(x), int(y), int(z)) for x, y, z in dirty}
        for k, (x, y, z) in enumerate(coordinates.tolist()):
            for i in {x // TILE, (x - 1) // TILE}:
                for j in {y // TILE, (y - 1) // TILE}:
                    for l in {z // TILE, (z - 1) // TILE}:
                        if (i, j, l) in wanted:
                            owner.setdefault((i, j, l), []).append(k)
        for tile in wanted:
            rows = owner.get(tile)
            made = None if rows is None else _triangles(coordinates[rows], phi[rows], known[rows], tile)
            if made is None:
                self.tiles.pop(tile, None)
            else:
                self.tiles[tile] = made
        return len(wanted)

    def mesh(self) -> Mesh:
        """Mesh of all tiles; common vertices are merged."""
        parts = [self.tiles[t] for t in sorted(self.tiles)]
        if not parts:
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        start = np.cumsum([0, *(len(v) for v, _ in parts)])
        vertices = np.concatenate([v for v, _ in parts])
        triangles = np.concatenate([t + s for (_, t), s in zip(parts, start.tolist())])
        # a vertex is on one edge of the lattice: equal positions are the same edge
        _, first, back = np.unique(
            np.round(vertices * 4096.0).astype(np.int64), axis=0, return_index=True, return_inverse=True
        )
        triangles = back.reshape(-1)[triangles]
        whole = (
            (triangles[:, 0] != triangles[:, 1])
            & (triangles[:, 1] != triangles[:, 2])
            & (triangles[:, 2] != triangles[:, 0])
        )
        return Mesh(self.voxel * vertices[first], triangles[whole])


def _edges(changed: Ints) -> list[Ints]:
    """Neighbouring tiles that a brick on the lower side of its tile also belongs to, one array per set of axes."""
    out = []
    for k in range(1, 7):
        back = np.array([k & 1, (k >> 1) & 1, (k >> 2) & 1])
        out.append((changed - back) // TILE)
    return out


def _triangles(
    coordinates: Ints, phi: Array, known: npt.NDArray[np.bool_], tile: tuple[int, int, int]
) -> tuple[Array, Ints] | None:
    measure = import_extra("skimage.measure", "a surface")
    n = _SPAN + 1
    values, there = np.ones((n, n, n), np.float32), np.zeros((n, n, n), np.bool_)
    for (x, y, z), p, k in zip((8 * (coordinates - TILE * np.array(tile))).tolist(), phi, known):
        a, b, c = min(8, n - x), min(8, n - y), min(8, n - z)
        if min(a, b, c) <= 0:
            continue
        values[z : z + c, y : y + b, x : x + a] = p.reshape(8, 8, 8)[:c, :b, :a]
        there[z : z + c, y : y + b, x : x + a] = k.reshape(8, 8, 8)[:c, :b, :a]
    cells = there[:-1, :-1, :-1].copy()
    for dz, dy, dx in np.ndindex(2, 2, 2):
        cells &= there[dz : n - 1 + dz, dy : n - 1 + dy, dx : n - 1 + dx]
    if not cells.any() or not (values[there].min() < 0.0 < values[there].max()):
        return None
    values[values == 0.0] = 1e-6  # a corner exactly on the surface would be a vertex of many edges
    mask = np.zeros((n, n, n), np.bool_)
    mask[1:, 1:, 1:] = cells  # indexed by the last corner of a cell
    try:
        vertices, triangles, _, _ = measure.marching_cubes(values, 0.0, mask=mask, allow_degenerate=False)
    except (RuntimeError, ValueError):  # the surface crosses no cell of the mask
        return None
    at = vertices[:, ::-1].astype(np.float64) + 0.5 + _SPAN * np.array(tile)
    return at, triangles[:, ::-1].astype(np.int64)  # reversed axes reverse the orientation


# --- uncertainty of vertices ----------------------------------------------------------------------------------------


def vertex_owners(mesh: Mesh, layer: SurfaceLayer) -> npt.NDArray[np.int64]:
    """Index of the piece, in the layer's order, with the largest weight at each vertex ``(v,)``; −1 if none."""
    best, out = np.zeros(len(mesh.vertices)), np.full(len(mesh.vertices), -1, np.int64)
    for k, (name, piece) in enumerate(layer.pieces.items()):
        w = _weight_at(piece, mesh.vertices, layer.poses[name], layer.config.voxel)
        more = w > best
        best[more], out[more] = w[more], k
    return out


def _weight_at(piece: SurfacePiece, points: Array, T: Array, voxel: float) -> Array:
    if not len(piece):
        return np.zeros(len(points))
    back = se3.se3_inverse(T)
    v = np.floor(se3.se3_transform(np.broadcast_to(back, (len(points), 7)), points) / voxel).astype(np.int64)
    brick = v // 8 - piece.first
    shape = np.array(piece.table.shape)[::-1]
    inside = np.all((brick >= 0) & (brick < shape), axis=1)
    b = np.where(inside[:, None], brick, 0)
    row = np.where(inside, piece.table[b[:, 2], b[:, 1], b[:, 0]] - 1, -1)
    u = (v[:, 2] % 8) * 64 + (v[:, 1] % 8) * 8 + v[:, 0] % 8
    return np.where(row >= 0, piece.counts[row, u, 0], 0).astype(np.float64)


def position_sigma(mesh: Mesh, layer: SurfaceLayer, covariances: Mapping[PieceId, Array]) -> Array:
    """Standard deviation of every vertex position ``(v,)`` [m] from the pose covariance of its node.

    For a vertex ``p = R q + t``, with the node's covariance in its right tangent (rotation, translation):
    ``J = R [−[q]×, I]``, ``σ² = trace(J Σ Jᵀ)``. NaN without a piece or a covariance.
    """
    out = np.full(len(mesh.vertices), np.nan)
    own = vertex_owners(mesh, layer)
    for k, name in enumerate(layer.pieces):
        if name not in covariances:
            continue
        mine = np.flatnonzero(own == k)
        S = np.asarray(covariances[name], dtype=np.float64)
        back = se3.se3_inverse(layer.poses[name])
        q = se3.se3_transform(np.broadcast_to(back, (len(mine), 7)), mesh.vertices[mine])
        J = np.zeros((len(mine), 3, 6))
        J[:, 0, 3] = J[:, 1, 4] = J[:, 2, 5] = 1.0
        J[:, 0, 1], J[:, 0, 2] = q[:, 2], -q[:, 1]
        J[:, 1, 0], J[:, 1, 2] = -q[:, 2], q[:, 0]
        J[:, 2, 0], J[:, 2, 1] = q[:, 1], -q[:, 0]
        out[mine] = np.sqrt(np.einsum("nij,jk,nik->n", J, S, J))  # rotation by R does not change the trace
    return out


# --- files -------------------------------------------------------------------------------------------------------


def save_mesh(mesh: Mesh, path: str | os.PathLike[str], colours: npt.NDArray[np.uint8] | None = None) -> Path:
    """Write PLY (binary), GLB or OBJ by the ending of the path; ``colours (v, 3)`` or ``(v, 4)`` of the vertices."""
    trimesh = import_extra("trimesh", "a file of a surface")
    target = Path(path)
    if target.suffix not in FORMATS:
        raise FormatError("unknown ending of a mesh", where=str(path), got=target.suffix, wanted=", ".join(FORMATS))
    if not len(mesh.triangles):
        raise DataError("a surface without a triangle cannot be written", where=str(path))
    made = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=colours, process=False)
    data = made.export(file_type=target.suffix[1:])
    with atomic_open(target) as stream:
        stream.write(data.encode() if isinstance(data, str) else data)
    return target
