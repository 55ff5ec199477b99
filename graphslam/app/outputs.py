"""What a run leaves on disk beside its submaps; every file is whole or not there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from graphslam.app.figures import save_figures
from graphslam.app.run import GlobalMap, Run
from graphslam.app.run_files import (
    ASSOCIATION_FORMAT,
    FIXES_FORMAT,
    GPS_FORMAT,
    MAP_FORMAT,
    read_association,
    read_events,
    read_fixes,
    read_gps_residuals,
    read_ledger,
    read_map,
    read_metrics,
    read_report,
)
from graphslam.app.run_folder import RunFolder
from graphslam.app.run_maps import draw_run_map, write_run_map
from graphslam.core.atomic import write_npz
from graphslam.core.errors import RunFolderError
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.network import to_network
from graphslam.io.g2o import write_g2o
from graphslam.io.submap_store import read_submaps, read_truth, write_truth
from graphslam.io.tum import read_tum, write_tum


def write_outputs(folder: RunFolder, run: Run) -> None:
    """Write everything of the run folder but ``config.toml`` and ``submaps/``, which are there already."""
    m = run.map
    write_tum(folder.path / "trajectory.tum", m.trajectory)
    write_tum(folder.path / "nodes.tum", Trajectory(m.node_times, m.node_poses))
    folder.write_text("landmarks.csv", landmarks_csv(m))
    write_npz(folder.path / "map.npz", _map_arrays(m))
    write_npz(folder.path / "association.npz", _association_arrays(run.submaps))
    if run.graph is not None:
        write_g2o(folder.path / "graph.g2o", to_network(run.graph))
    if run.truth is not None:
        write_truth(folder.path, run.truth)
    for name, path in (("truth.tum", run.truth_path), ("dead_reckoning.tum", run.dead_reckoning)):
        if path is not None:
            write_tum(folder.path / name, path)
    for name, r in run.gps.items():
        arrays = {f.name: np.asarray(getattr(r, f.name)) for f in dataclasses.fields(r)}
        write_npz(folder.path / f"gps_{name}.npz", {"format": GPS_FORMAT, **arrays})
    if run.fixes is not None:
        g = run.fixes
        arrays = {"times": g.times, "positions": g.positions, "sigma": g.sigma, "lever": g.lever}
        write_npz(folder.path / "fixes.npz", {"format": FIXES_FORMAT, **arrays})
    folder.write_lines("events.jsonl", run.events)
    if run.ledger is not None:
        folder.write_text("ledger.csv", run.ledger.to_csv(index=False))
    folder.write_json("metrics.json", run.metrics.to_dict("records"))
    save_figures(run, folder.figures)
    if run.fused is not None:
        write_run_map(folder.path, run.fused)
        draw_run_map(run.fused, m.trajectory, folder.figures, name=run.name)
    folder.write_json("run.json", run.report)  # last: its presence says that the run is finished
    from graphslam.app.report import report_beside  # the page is made from the files, so they come first

    report_beside(folder.path)


def landmarks_csv(m: GlobalMap) -> str:
    """``id,x,y,cov_xx,cov_xy,cov_yy,hits`` in the frame of the first base [m, m²]."""
    P = m.landmark_covariances
    table = pd.DataFrame(
        {
            "id": m.landmark_ids,
            "x": m.landmarks[:, 0],
            "y": m.landmarks[:, 1],
            "cov_xx": P[:, 0, 0],
            "cov_xy": P[:, 0, 1],
            "cov_yy": P[:, 1, 1],
            "hits": m.landmark_hits,
        }
    )
    return str(table.to_csv(index=False, float_format="%.9g"))


def _map_arrays(m: GlobalMap) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "format": MAP_FORMAT,
        "trajectory_times": m.trajectory.times,
        "trajectory_poses": m.trajectory.poses,
        "trajectory_covariances": m.trajectory.covariances,
    }
    for name in ("node_times", "node_poses", "node_covariances", "landmark_ids", "landmarks", "landmark_covariances"):
        arrays[name] = getattr(m, name)
    arrays["landmark_hits"] = m.landmark_hits
    for name in ("T_gps_world", "base_nodes"):
        if getattr(m, name) is not None:
            arrays[name] = getattr(m, name)
    return arrays


def _association_arrays(submaps: Any) -> dict[str, Any]:
    ids = [s.landmarks.ids if s.landmarks is not None else np.zeros(0, dtype=np.int64) for s in submaps]
    return {
        "format": ASSOCIATION_FORMAT,
        "keys": np.array([s.key for s in submaps], dtype=np.int64),
        "offsets": np.concatenate([[0], np.cumsum([len(i) for i in ids])]).astype(np.int64),
        "ids": np.concatenate(ids) if ids else np.zeros(0, dtype=np.int64),
    }


def identified_submaps(path: str | Path) -> list[Submap]:
    """Submaps of a store or of a run folder; a run's carry the identities of its back end."""
    path = Path(path)
    submaps = read_submaps(path)
    if not (path / "association.npz").is_file():
        return submaps
    ids = read_association(path)
    return [
        s.with_ids(ids[s.key]) if s.landmarks is not None and len(ids.get(s.key, ())) == len(s.landmarks) else s
        for s in submaps
    ]


def open_run(path: str | Path) -> Run:
    """Read a finished run folder.

    Raises
    ------
    RunFolderError
        Not a finished run.
    FormatError
    """
    root = Path(path)
    if not (root / "run.json").is_file():
        hint = (
            "run again with --resume" if (root / "config.toml").is_file() else "give a folder that graphslam run wrote"
        )
        raise RunFolderError(f"{root}: not a finished run; {hint}")
    report, m = read_report(root), read_map(root)
    return Run(
        name=str(report["source"]),
        submaps=identified_submaps(root),
        map=m,
        metrics=read_metrics(root),
        report=report,
        events=read_events(root) if (root / "events.jsonl").is_file() else [],
        ledger=read_ledger(root) if (root / "ledger.csv").is_file() else None,
        folder=root,
        gps={p.stem.removeprefix("gps_"): read_gps_residuals(p) for p in sorted(root.glob("gps_*.npz"))},
        fixes=read_fixes(root),
        truth=read_truth(root),
        truth_path=_path(root / "truth.tum", m.dim),
        dead_reckoning=_path(root / "dead_reckoning.tum", m.dim),
    )


def _path(file: Path, dim: int) -> Trajectory | None:
    return read_tum(file, dim=dim) if file.is_file() else None
