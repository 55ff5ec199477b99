"""Triangle meshes: arrays of vertices and vertex indices."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask

Triangles = npt.NDArray[np.int32]


def check_mesh(vertices: Any, triangles: Any, *, where: str | None = None) -> tuple[Array, Triangles]:
    """A mesh as vertices ``(v, 3)`` float64 and triangles ``(t, 3)`` int32, both contiguous."""
    v, t = np.ascontiguousarray(vertices, dtype=np.float64), np.asarray(triangles)
    if v.ndim != 2 or v.shape[1] != 3:
        raise GeometryError("vertices of a mesh have the wrong shape", where=where, got=v.shape, wanted="(v, 3)")
    if t.ndim != 2 or t.shape[1] != 3 or t.dtype.kind not in "iu":
        raise GeometryError(
            "triangles of a mesh have the wrong shape or type",
            where=where,
            got=f"{t.dtype} {t.shape}",
            wanted="integers (t, 3)",
        )
    if not np.all(finite_mask(v)):
        k = int(np.argwhere(~finite_mask(v))[0][0])
        raise GeometryError(f"vertex {k} of a mesh is not finite", where=where, got=v[k], wanted="finite numbers")
    bad = np.flatnonzero(np.any((t < 0) | (t >= len(v)), axis=1))
    if len(bad):
        k = int(bad[0])
        raise GeometryError(f"triangle {k} names no vertex", where=where, got=t[k], wanted=f"0 … {len(v) - 1}")
    return v, np.ascontiguousarray(t, dtype=np.int32)
