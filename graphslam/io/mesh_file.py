"""Writer of triangle meshes as PLY files."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.mesh import check_mesh

_FACE = np.dtype([("count", "u1"), ("rows", "<i4", (3,))])


def _header(vertices: int, triangles: int) -> str:
    axes = "".join(f"property double {c}\n" for c in "xyz")
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{axes}"
        f"element face {triangles}\nproperty list uchar int vertex_indices\nend_header\n"
    )


def write_mesh(path: str | os.PathLike[str], vertices: Any, triangles: Any) -> None:
    """Write a mesh as a binary PLY file in double precision, atomically.

    Parameters
    ----------
    vertices : (v, 3)
        [m]
    triangles : (t, 3)
        Row indices of ``vertices``.
    """
    v, t = check_mesh(vertices, triangles, where=str(path))
    faces = np.empty(len(t), _FACE)
    faces["count"], faces["rows"] = 3, t
    with atomic_open(path) as stream:
        stream.write(_header(len(v), len(t)).encode("ascii"))
        stream.write(np.ascontiguousarray(v, dtype="<f8").tobytes())
        stream.write(faces.tobytes())
