"""Writer of a simulated log and the mesh of its environment, in one folder.

The log is stored by :mod:`graphslam.io.log_store` (one npz per stream, ``truth.npz``, ``log.json`` written last), the
mesh as ``mesh.ply`` in the frame of the ground truth; ``meta["mesh"]`` has its name.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.io.log_store import INDEX_NAME, save_log
from graphslam.io.mesh_file import write_mesh

MESH_NAME = "mesh.ply"
_OURS = (".npz", ".ply", ".json", ".part", ".tmp")


def check_log_folder(path: str | os.PathLike[str]) -> None:
    """Raise :class:`DataError` if a folder for a log contains files that are not part of a log."""
    root = Path(path)
    if root.is_dir() and (others := sorted(p.name for p in root.iterdir() if p.suffix not in _OURS or p.is_dir())):
        raise DataError(
            "the folder for the log holds other files", where=str(root), got=others[0], wanted="a new or empty --out"
        )


def write_log_folder(log: SensorLog, path: str | os.PathLike[str], *, mesh: tuple[Any, Any] | None = None) -> Path:
    """Write a log and the mesh of its environment; an older log in the folder is replaced.

    ``log.json`` is written last, so an interrupted call leaves no valid log.

    Parameters
    ----------
    path : path
        Folder; created if missing.
    mesh : (v, 3), (t, 3), optional
        Vertices in the frame of the ground truth [m], and triangles.
    """
    check_log_folder(path)
    root = Path(path)
    root.mkdir(parents=True, exist_ok=True)
    (root / INDEX_NAME).unlink(missing_ok=True)
    meta = dict(log.meta)
    if mesh is None:
        (root / MESH_NAME).unlink(missing_ok=True)
        if isinstance(meta.get("mesh"), dict):  # the log came from another folder, without its mesh
            meta["mesh"] = {k: v for k, v in meta["mesh"].items() if k != "file"}
    else:
        write_mesh(root / MESH_NAME, *mesh)
        meta["mesh"] = {"file": MESH_NAME, "vertices": len(mesh[0]), "triangles": len(mesh[1])}
    return save_log(replace(log, meta=meta), root)
