"""A simulated log and the place it was recorded in, in one folder.

The log is stored as :mod:`graphslam.io.log_store` stores it (one npz a stream, ``truth.npz``, ``log.json`` written
last), the mesh beside it as ``mesh.ply``, in the frame of the truth; ``meta["mesh"]`` names it.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam.core.atomic import read_json
from graphslam.core.errors import FormatError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.mesh import Triangles
from graphslam.core.reading import resolve_inside
from graphslam.io.log_store import INDEX_NAME, LOG_FORMAT, load_log, save_log
from graphslam.io.mesh_file import read_mesh, write_mesh

MESH_NAME = "mesh.ply"


def write_log_folder(log: SensorLog, path: str | os.PathLike[str], *, mesh: tuple[Any, Any] | None = None) -> Path:
    """Write a log, and the mesh it was recorded in; an older log in that folder is replaced.

    The folder is a log only when all is written: a run that is killed leaves none.

    Parameters
    ----------
    path : path
        Folder; made if missing.
    mesh : (v, 3), (t, 3), optional
        Vertices in the frame of the truth [m], and triangles.
    """
    root = Path(path)
    root.mkdir(parents=True, exist_ok=True)
    (root / INDEX_NAME).unlink(missing_ok=True)
    meta = dict(log.meta)
    if mesh is None:
        (root / MESH_NAME).unlink(missing_ok=True)
        if isinstance(meta.get("mesh"), dict):  # a folder read from elsewhere and written without its mesh
            meta["mesh"] = {k: v for k, v in meta["mesh"].items() if k != "file"}
    else:
        write_mesh(root / MESH_NAME, *mesh)
        meta["mesh"] = {"file": MESH_NAME, "vertices": len(mesh[0]), "triangles": len(mesh[1])}
    return save_log(replace(log, meta=meta), root)


def read_log_folder(path: str | os.PathLike[str]) -> SensorLog:
    """Read a log written by :func:`write_log_folder`; the mesh stays on disk (:func:`read_log_mesh`)."""
    return load_log(path)


def read_log_mesh(path: str | os.PathLike[str]) -> tuple[Array, Triangles] | None:
    """Mesh of a log folder: vertices ``(v, 3)`` in the truth's frame and triangles ``(t, 3)``; None if it has none."""
    root = Path(path)
    entry = _meta(root).get("mesh")
    if not isinstance(entry, dict) or "file" not in entry:
        return None
    if entry["file"] != MESH_NAME:
        raise FormatError(
            "mesh of another name", where=str(root / INDEX_NAME), got=repr(entry["file"]), wanted=MESH_NAME
        )
    vertices, triangles = read_mesh(resolve_inside(root, MESH_NAME, str(root / INDEX_NAME)))
    found = {"file": MESH_NAME, "vertices": len(vertices), "triangles": len(triangles)}
    if found != entry:
        raise FormatError("mesh and log do not agree", where=str(root / MESH_NAME), got=found, wanted=entry)
    return vertices, triangles


def _meta(root: Path) -> dict[str, Any]:
    """``meta`` of a log folder, no stream read."""
    where = resolve_inside(root, INDEX_NAME, str(root))
    meta = read_json(where, fmt=LOG_FORMAT).get("meta")
    if not isinstance(meta, dict):
        raise FormatError("key 'meta' is missing or of the wrong type", where=str(where), wanted="dict")
    return meta
