"""Terrain of a run as pieces that move with the nodes of the graph: a loop closure does not need the scans again.

The observations between a node and the next are summed in the node's level frame (position and yaw), in the cells of
each range band. A world cell gets the values of the piece's cell at its centre; all sums are integers. So a map with
moved pieces is bitwise equal to one made from scratch at the same poses. Detections are relative to the ground of their
own line, so a change of tilt does not affect them.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError, GridError
from graphslam.core.geometry import Array
from graphslam.maps.terrain.line_kernels import OVERHANG, SUPPORT, add_rows, bound_rows
from graphslam.maps.terrain.lines import DetectorConfig, Rows, ScanLines, observe_terrain
from graphslam.maps.terrain.pyramid import Box, Pyramid, TerrainMap
from graphslam.maps.terrain.tables import TerrainWeights
from graphslam.maps.terrain.vehicle import CELLS, LineSensor, Vehicle

PieceId: TypeAlias = Hashable
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class TerrainPiece:
    """Detections of scan lines in the cells around a node.

    Parameters
    ----------
    cells : (n, 3) int64
        Band, ix, iy in the node's level frame; unique.
    ratios : (2, n) int32
    counts : (4, n) int32
    heights : (3, n) int64
        Heights above the node; see :func:`~graphslam.maps.terrain.line_kernels.add_rows`.
    pose : (7,)
        Pose of the node when the piece was made.
    """

    cells: Ints
    ratios: npt.NDArray[np.int32]
    counts: npt.NDArray[np.int32]
    heights: Ints
    pose: Array

    def __len__(self) -> int:
        return len(self.cells)


def piece_of(rows: Rows, tables: TerrainWeights, pose: Array) -> TerrainPiece:
    """Sum up detections ``(k, 6)`` in the level frame of a node."""
    bands = tables.bands
    first, last = np.full((bands, 2), 1 << 40), np.full((bands, 2), -(1 << 40))
    bound_rows(rows, first, last)
    shapes = np.maximum(last - first + 1, 0)[:, ::-1].copy()
    offsets = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])
    n = int(offsets[-1])
    ratios, counts, heights = np.zeros((2, n), np.int32), np.zeros((4, n), np.int32), np.zeros((3, n), np.int64)
    add_rows(rows, first, shapes, offsets, tables.ratios, ratios, counts, heights)
    filled = np.flatnonzero(counts.any(axis=0))  # ground detections always have a support detection, too
    band = np.searchsorted(offsets, filled, side="right") - 1
    iy, ix = np.divmod(filled - offsets[band], shapes[band, 1])
    cells = np.column_stack([band, ix + first[band, 0], iy + first[band, 1]])
    ratios, counts, heights = ratios[:, filled], counts[:, filled], heights[:, filled]
    return TerrainPiece(cells, ratios, counts, heights, np.asarray(pose, dtype=np.float64))


class TerrainLayer:
    """Terrain pieces with poses, and their map.

    Parameters
    ----------
    cells : tuple of float, optional
        Widths of the cells of the bands [m].
    """

    def __init__(
        self, tables: TerrainWeights, vehicle: Vehicle, sensor: LineSensor, cells: tuple[float, ...] = CELLS
    ) -> None:
        self.tables, self.vehicle, self.sensor, self.cells = tables, vehicle, sensor, cells
        self.pieces: dict[PieceId, TerrainPiece] = {}
        self.poses: dict[PieceId, Array] = {}
        self._made: Pyramid | None = None

    def read(
        self, name: PieceId, lines: Iterable[ScanLines], pose: Array, config: DetectorConfig | None = None
    ) -> TerrainPiece:
        """Make the piece of a node at ``pose`` ``(7,)`` from lines in the world frame."""
        if name in self.pieces:
            raise DataError(f"the terrain of node {name!r} is there already")
        edges = self.sensor.band_edges(self.cells)
        parts: list[Rows] = [np.zeros((0, 6), np.int32)]
        for of in lines:
            parts += list(observe_terrain(_in_frame(of, pose), edges, np.array(self.cells), self.vehicle, config))
        piece = piece_of(np.concatenate(parts), self.tables, pose)
        self.pieces[name], self.poses[name] = piece, piece.pose
        self._made = None
        return piece

    def move(self, poses: Mapping[PieceId, Array]) -> int:
        """Move pieces to other poses ``(7,)``; returns the number of moved pieces.

        Only the moved pieces are subtracted from the map and added at their new poses.
        """
        strange = [name for name in poses if name not in self.pieces]
        if strange:
            raise DataError("no terrain was read at this node", got=strange[0])
        moved = {
            n: np.asarray(T, dtype=np.float64)
            for n, T in poses.items()
            if _placed(np.asarray(T, dtype=np.float64)) != _placed(self.poses[n])
        }
        made = self._made
        if made is not None and not _inside(self._box(moved), made):
            made = self._made = None
        for name, T in moved.items():
            if made is not None:
                _add(made, self.pieces[name], self.poses[name], -1)
                _add(made, self.pieces[name], T, 1)
            self.poses[name] = T
        return len(moved)

    def pyramid(self) -> Pyramid:
        """Evidence of all pieces at their poses."""
        if self._made is None:
            box = self._box({})
            if box is None:
                raise GridError("a map of the terrain without any piece that says something")
            margin = 4.0  # a loop moves pieces by some metres: avoids a new box each time
            grown = (box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin)
            self._made = Pyramid(grown, self.tables, self.vehicle, self.sensor, self.cells)
            for name, piece in self.pieces.items():
                _add(self._made, piece, self.poses[name], 1)
        return self._made

    def classify(self, threshold: float | None = None) -> TerrainMap:
        """See :meth:`Pyramid.classify`."""
        return self.pyramid().classify(threshold)

    def _box(self, moved: Mapping[PieceId, Array]) -> Box | None:
        boxes = []
        for name, piece in self.pieces.items():
            if len(piece):
                low, high = _extent(piece, self.cells, moved.get(name, self.poses[name]))
                boxes.append((*low, *high))
        if not boxes:
            return None
        b = np.array(boxes)
        return (*(float(v) for v in b[:, :2].min(axis=0)), *(float(v) for v in b[:, 2:].max(axis=0)))  # type: ignore[return-value]


def _placed(T: Array) -> tuple[float, float, float, int]:
    """Position, yaw, and height in integer millimetres, which determine the cells of a piece."""
    return (float(T[0]), float(T[1]), _yaw(T), round(1000.0 * float(T[2])))


def _yaw(T: Array) -> float:
    x = se3.quat_rotate(T[None, 3:], np.array([[1.0, 0.0, 0.0]]))[0]
    return math.atan2(x[1], x[0])


def _in_frame(lines: ScanLines, pose: Array) -> ScanLines:
    """Lines in the level frame of a node."""
    c, s = math.cos(_yaw(pose)), math.sin(_yaw(pose))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return ScanLines((lines.points - pose[:3]) @ R, (lines.origins - pose[:3]) @ R, lines.feet - pose[2])


def _extent(piece: TerrainPiece, cells: tuple[float, ...], T: Array) -> tuple[Array, Array]:
    """Lower left and upper right corner of a piece in the world [m]."""
    width = np.asarray(cells)[piece.cells[:, 0]][:, None]
    low, high = (piece.cells[:, 1:] * width).min(axis=0), ((piece.cells[:, 1:] + 1) * width).max(axis=0)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    c, s = math.cos(_yaw(T)), math.sin(_yaw(T))
    at = corners @ np.array([[c, s], [-s, c]]) + T[:2]
    return at.min(axis=0), at.max(axis=0)


def _inside(box: Box | None, made: Pyramid) -> bool:
    if box is None:
        return True
    low = made.first[0] * made.cells[0]
    high = low + made.shapes[0][::-1] * made.cells[0]
    return bool(np.all(np.asarray(box[:2]) >= low) and np.all(np.asarray(box[2:]) <= high))


def _add(made: Pyramid, piece: TerrainPiece, T: Array, sign: int) -> None:
    """Add (or subtract) a piece at a pose."""
    yaw, height = _yaw(T), round(1000.0 * float(T[2]))
    c, s = math.cos(yaw), math.sin(yaw)
    for b, width in enumerate(made.cells.tolist()):
        mine = np.flatnonzero(piece.cells[:, 0] == b)
        if not len(mine):
            continue
        own = piece.cells[mine, 1:]
        first = own.min(axis=0)
        shape = own.max(axis=0) - first + 1
        table = np.full((shape[1], shape[0]), -1, np.int64)
        table[own[:, 1] - first[1], own[:, 0] - first[0]] = mine
        part = replace(piece, cells=piece.cells[mine])
        low, high = _extent(part, tuple(made.cells.tolist()), T)
        ix0, iy0 = np.maximum(np.floor(low / width).astype(np.int64), made.first[b])
        ix1, iy1 = np.minimum(np.floor(high / width).astype(np.int64) + 1, made.first[b] + made.shapes[b][::-1])
        x, y = np.meshgrid(width * (np.arange(ix0, ix1) + 0.5) - T[0], width * (np.arange(iy0, iy1) + 0.5) - T[1])
        jx = np.floor((c * x + s * y) / width).astype(np.int64) - first[0]
        jy = np.floor((-s * x + c * y) / width).astype(np.int64) - first[1]
        inside = (jx >= 0) & (jy >= 0) & (jx < shape[0]) & (jy < shape[1])
        target = np.where(inside, table[np.clip(jy, 0, shape[1] - 1), np.clip(jx, 0, shape[0] - 1)], -1)
        iy, ix = np.nonzero(target >= 0)
        source = target[iy, ix]
        cell = made.offsets[b] + (iy + iy0 - made.first[b, 1]) * made.shapes[b, 1] + (ix + ix0 - made.first[b, 0])
        made.ratios[:, cell] += sign * piece.ratios[:, source]
        made.counts[:, cell] += sign * piece.counts[:, source]
        made.heights[:, cell] += sign * piece.heights[:, source]
        overhanging = piece.counts[OVERHANG, source] > 0
        made.votes[0, cell] += sign * overhanging
        made.votes[1, cell] += sign * (~overhanging & (piece.counts[SUPPORT, source] > 0))
        made.heights[1, cell] += sign * height * piece.heights[0, source]
