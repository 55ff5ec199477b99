"""Meshes of PLY files, as :func:`graphslam.io.mesh_file.write_mesh` writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ``(v, 3)`` and triangles ``(t, 3)``, by another program."""
    found = trimesh.load(path, process=False)
    return np.asarray(found.vertices, dtype=np.float64), np.asarray(found.faces, dtype=np.int32)
