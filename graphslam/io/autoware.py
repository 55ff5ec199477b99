"""Writer of Autoware maps: a point cloud in tiles, the list of tiles, and the georeference.

A folder with ``pointcloud_map.pcd/`` (binary PCD 0.7, one file per tile), ``pointcloud_map_metadata.yaml`` (size of the
tiles and lower corner of each), and ``map_projector_info.yaml`` (``LocalCartesian`` at a WGS 84 datum: x east, y north,
z up; or ``Local``: the frame of the map).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.output_folder import output_folder
from graphslam.io.cloud_writers import write_pcd

TILE = 20.0
"""Side of a tile [m]."""
KIND = "map in tiles"
"""See :func:`~graphslam.core.output_folder.check_folder_target`."""
_TILES, _PROJECTOR = "pointcloud_map_metadata.yaml", "map_projector_info.yaml"


def write_autoware(
    folder: str | os.PathLike[str], points: Array, *, datum: tuple[float, float] | None = None, tile: float = TILE
) -> Path:
    """Write a map folder of Autoware.

    Parameters
    ----------
    folder : path
        New, empty, or of an earlier map, which is replaced; other files in it stay.
    points : (n, 3)
        [m]; with a datum: east, north, up relative to it; otherwise in the frame of the map.
    datum : (latitude, longitude), optional
        [deg, WGS 84]; its height is 0.
    tile : float
        Side of a tile [m], a whole number.
    """
    p = np.asarray(points, dtype=np.float64)
    if not len(p):
        raise DataError("a map without a point cannot be written", where=str(folder))
    if not (tile >= 1 and tile == int(tile)):
        raise DataError("impossible side of a tile", got=tile, wanted="a whole number of metres")
    with output_folder(folder, KIND, last=(_TILES, _PROJECTOR)) as root:
        _write_map(root, p, datum, tile)
    return Path(folder)


def _write_map(root: Path, p: Array, datum: tuple[float, float] | None, tile: float) -> None:
    tiles = root / "pointcloud_map.pcd"
    tiles.mkdir()
    corners = np.floor(p[:, :2] / tile).astype(np.int64)
    found, which = np.unique(corners, axis=0, return_inverse=True)
    lines = [f"x_resolution: {float(tile)}", f"y_resolution: {float(tile)}"]
    for k, corner in enumerate(found):
        x, y = (int(c * tile) for c in corner)
        write_pcd(tiles / f"{x}_{y}.pcd", p[which.ravel() == k])
        lines.append(f"{x}_{y}.pcd: [{x}, {y}]")
    _write(root / _TILES, lines)
    if datum is None:
        _write(root / _PROJECTOR, ["projector_type: Local"])
    else:
        origin = [f"  latitude: {datum[0]!r}", f"  longitude: {datum[1]!r}", "  altitude: 0.0"]
        _write(root / _PROJECTOR, ["projector_type: LocalCartesian", "vertical_datum: WGS84", "map_origin:", *origin])


def _write(path: Path, lines: list[str]) -> None:
    with atomic_open(path, "w") as stream:
        stream.write("\n".join(lines) + "\n")
