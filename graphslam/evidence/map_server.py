"""Write a 2-D evidence grid as the two files of the ROS map server: image (PGM) and metadata (YAML)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import FormatError, GridError
from graphslam.evidence.formats import to_dense
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN

OCCUPIED, FREE, NOT_KNOWN = 0, 254, 205
"""Grey values of map_saver; they mean occupancy probabilities 1, 0.004 and 0.196."""
OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.196


def save_map_server(grid: EvidenceGrid, path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Write a 2-D grid as ``path`` (``.yaml``) and an image in the same folder (``.pgm``, binary).

    Voxels are occupied or free by the threshold of the model (mode ``trinary``). The image covers the bounding box of
    the known voxels; its lower left corner is the ``origin`` in the YAML file.

    Parameters
    ----------
    grid : EvidenceGrid
        2-D.
    path : path
        With the suffix ``.yaml``.
    """
    target = Path(path)
    if target.suffix != ".yaml":
        raise FormatError("unknown ending of a map description", where=str(path), got=target.suffix, wanted=".yaml")
    if grid.dim != 2:
        raise GridError("only a 2-D grid can be written as an image", where=str(path), got=f"{grid.dim}-D")
    dense = to_dense(grid)
    if dense.values.size == 0:
        raise GridError("a map in which nothing is known cannot be written as an image", where=str(path))
    occupied = dense.values >= grid.model.threshold_step  # UNKNOWN is below any threshold
    pixels = np.full(occupied.shape, FREE, np.uint8)
    pixels[occupied], pixels[dense.values == UNKNOWN] = OCCUPIED, NOT_KNOWN
    rows = np.ascontiguousarray(pixels.T[::-1])  # the first row of an image is its top, the largest y
    image = target.with_suffix(".pgm")
    with atomic_open(image) as stream:
        stream.write(f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode("ascii"))
        stream.write(rows.tobytes())
    x, y = dense.origin.tolist()
    with atomic_open(target, "w") as stream:
        stream.write(
            f"image: {_quoted(image.name)}\nmode: trinary\nresolution: {_number(grid.voxel_size)}\n"
            f"origin: [{_number(x)}, {_number(y)}, 0.0]\nnegate: 0\n"
            f"occupied_thresh: {OCCUPIED_ABOVE}\nfree_thresh: {FREE_BELOW}\n"
        )
    return target, image


def _quoted(name: str) -> str:
    """Single-quoted YAML string."""
    return "'" + name.replace("'", "''") + "'"


def _number(value: float) -> str:
    """Float in YAML 1.1 notation: with an exponent, a decimal point is required."""
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
