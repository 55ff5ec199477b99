"""Writer of a simulated log and the mesh of its environment, in one folder.

The log is stored by :mod:`graphslam.io.log_store` (one npz per stream, ``truth.npz``, ``log.json`` written last), the
mesh as ``mesh.ply`` in the frame of the ground truth; ``meta["mesh"]`` has its name.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam.core.log import SensorLog
from graphslam.core.output_folder import output_folder
from graphslam.io.log_store import INDEX_NAME, save_log
from graphslam.io.mesh_file import write_mesh

MESH_NAME = "mesh.ply"
KIND = "log"
"""See :func:`~graphslam.core.output_folder.check_folder_target`."""


def write_log_folder(log: SensorLog, path: str | os.PathLike[str], *, mesh: tuple[Any, Any] | None = None) -> Path:
    """Write a log and the mesh of its environment; an older log in the folder is replaced.

    Parameters
    ----------
    path : path
        Folder, new or empty or of an older log; created if missing.
    mesh : (v, 3), (t, 3), optional
        Vertices in the frame of the ground truth [m], and triangles.
    """
    meta = dict(log.meta)
    if mesh is not None:
        meta["mesh"] = {"file": MESH_NAME, "vertices": len(mesh[0]), "triangles": len(mesh[1])}
    elif isinstance(meta.get("mesh"), dict):  # the log came from another folder, without its mesh
        meta["mesh"] = {k: v for k, v in meta["mesh"].items() if k != "file"}
    with output_folder(path, KIND, last=(INDEX_NAME,)) as folder:
        if mesh is not None:
            write_mesh(folder / MESH_NAME, *mesh)
        save_log(replace(log, meta=meta), folder)
    return Path(path)
