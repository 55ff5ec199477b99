"""Merge several runs, of several robots or days, into one map; here by common landmarks."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.run import Run
from graphslam.app.sessions.dense import run_is_dense
from graphslam.app.sessions.merge_align import By, align_runs, submap_of_session
from graphslam.app.sessions.merge_dense import MergedSubmaps, merge_dense
from graphslam.app.sessions.merge_metrics import merge_metrics
from graphslam.app.sessions.merged_map import MergedMap, Session
from graphslam.association.identity import find_association_outliers
from graphslam.association.merging import mahalanobis_merges
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.graph.factor_graph import FactorGraph
from graphslam.join.submap_blocks import scale_covariances
from graphslam.loops.sessions import Alignment
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.surface.piece import SurfaceConfig
from graphslam.solve.registry import make_solver
from graphslam.solve.solution import Solution

logger = logging.getLogger(__name__)
Ints = npt.NDArray[np.int64]
IDENTITY_GATE = 25.0
MERGE_GATE = 11.8
TOLERANCE = 0.5
SESSION_COLOURS = ("session", "height", "piece", "sigma")


def merge(
    runs: Sequence[Run | str | Path],
    *,
    by: By = "auto",
    solver: str = "batch",
    identity_gate: float = IDENTITY_GATE,
    tolerance: float = TOLERANCE,
    out: str | Path | None = None,
    surface: SurfaceConfig | None = None,
    colour: str = "session",
) -> MergedMap | MergedSubmaps:
    """Merge runs into one map: align them by common landmarks, then solve all their submaps together.

    The first base of the first run is fixed, the first bases of the others are free. Every submap of every run is one
    factor with the covariance that it had in its own run.

    Parameters
    ----------
    runs : sequence of Run or run folder
        At least two. A run joins if it shares landmarks with the joined ones, those with most shared landmarks first.
    by : {"auto", "identity", "constellation", "places", "gps"}
        Landmarks are matched by their identities, or by their constellation. ``auto``: by identity if every run used
        the identities of its log, else by constellation. Dense submaps are aligned by ``places`` or by ``gps``
        (:func:`graphslam.app.sessions.merge_dense.merge_dense`).
    solver : str
        Registered solver.
    identity_gate : float
        After the solution, observations with a larger χ² (2 dof) become separate landmarks; 0 = never.
    tolerance : float
        Landmarks of two maps within this distance after alignment agree [m].
    out : path, optional
        Folder for the merged map.
    surface : SurfaceConfig, optional
        Runs of 3-D dense submaps: also write the surface of all sessions into ``out``; their logs are read once more
        (:func:`graphslam.app.sessions.merge_surface.surface_of_sessions`).
    colour : {"session", "height", "piece", "sigma"}
        Of that surface.

    Returns
    -------
    MergedMap or MergedSubmaps
        In the frame of the first run's first base.

    Raises
    ------
    ConfigError
        Fewer than two runs, or an unknown option.
    RunFolderError
        ``out`` is not empty, or another process writes into it.
    DataError
        Runs that share fewer than two landmarks, or whose landmarks do not determine the alignment; names the run.

    Examples
    --------
    >>> merged = gs.merge(["runs/field", "runs/second"])
    >>> merged.metrics["key"].size > 0
    True
    """
    opened = _opened(runs)
    if surface is not None and (out is None or colour not in SESSION_COLOURS):
        raise ConfigError(f"a surface of sessions, out = {out}, colour = {colour!r}; wanted a folder to write it to and"
                          f" one of the colours {', '.join(SESSION_COLOURS)}")  # fmt: skip
    if out is None:
        return _merged(opened, by, solver, identity_gate, tolerance)
    from graphslam.app.sessions.merge_outputs import merged_folder, write_merged

    with merged_folder(out) as folder:
        merged = _merged(opened, by, solver, identity_gate, tolerance)
        made = None
        if surface is not None:
            from graphslam.app.sessions.merge_surface import surface_of_sessions

            made = surface_of_sessions(merged, config=surface)
        write_merged(folder, merged, surface=made, colour=colour)
    return merged


def _opened(runs: Sequence[Run | str | Path]) -> list[Run]:
    if len(runs) < 2:
        raise ConfigError(f"{len(runs)} runs to merge; wanted at least two")
    opened = [r if isinstance(r, Run) else read_run_folder(r) for r in runs]
    for name, r in zip(_names(opened), opened):
        if r.points_of_survey:
            logger.warning(
                "%s: its %d control and check rows are not used in the merged map; to do: test the run by them, and for"
                " the frame of the survey apply T_control_map of the first run (run.json, control_points)",
                name, r.points_of_survey,
            )  # fmt: skip
    return opened


def _merged(
    opened: list[Run], by: By = "auto", solver: str = "batch", gate: float = IDENTITY_GATE, tolerance: float = TOLERANCE
) -> MergedMap | MergedSubmaps:
    with one_blas_thread():
        if all(run_is_dense(r) for r in opened):
            return merge_dense(opened, _names(opened), by=cast(Any, by), solver=solver)
        if by not in ("auto", "identity", "constellation"):
            raise ConfigError(f"by = {by!r}; known: auto, identity, constellation")
        if by == "auto":
            by = "identity" if all(r.report.get("identities") == "truth" for r in opened) else "constellation"
        return _merge(opened, by, solver, gate, tolerance)


def _names(runs: Sequence[Run]) -> list[str]:
    """Unique names of the runs that are valid in file names."""
    out: list[str] = []
    for r in runs:
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "-", r.name).strip("-.") or "run"
        name, k = stem, 2
        while name in out:
            name, k = f"{stem}-{k}", k + 1
        out.append(name)
    return out


def _merge(runs: list[Run], by: By, solver_name: str, gate: float, tolerance: float) -> MergedMap:
    start = time.perf_counter()
    names = _names(runs)
    graph = FactorGraph()
    order, alignments, renamed = align_runs(runs, names, by, tolerance)
    keys: dict[int, tuple[int, ...]] = {}
    first: dict[int, int] = {}
    next_key = 0
    for r in order:
        first[r] = 0
        alignment = alignments[r]
        if alignment is not None:
            first[r] = graph.start_session(alignment.T_reference_map)
        scale = float(runs[r].report.get("covariance_scale", 1.0))
        submaps = list(runs[r].submaps)
        for s in submaps if scale == 1.0 else scale_covariances(submaps, scale):
            graph.add_submap(submap_of_session(s, next_key, names[r], renamed[r]))
            keys[r] = (*keys.get(r, ()), next_key)
            next_key += 1
    solver = make_solver(solver_name, graph)
    solver.solve_to_optimum()
    fused = 0
    if by == "constellation":
        while pairs := mahalanobis_merges(graph, MERGE_GATE, distance=tolerance):
            for kept, dropped in pairs:
                graph.merge_landmarks(kept, dropped)
            fused += len(pairs)
            solver.solve_to_optimum()
    split = 0
    while gate > 0 and split < 10 * next_key and (doubts := find_association_outliers(graph, gate)):
        graph.split_landmark(doubts[0].factor_id, doubts[0].entry)
        solver.solve_to_optimum()
        split += 1
    solution = solver.solution()
    sessions = _sessions(runs, names, keys, first, alignments, graph, solution)
    hits, seen_by = _observations(sessions, graph, solution)
    confirmed = max(_confirmed(r) for r in runs)
    keep: npt.NDArray[np.bool_] = np.asarray(hits >= confirmed)
    P = solution.landmark_covariances()
    sessions = [replace(s, map=_with_landmarks(s.map, solution, P, hits, keep)) for s in sessions]
    report = {
        "format": "graphslam.merge/1",
        "by": by,
        "solver": solver_name,
        "sessions": [
            {
                "name": s.name,
                "source": s.run.name,
                "submaps": len(s.keys),
                "points_not_used": s.run.points_of_survey,
                "T_world_first_base": solution.poses[s.first_node].tolist(),
                "common_landmarks": None if s.alignment is None else len(s.alignment.pairs),
                "rejected": None if s.alignment is None else s.alignment.rejected,
                "runner_up": None if s.alignment is None else s.alignment.runner_up,
                "alignment_rms": None if s.alignment is None else s.alignment.rms,
            }
            for s in sessions
        ],
        "landmarks_fused": fused,
        "observations_split": split,
        "seconds": time.perf_counter() - start,
    }
    metrics = merge_metrics(sessions, solution, keep, seen_by, split, identities=by == "identity")
    return MergedMap(
        sessions=sessions,
        landmark_ids=solution.landmark_ids[keep],
        landmarks=solution.landmarks[keep],
        landmark_covariances=P[keep],
        landmark_sessions=seen_by[keep],
        solution=solution,
        graph=graph,
        metric_rows=metrics,
        report=report,
    )


def _confirmed(run: Run) -> int:
    """Smallest number of observations of a landmark in the run's own map."""
    return int(run.map.landmark_hits.min(initial=1)) if len(run.map.landmark_hits) else 1


def _sessions(
    runs: list[Run],
    names: list[str],
    keys: dict[int, tuple[int, ...]],
    first: dict[int, int],
    alignments: dict[int, Alignment | None],
    graph: FactorGraph,
    solution: Solution,
) -> list[Session]:
    node_covariances = solution.node_covariances()
    none = np.zeros(0, dtype=np.int64)
    out = []
    for r, run in enumerate(runs):
        nodes = np.arange(first[r], first[r] + len(keys[r]) + 1)
        m = GlobalMap(
            trajectory=solution.trajectory(keys=set(keys[r])),
            node_times=run.map.node_times,
            node_poses=solution.poses[nodes],
            node_covariances=node_covariances[nodes],
            landmark_ids=none,
            landmarks=np.zeros((0, 2)),
            landmark_covariances=np.zeros((0, 2, 2)),
            landmark_hits=none,
        )
        out.append(Session(names[r], run, keys[r], first[r], alignments[r], m))
    return out


def _observations(sessions: list[Session], graph: FactorGraph, solution: Solution) -> tuple[Ints, Ints]:
    """Number of observations, and of sessions, of every landmark of the solution."""
    row = {int(i): k for k, i in enumerate(solution.landmark_ids)}
    hits = np.zeros(len(row), dtype=np.int64)
    seen = np.zeros((len(sessions), len(row)), dtype=np.bool_)
    for n, session in enumerate(sessions):
        for key, submap in zip(session.keys, session.run.submaps):
            if submap.landmarks is None:
                continue
            rows = np.array([row[int(i)] for i in graph.landmark_ids_of(key)], dtype=np.intp)
            detections = submap.landmarks.detections
            counts = np.ones(len(rows)) if detections is None else np.bincount(detections[:, 1], minlength=len(rows))
            np.add.at(hits, rows, counts.astype(np.int64))
            seen[n, rows] = True
    return hits, seen.sum(axis=0).astype(np.int64)


def _with_landmarks(m: GlobalMap, solution: Solution, P: Array, hits: Ints, keep: npt.NDArray[np.bool_]) -> GlobalMap:
    return replace(
        m,
        landmark_ids=solution.landmark_ids[keep],
        landmarks=solution.landmarks[keep],
        landmark_covariances=P[keep],
        landmark_hits=hits[keep],
    )


def continue_runs(saved: Sequence[Run | str | Path], run: Run, out: str | Path) -> MergedMap | MergedSubmaps:
    """Add a new run to the graph of saved ones, attached where it is localised in them; the first base is fixed.

    An earlier result in ``out`` is replaced, because the run may have been resumed.
    """
    from graphslam.app.sessions.merge_outputs import merged_folder, write_merged

    opened = _opened([*saved, run])
    with merged_folder(out, anew=True) as folder:
        merged = _merged(opened)
        write_merged(folder, merged)
    return merged
