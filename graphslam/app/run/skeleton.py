"""``graphslam relax RUN``: the path of a run from a skeleton network of its scans, beside the graph of the run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import read_consistently
from graphslam.app.machine import one_blas_thread
from graphslam.app.memory import peak_growth
from graphslam.app.run.options import RunOptions
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.reopened import resolve_from_folder
from graphslam.app.run.run_inputs import read_inputs
from graphslam.core.errors import MissingDataError
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.refine.skeleton import ScanSkeleton, patch_spread, relax_scans


@dataclass(frozen=True)
class RelaxedRun:
    """A run relaxed as a skeleton network.

    Parameters
    ----------
    skeleton : ScanSkeleton
    paths : dict of str to Trajectory
        ``graph``, ``refined`` if the run was refined, and ``skeleton``; at the nodes of the skeleton.
    rows : list of dict
        For each path: ``ate`` [m] against ground truth, aligned; ``spread`` of the scans across the surfaces [m];
        ``seconds`` of CPU; ``memory`` [MB]. None: not known.
    """

    skeleton: ScanSkeleton
    paths: dict[str, Trajectory]
    rows: list[dict[str, Any]]


def relax_run(folder: str | Path, progress: Callable[[str], Any] | None = None) -> RelaxedRun:
    """Relax the path of the graph of a finished run with the run's scans; the folder is not changed.

    Time and memory of the graph are those of solving it again from the submaps, with matches and loop closures.

    Parameters
    ----------
    folder : path
    progress : callable, optional
        Called with a text after each round.

    Raises
    ------
    MissingDataError
        The run has no scans: its front end uses none, or it was run with ``refine.use=false``.
    DataError
        Too few correspondences.
    """
    run, root = read_run_folder(folder), Path(folder)
    scans = read_consistently(root, read_inputs)[0].scans
    if scans is None:
        raise MissingDataError(
            "the run has no scans to relax", where=str(root), wanted="a front end with scans, and refine.use=true"
        )
    graph = run.map.trajectory if run.graph_path is None else run.graph_path
    start = graph.interpolate(np.clip(scans.times, graph.times[0], graph.times[-1]))
    gps = None
    if run.fixes is not None and len(run.fixes.times) and run.map.T_gps_world is not None:
        bias = RunOptions.of_folder(root).settings.gps.bias_sigma or 0.0
        gps = replace(run.fixes, sigma=np.hypot(run.fixes.sigma, bias)), run.map.T_gps_world
    rows: list[dict[str, Any]] = []
    with one_blas_thread():
        for work in (lambda: resolve_from_folder(root), lambda: relax_scans(scans, start, gps=gps, progress=progress)):
            begin = time.process_time()
            found, memory = peak_growth(work)
            rows.append({"seconds": time.process_time() - begin, "memory": memory})
    assert isinstance(found, ScanSkeleton)
    nodes = found.path.times
    paths = {"graph": graph.interpolate(np.clip(nodes, graph.times[0], graph.times[-1]))}
    if run.graph_path is not None:
        own = run.map.trajectory
        paths["refined"] = own.interpolate(np.clip(nodes, own.times[0], own.times[-1]))
        rows.insert(1, {"seconds": None, "memory": None})
    paths["skeleton"] = found.path.poses
    for row, (name, poses) in zip(rows, paths.items()):
        error = None
        if (truth := run.truth_path) is not None:
            inside = (nodes >= truth.times[0]) & (nodes <= truth.times[-1])
            there = Trajectory(nodes[inside], truth.interpolate(nodes[inside]))
            error = ate(Trajectory(nodes, poses), there).statistics.rmse
        row |= {"path": name, "ate": error, "spread": patch_spread(found.cloud, poses)}
    order = ("path", "ate", "spread", "seconds", "memory")
    made = {name: Trajectory(nodes, poses) for name, poses in paths.items()}
    return RelaxedRun(found, made, [{k: row[k] for k in order} for row in rows])
