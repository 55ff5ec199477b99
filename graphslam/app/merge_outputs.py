"""What a merge leaves on disk; every file is whole or not there, ``merge.json`` last."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphslam.app.merge import MergedMap
from graphslam.app.outputs import landmarks_csv
from graphslam.app.run_folder import RunFolder
from graphslam.core.atomic import write_npz
from graphslam.core.errors import RunFolderError
from graphslam.io.tum import write_tum
from graphslam.plots.save import save

MERGED_FORMAT = "graphslam.merged-map/1"


def write_merged(path: Path, merged: MergedMap) -> None:
    """Write ``merged.npz``, ``landmarks.csv``, one ``trajectory_<session>.tum`` each, metrics, events and a picture.

    Raises
    ------
    RunFolderError
        The folder holds something already, or cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be made ({error.strerror})") from None
    if any(path.iterdir()):
        raise RunFolderError(f"{path}: not empty; choose another --out")
    folder = RunFolder(path)
    for s in merged.sessions:
        write_tum(path / f"trajectory_{s.name}.tum", s.map.trajectory)
    folder.write_text("landmarks.csv", landmarks_csv(merged.sessions[0].map))
    columns = merged.solution.covariance.layout.columns_of([f"l{i}" for i in merged.landmark_ids.tolist()])
    write_npz(
        path / "merged.npz",
        {
            "format": MERGED_FORMAT,
            "sessions": np.array([s.name for s in merged.sessions]),
            "first_bases": merged.solution.poses[[s.first_node for s in merged.sessions]],
            "first_base_covariances": np.array([s.map.node_covariances[0] for s in merged.sessions]),
            "landmark_ids": merged.landmark_ids,
            "landmarks": merged.landmarks,
            "landmark_joint_covariance": merged.solution.covariance.columns(columns),
            "landmark_sessions": merged.landmark_sessions,
        },
    )
    folder.write_lines("events.jsonl", merged.graph.events)
    folder.write_json("metrics.json", merged.metrics.to_dict("records"))
    save(merged.plot(), folder.figures / "map.png")
    folder.write_json("merge.json", merged.report)
