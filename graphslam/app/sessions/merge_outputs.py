"""Outputs of a merge: one state, written and replaced as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from graphslam.app.folders.generations import FolderTransaction, current_outputs, is_empty, new_generation
from graphslam.app.report.report import add_report
from graphslam.app.run.files import MERGED_DENSE_FORMAT, MERGED_FORMAT
from graphslam.app.run.outputs import graph_metrics, landmarks_csv
from graphslam.app.run.surface import RunSurface, draw_surface, write_surface
from graphslam.app.sessions.merge_dense import MergedSubmaps
from graphslam.app.sessions.merged_map import MergedMap
from graphslam.core.atomic import write_npz
from graphslam.core.errors import RunFolderError
from graphslam.core.lock import lock_folder, make_folder
from graphslam.core.tables import csv_text
from graphslam.evaluate.residual_consistency import class_consistency
from graphslam.graph.ledger import COLUMNS
from graphslam.io.tum import write_tum
from graphslam.plots.save import save_figure

MOST_STATES = 6000
"""With more states, χ² by factor class is not computed: with robust kernels this needs dense matrices."""


SAME_BYTES = (
    *("merge.json", "merged.npz", "landmarks.csv", "trajectory_*.tum", "events.jsonl", "metrics.json", "ledger.csv"),
    "figures/map.png",
)
"""Files of a merged folder that have the same bytes whenever the same runs are merged."""


@contextmanager
def merged_folder(path: str | Path, *, anew: bool = False) -> Iterator[Path]:
    """Make the folder of a merge, or use an empty one; it is locked until the block ends.

    Parameters
    ----------
    anew : bool
        A folder with an earlier merge is accepted, too.
    """
    folder = make_folder(path)

    def check() -> None:
        if not (anew and (current_outputs(folder) / "merge.json").is_file()) and not is_empty(folder):
            raise RunFolderError(f"{folder}: not empty; choose another --out")

    check()  # before a lock file is created in another person's folder
    with lock_folder(folder):
        check()
        yield folder


def write_merged(
    path: Path, merged: MergedMap | MergedSubmaps, *, surface: RunSurface | None = None, colour: str = "session"
) -> None:
    """Write a merge, by landmarks or of dense submaps, as a new state of its folder.

    ``merged.npz``, ``landmarks.csv`` (of landmark maps), one ``trajectory_<session>.tum`` each, metrics, events, a
    picture, ``merge.json``; and the files of the surface of all sessions, if it was made.
    """
    with new_generation(path) as new:
        if isinstance(merged, MergedMap):
            _write_landmarks(new, merged)
        else:
            _write_dense(new, merged)
        if surface is not None:
            write_surface(new, surface, colour=colour)
            draw_surface(surface, new.figures, name=" and ".join(s.name for s in merged.sessions))
        _finish(new, merged)


def _write_landmarks(folder: FolderTransaction, merged: MergedMap) -> None:
    path = folder.path
    for s in merged.sessions:
        write_tum(path / f"trajectory_{s.name}.tum", s.map.trajectory)
    folder.write_text("landmarks.csv", landmarks_csv(merged.sessions[0].map))
    joint = merged.solution.joint_marginal(f"l{i}" for i in merged.landmark_ids.tolist())
    write_npz(
        path / "merged.npz",
        {
            "format": MERGED_FORMAT,
            "sessions": np.array([s.name for s in merged.sessions]),
            "first_bases": merged.solution.poses[[s.first_node for s in merged.sessions]],
            "first_base_covariances": np.array([s.map.node_covariances[0] for s in merged.sessions]),
            "landmark_ids": merged.landmark_ids,
            "landmarks": merged.landmarks,
            "landmark_joint_covariance": joint,
            "landmark_sessions": merged.landmark_sessions,
        },
    )


def _write_dense(folder: FolderTransaction, merged: MergedSubmaps) -> None:
    path = folder.path
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


def _finish(folder: FolderTransaction, merged: MergedMap | MergedSubmaps) -> None:
    """Write the files of both kinds of merged maps."""
    folder.write_lines("events.jsonl", merged.graph.events)
    folder.write_json("metrics.json", merged.metric_rows)
    save_figure(merged.plot(), folder.figures / "map.png")
    folder.write_text("ledger.csv", csv_text(merged.graph.ledger.rows(), COLUMNS))
    classes = class_consistency(merged.graph) if merged.solution.states <= MOST_STATES else {}
    report = dict(merged.report)
    seconds = float(report.pop("seconds"))
    folder.write_json("timings.json", [{"key": "seconds_merge", "value": seconds, "unit": "s", "direction": "lower"}])
    folder.write_json("merge.json", {**report, "graph": graph_metrics(merged.graph, classes)})
    add_report(folder)
