"""Triangle meshes as PLY files."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import FormatError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.mesh import Triangles, check_mesh
from graphslam.core.reading import read_bytes

_VERTEX = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
_FACE = np.dtype([("count", "u1"), ("rows", "<i4", (3,))])
_LONGEST_HEADER = 4096


def _header(vertices: int, triangles: int) -> str:
    axes = "".join(f"property double {c}\n" for c in "xyz")
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{axes}"
        f"element face {triangles}\nproperty list uchar int vertex_indices\nend_header\n"
    )


def write_mesh(path: str | os.PathLike[str], vertices: Any, triangles: Any) -> None:
    """Write a mesh as a binary PLY file in double precision, whole or not at all.

    Parameters
    ----------
    vertices : (v, 3)
        [m]
    triangles : (t, 3)
        Rows of ``vertices``.
    """
    v, t = check_mesh(vertices, triangles, where=str(path))
    faces = np.empty(len(t), _FACE)
    faces["count"], faces["rows"] = 3, t
    with atomic_open(path) as stream:
        stream.write(_header(len(v), len(t)).encode("ascii"))
        stream.write(np.ascontiguousarray(v, dtype="<f8").tobytes())
        stream.write(faces.tobytes())


def read_mesh(path: str | os.PathLike[str]) -> tuple[Array, Triangles]:
    """Read what :func:`write_mesh` wrote, bit for bit.

    Returns
    -------
    (v, 3), (t, 3) int32
    """
    where = str(path)
    data = read_bytes(path)
    end = data.find(b"end_header\n", 0, _LONGEST_HEADER)
    if not data.startswith(b"ply\n") or end < 0:
        raise FormatError("no PLY file, or its header is damaged", where=where)
    begin = end + len(b"end_header\n")
    text = data[:begin].decode("ascii", errors="replace")
    counts = {w[1]: w[2] for w in (line.split() for line in text.splitlines()) if w[:1] == ["element"] and len(w) == 3}
    try:
        n, m = int(counts["vertex"]), int(counts["face"])
    except (KeyError, ValueError):
        n = m = -1
    if n < 0 or m < 0 or text != _header(n, m):
        raise FormatError("PLY file of another kind", where=where, wanted="binary, double vertices, triangles only")
    size = begin + n * _VERTEX.itemsize + m * _FACE.itemsize
    if len(data) != size:
        raise FormatError("truncated, or too long", where=where, got=f"{len(data)} bytes", wanted=f"{size}")
    vertices = np.frombuffer(data, "<f8", 3 * n, begin).reshape(n, 3).astype(np.float64)
    faces = np.frombuffer(data, _FACE, m, begin + n * _VERTEX.itemsize)
    if np.any(faces["count"] != 3):
        k = int(np.flatnonzero(faces["count"] != 3)[0])
        raise FormatError(f"face {k} is no triangle", where=where, got=int(faces["count"][k]), wanted="3 vertices")
    try:
        return check_mesh(vertices, faces["rows"].astype(np.int32), where=where)
    except GeometryError as error:
        raise FormatError(error.what, where=where, got=error.got, wanted=error.wanted) from None
