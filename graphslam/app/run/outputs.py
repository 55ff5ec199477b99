"""Write and read the outputs of a run, except its submaps: one state, replaced as a whole."""

from __future__ import annotations

import dataclasses
import filecmp
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import FolderTransaction, new_generation, read_consistently
from graphslam.app.folders.output_files import json_lines
from graphslam.app.report.report import add_report
from graphslam.app.run.files import (
    ASSOCIATION_FORMAT,
    FIXES_FORMAT,
    GENERATION_EVENT,
    GPS_FORMAT,
    MAP_FORMAT,
    RESUMED,
    check_state,
    read_association,
    read_events,
    read_fixes,
    read_gps_residuals,
    read_ledger,
    read_map,
    read_metrics,
    read_report,
)
from graphslam.app.run.maps import draw_run_map, write_run_map
from graphslam.app.run.run import Run
from graphslam.app.run.run_inputs import write_inputs
from graphslam.core.atomic import write_npz
from graphslam.core.digest import Digest
from graphslam.core.errors import FormatError, RunFolderError
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.core.tables import csv_text
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.metrics import is_time
from graphslam.evaluate.residual_consistency import ClassConsistency
from graphslam.evidence.spilled_grid import load_spilled
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.ledger import COLUMNS
from graphslam.graph.network import to_network
from graphslam.io.g2o import write_g2o
from graphslam.io.submap_store import SubmapStore, read_submaps, read_truth, write_truth
from graphslam.io.tum import read_tum, write_tum
from graphslam.join.graph_problem import JoinProblem
from graphslam.loops.ledger import COLUMNS as LOOP_COLUMNS
from graphslam.loops.ledger import LoopLedger, ledger_of_events
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.refined import base_frames

logger = logging.getLogger(__name__)
OF_THE_CLOCK = ("seconds", RESUMED)
"""Parts of a run's report that depend on time or on resuming: in ``timings.json``, not in ``run.json``."""


SAME_BYTES = (
    *("config.toml", "draws.json", "submaps/*", "run.json", "metrics.json", "events.jsonl", "ledger.csv"),
    *("landmarks.csv", "map.npz"),
    *("association.npz", "graph.g2o", "graph.npz", "trajectory.tum", "nodes.tum"),
    *("truth.npz", "truth.tum", "dead_reckoning.tum"),
    *("gps_*.npz", "fixes.npz", "inputs.npz", "inputs/*", "fused_map.json", "map.ply", "map.bt", "cloud.ply"),
    *("two_maps/*",),
    *("scans.npz", "trajectory_graph.tum", "refined/*", "figures/refined.png"),
    *("map*.pgm", "map*.yaml", "figures/map.png", "figures/side.png", "figures/submaps.png", "figures/loops.png"),
    *("figures/gps_*.png", "figures/fused*.png"),
)
"""Files of a run folder that have the same bytes after a kill and a resume, after undoing and redoing a loop, and in
two runs of one configuration. The others contain times (``timings.json``, and a part of ``report.html``)."""
_MADE_OF_MAP = (
    "map.grid.npz",
    "map.kml",
    "map.geojson",
    "clearest*",
    "alternatives/*",
    "*.kml",
    "*.geojson",
    "path.tum",
    "path.kitti.txt",
)
"""Files that other commands made from a map; they stay as long as the map is the same."""


TWO_MAPS = ("two_maps/first", "two_maps/second")
"""Path (``.tum``) and loops (``.csv``) of two contradictory maps, if it is undecided which one is right."""
REFINED = "refined"
"""Folder with the submaps along the refined path."""
SAME_FRAME = 1e-6
"""Largest difference between end poses of the refined submaps and nodes of the map [m], [rad]."""


GRAPH = "graph.npz"
"""The graph with all its factors and values, as input of the map-joining methods."""


def write_outputs(folder: Path, run: Run) -> Run:
    """Write a new state of a run folder: everything except ``config.toml`` and ``submaps/``, which exist already.

    Returns
    -------
    Run
        With its folder, and the id of its generation in its report.
    """
    run = replace(run, folder=folder, report={**run.report, "generation": generation_id(run)})
    with new_generation(folder) as new:
        for write in WRITERS:
            write(new, run)
    return run


def _write_paths(new: FolderTransaction, run: Run) -> None:
    """The solved path and paths to compare it with; for two contradictory maps the path of each.

    Each of the two has a ledger in which the loops of that map only are accepted, too.
    """
    m = run.map
    paths = {"trajectory": m.trajectory, "nodes": Trajectory(m.node_times, m.node_poses), "truth": run.truth_path}
    paths |= {"dead_reckoning": run.dead_reckoning, "trajectory_graph": run.graph_path}
    for name, path in paths.items():
        if path is not None:
            write_tum(new.path / f"{name}.tum", path)
    if run.truth is not None:
        write_truth(new.path, run.truth)
    if run.two_maps is None:
        return
    current = ledger_of_events(run.events).current()
    for name, path, loops in zip(TWO_MAPS, run.two_maps, run.report["two_maps"]["loops"]):
        (new.path / name).parent.mkdir(exist_ok=True)
        write_tum(new.path / f"{name}.tum", path)
        inside = [replace(d, verdict="accepted") if d.loop in loops else d for d in current]
        new.write_text(f"{name}.csv", csv_text(LoopLedger(inside).rows(), LOOP_COLUMNS))


def _write_map(new: FolderTransaction, run: Run) -> None:
    new.write_text("landmarks.csv", landmarks_csv(run.map))
    _write_marked(new, run, "map.npz", _map_arrays(run.map))
    _write_marked(new, run, "association.npz", _association_arrays(run.submaps))


def _write_graph(new: FolderTransaction, run: Run) -> None:
    if run.graph is not None:
        write_g2o(new.path / "graph.g2o", to_network(run.graph))
        JoinProblem.of_graph(run.graph).save(new.path / GRAPH)


def _write_refined(new: FolderTransaction, run: Run) -> None:
    if run.refined is not None:
        store = SubmapStore(new.path / REFINED)
        for s in run.refined.submaps:
            store.append(s)


def _write_gps(new: FolderTransaction, run: Run) -> None:
    for name, r in run.gps.items():
        arrays = {f.name: np.asarray(getattr(r, f.name)) for f in dataclasses.fields(r)}
        _write_marked(new, run, f"gps_{name}.npz", {"format": GPS_FORMAT, **arrays})
    if run.fixes is not None:
        g = run.fixes
        arrays = {"times": g.times, "positions": g.positions, "sigma": g.sigma, "lever": g.lever}
        _write_marked(new, run, "fixes.npz", {"format": FIXES_FORMAT, **arrays})


def _write_inputs(new: FolderTransaction, run: Run) -> None:
    if run.inputs is None:
        return
    try:
        write_inputs(new.path, run.inputs, run.report["generation"])
    except FormatError as error:
        logger.warning("no loop closure of this run can be undone: the inputs of its graph are not stored (%s)", error)


def _write_tables(new: FolderTransaction, run: Run) -> None:
    new.write_lines("events.jsonl", [{"event": GENERATION_EVENT, "generation": run.report["generation"]}, *run.events])
    if run.ledger_rows is not None:
        new.write_text("ledger.csv", csv_text(run.ledger_rows, COLUMNS))
    new.write_json("metrics.json", metric_rows(run))
    new.write_json("timings.json", timing_rows(run))
    new.write_json("run.json", {k: v for k, v in run.report.items() if k not in OF_THE_CLOCK})


def _write_figures(new: FolderTransaction, run: Run) -> None:
    from graphslam.app.run.figures import save_figures  # Matplotlib: not loaded by runs without a folder

    save_figures(run, new.figures)


def _write_fused_map(new: FolderTransaction, run: Run) -> None:
    if run.fused is not None:
        write_run_map(new, run.fused, run.report["generation"])
        draw_run_map(run.fused, run.map.trajectory, new.figures, name=run.name, truth=run.truth_path)


def _write_report(new: FolderTransaction, run: Run) -> None:
    """The report page, made from the files. If the map is the same, files that other commands made of it are kept."""
    before = new.before
    if before is not None and _same_file(before / "map.npz", new.path / "map.npz"):
        for pattern in _MADE_OF_MAP:
            new.adopt(only=pattern)
    add_report(new)


WRITERS: tuple[Callable[[FolderTransaction, Run], None], ...] = (
    *(_write_paths, _write_map, _write_graph, _write_refined, _write_gps, _write_inputs, _write_tables),
    *(_write_figures, _write_fused_map, _write_report),
)
"""Functions that each write a part of a run folder, in this order."""


def _write_marked(new: FolderTransaction, run: Run, name: str, arrays: dict[str, Any]) -> None:
    """Write arrays with the id of the generation that they belong to."""
    write_npz(new.path / name, {**arrays, "generation": run.report["generation"]})


def metric_rows(run: Run) -> list[dict[str, Any]]:
    """Rows of ``metrics.json``: all metrics except times."""
    return [r for r in run.metric_rows if not is_time(r["key"])]


def timing_rows(run: Run) -> list[dict[str, Any]]:
    """Rows of ``timings.json``: times, and the number of submaps that were resumed."""
    resumed = {"key": RESUMED, "value": float(run.report.get(RESUMED, 0)), "unit": "", "direction": "none"}
    return [*(r for r in run.metric_rows if is_time(r["key"])), resumed]


def generation_id(run: Run) -> str:
    """Digest of the results: the same map, identities, events and metrics have the same id."""
    parts: list[tuple[str, Any]] = sorted(_map_arrays(run.map).items())
    parts += sorted(_association_arrays(run.submaps).items())
    parts += [(n, json_lines(rows).encode()) for n, rows in (("events", run.events), ("metrics", metric_rows(run)))]
    d = Digest()
    for name, value in parts:
        d.add(name, value)
    return d.text()


def _same_file(a: Path, b: Path) -> bool:
    return a.is_file() and b.is_file() and filecmp.cmp(a, b, shallow=False)


def landmarks_csv(m: GlobalMap) -> str:
    """``id,x,y,cov_xx,cov_xy,cov_yy,hits`` in the frame of the first base [m, m²]; in 3-D also z."""
    P, axes = m.landmark_covariances, "xyz"[: m.dim]
    columns = {"id": m.landmark_ids, **{a: m.landmarks[:, i] for i, a in enumerate(axes)}}
    pairs = [(i, j) for i in range(m.dim) for j in range(i, m.dim)]
    columns |= {f"cov_{axes[i]}{axes[j]}": P[:, i, j] for i, j in pairs}
    columns |= {"hits": m.landmark_hits}
    rows = [{c: f"{v:.9g}" for c, v in zip(columns, row)} for row in zip(*columns.values())]
    return csv_text(rows, list(columns))


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
    """Submaps of a store or of a run folder; those of a run have the identities of its back end."""
    return read_consistently(path, lambda root: _identified(Path(path), root))


def _identified(home: Path, root: Path) -> list[Submap]:
    submaps = read_submaps(home)
    if not (root / "association.npz").is_file():
        return submaps
    ids = read_association(root)
    return [
        s.with_ids(ids[s.key]) if s.landmarks is not None and len(ids.get(s.key, ())) == len(s.landmarks) else s
        for s in submaps
    ]


def read_run_folder(path: str | Path) -> Run:
    """Read a finished run folder; all files are of the same state.

    Examples
    --------
    >>> run = gs.open_run("runs/vp")
    >>> run.plot()
    """
    return read_consistently(path, lambda root: _open(Path(path), root))


def _open(home: Path, root: Path) -> Run:
    if not (root / "run.json").is_file():
        hint = (
            "run again with --resume" if (home / "config.toml").is_file() else "give a folder that graphslam run wrote"
        )
        raise RunFolderError(f"{home}: not a finished run; {hint}")
    report, m = read_report(root), read_map(root)
    metrics = read_metrics(root)
    if (root / "timings.json").is_file():
        timings = read_metrics(root, "timings.json")
        values = {r["key"]: r["value"] for r in timings if r["value"] == r["value"]}  # NaN: not measured
        report[RESUMED] = int(values.pop(RESUMED, 0.0))
        report["seconds"] = {k.removeprefix("seconds_"): v for k, v in values.items() if k.startswith("seconds_")}
        metrics += [r for r in timings if r["key"] != RESUMED]
    if root == home:  # plain files: a copy, or from an older version
        check_state(root)
    _check_submaps(home, root)
    return Run(
        name=str(report["source"]),
        submaps=_identified(home, root),
        map=m,
        metric_rows=metrics,
        report=report,
        events=read_events(root) if (root / "events.jsonl").is_file() else [],
        ledger_rows=read_ledger(root) if (root / "ledger.csv").is_file() else None,
        folder=home,
        gps={p.stem.removeprefix("gps_"): read_gps_residuals(p) for p in sorted(root.glob("gps_*.npz"))},
        fixes=read_fixes(root),
        truth=read_truth(root),
        truth_path=_path(root / "truth.tum", m.dim),
        dead_reckoning=_path(root / "dead_reckoning.tum", m.dim),
        graph_path=_path(root / "trajectory_graph.tum", m.dim),
        two_maps=_two_maps(root, m.dim),
    )


def refined_submaps_of(run: Run) -> list[Submap]:
    """Submaps of a run along its refined path, with their dense maps; empty without refinement."""
    if run.refined is not None:
        return run.refined.submaps
    if run.folder is None:
        return []
    return read_consistently(run.folder, lambda root: _refined_of(run, root / REFINED))


def _refined_of(run: Run, store: Path) -> list[Submap]:
    if not store.is_dir():
        return []
    submaps, where = read_submaps(store, load_grid=load_spilled), str(store)
    have, wanted = [s.key for s in submaps], [s.key for s in run.submaps]
    if have != wanted:
        raise FormatError("refined submaps do not belong to this run", where=where, got=have[:9], wanted=wanted[:9])
    frames = base_frames(run.map)
    g = group_of(frames)
    exits = g.between(frames[:-1], frames[1:])
    if submaps[0].dim != run.map.dim:
        raise FormatError("refined submaps have another dimension", where=where, got=submaps[0].dim)
    off = np.abs(g.log(g.between(exits, np.array([s.exit_pose for s in submaps]))))
    if off.max() > SAME_FRAME:
        raise FormatError(
            "refined submaps do not match the path of map.npz; copy the whole folder",
            where=where,
            got=f"{off.max():.3g} m or rad apart",
            wanted="0",
        )
    return submaps


def _check_submaps(home: Path, root: Path) -> None:
    """Raise an error if the submaps in the store are not those of the map, for example after damage."""
    if not (root / "association.npz").is_file():
        return
    have, wanted = [e["key"] for e in SubmapStore(home).entries], [*read_association(root)]
    if have != wanted:
        raise FormatError(
            "submaps do not match association.npz; run again with --resume",
            where=str(home / "submaps" / "index.json"),
            got=f"{len(have)} submaps",
            wanted=f"{len(wanted)}, to key {wanted[-1] if wanted else None}",
        )


def _path(file: Path, dim: int) -> Trajectory | None:
    return read_tum(file, dim=dim) if file.is_file() else None


def _two_maps(root: Path, dim: int) -> tuple[Trajectory, Trajectory] | None:
    first, second = (_path(root / f"{name}.tum", dim) for name in TWO_MAPS)
    return None if first is None or second is None else (first, second)


def graph_metrics(graph: FactorGraph, classes: Mapping[str, ClassConsistency]) -> dict[str, Any]:
    """JSON-serialisable metrics of a graph at its optimum.

    Parameters
    ----------
    classes : mapping of str to ClassConsistency
        Of this graph (:func:`graphslam.evaluate.residual_consistency.class_consistency`).
    """
    return {
        "dim": graph.dim,
        "nodes": len(graph.values.poses),
        "landmarks": len(graph.values.landmarks),
        "submaps": len(graph.submaps),
        "factors": len(graph.records),
        "classes": [c.as_row() for c in classes.values()],
    }
