"""What a merge leaves on disk; every file is whole or not there, ``merge.json`` last."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphslam.app.graph_facts import graph_facts
from graphslam.app.merge import MergedMap
from graphslam.app.merge_dense import MergedSubmaps
from graphslam.app.outputs import landmarks_csv
from graphslam.app.report import report_beside
from graphslam.app.run_files import MERGED_DENSE_FORMAT, MERGED_FORMAT
from graphslam.app.run_folder import RunFolder
from graphslam.core.atomic import write_npz
from graphslam.evaluate.without_truth import class_consistency
from graphslam.io.tum import write_tum
from graphslam.plots.save import save

MOST_STATES = 6000
"""Of a graph with more free scalars χ² is not told by class: that takes dense matrices where kernels are at work."""


def write_merged(path: Path, merged: MergedMap) -> None:
    """Write ``merged.npz``, ``landmarks.csv``, one ``trajectory_<session>.tum`` each, metrics, events and a picture.

    Raises
    ------
    RunFolderError
        The folder holds something already, or cannot be made.
    """
    folder = RunFolder.new(path)
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
    _finish(folder, merged)


def write_merged_dense(path: Path, merged: MergedSubmaps) -> None:
    """Write ``merged.npz``, one ``trajectory_<session>.tum`` each, metrics, events, a picture; ``merge.json`` last.

    Raises
    ------
    RunFolderError
        The folder holds something already, or cannot be made.
    """
    folder = RunFolder.new(path)
    for s in merged.sessions:
        write_tum(path / f"trajectory_{s.name}.tum", s.trajectory)
    nodes = merged.solution.base_nodes
    write_npz(
        path / "merged.npz",
        {
            "format": MERGED_DENSE_FORMAT,
            "sessions": np.array([s.name for s in merged.sessions]),
            "session_of_submap": np.repeat(
                np.arange(len(merged.sessions)), [len(s.session.submaps) for s in merged.sessions]
            ),
            "keys": np.concatenate([[m.key for m in s.run.submaps] for s in merged.sessions]),
            "bases": merged.solution.poses[nodes],
            "base_covariances": merged.solution.node_covariances()[nodes],
            "nodes": merged.solution.poses,
        },
    )
    _finish(folder, merged)


def _finish(folder: RunFolder, merged: MergedMap | MergedSubmaps) -> None:
    """What both kinds of merged maps have; ``merge.json`` last."""
    folder.write_lines("events.jsonl", merged.graph.events)
    folder.write_json("metrics.json", merged.metrics.to_dict("records"))
    save(merged.plot(), folder.figures / "map.png")
    folder.write_text("ledger.csv", merged.graph.ledger.table().to_csv(index=False))
    classes = class_consistency(merged.graph) if merged.solution.states <= MOST_STATES else {}
    folder.write_json("merge.json", {**merged.report, "graph": graph_facts(merged.graph, classes)})
    report_beside(folder.path)
