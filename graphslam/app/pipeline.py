"""Raw log → submaps → graph → map: the main line of the project, one step after the other."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from graphslam.app import config as cfg
from graphslam.app.audit import audit_association
from graphslam.app.back_end import BackEnd
from graphslam.app.front_ends import make_front_end, recommended
from graphslam.app.gps_use import split, used_fixes
from graphslam.app.graph_facts import graph_facts
from graphslam.app.imu_use import ImuPart, imu_metrics, imus_of
from graphslam.app.loops import undone_of_run
from graphslam.app.metrics import (
    Metrics,
    dead_reckoning_metrics,
    flag_counts,
    front_end_metrics,
    gps_metrics,
    map_truth,
    solution_metrics,
    time_metrics,
    true_first_base,
    truth_metrics,
    truth_path,
)
from graphslam.app.metrics_space import truth_metrics_in_space
from graphslam.app.outputs import write_outputs
from graphslam.app.reckoning import dead_reckoning
from graphslam.app.run import GlobalMap, Run
from graphslam.app.run_folder import RunFolder
from graphslam.app.run_maps import RunMap, has_grids, make_run_map, sensor_reach
from graphslam.app.stream_use import stream_use
from graphslam.app.threads import one_blas_thread
from graphslam.app.verdict import Figures, observed, verdict
from graphslam.app.versions import versions
from graphslam.app.without_truth import check_without_truth
from graphslam.core.errors import GraphSlamError, MissingDataError
from graphslam.core.findings import verdict_json
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.evaluate.landmark_checks import sighting_findings
from graphslam.evaluate.stream_checks import Noticed, check_streams
from graphslam.evaluate.systematic import systematic_findings
from graphslam.evidence.formats import load_npz
from graphslam.graph.loop_ledger import Decision
from graphslam.io.catalog import load
from graphslam.solve.solution import Solution

logger = logging.getLogger(__name__)


def run(
    source: str | Path | SensorLog,
    *,
    frontend: str = "rbpf-ekf",
    solver: str = "isam2",
    seed: int = 0,
    out: str | Path | None = None,
    config: Mapping[str, Any] | None = None,
    resume: bool = False,
    progress: bool = True,
    undo: Sequence[int | Decision] | None = None,
    watch: Callable[[Any], None] | None = None,
) -> Run:
    """Run a front end over a log, join its submaps in a graph, and score what can be scored.

    Parameters
    ----------
    source : card name, folder, or SensorLog
    frontend, solver : str
        Registered names.
    seed : int
        Root of the seed tree.
    out : path, optional
        Run folder; without one nothing is written.
    config : mapping, optional
        Nested options over the source's preset: ``{"frontend": {...}, "backend": {...}, "gps": {...}}``.
    resume : bool
        Go on after the last finished submap of ``out``, to the same result.
    progress : bool
        Show a progress bar on stderr.
    undo : sequence of int or Decision, optional
        Loops that are taken out again at the end, by their numbers in the ledger of loops, or as an earlier ledger has
        them. By default those that were undone before where the run is resumed, none otherwise.
    watch : callable, optional
        Handed to a front end that can be watched (``segslam``: `frontends.segslam.progress`); others ignore it.

    Raises
    ------
    GraphSlamError
        Or one of its children; says what, where, got, wanted.
    """
    with one_blas_thread():
        return _run(source, frontend, solver, seed, out, config or {}, resume, progress, undo, watch)


def _run(
    source: str | Path | SensorLog,
    frontend: str,
    solver: str,
    seed: int,
    out: str | Path | None,
    config: Mapping[str, Any],
    resume: bool,
    progress: bool,
    undo: Sequence[int | Decision] | None,
    watch: Callable[[Any], None] | None,
) -> Run:
    begin = time.perf_counter()
    log = load_log_source(source)
    seconds = {"load": time.perf_counter() - begin}
    options = cfg.merge(recommended(log, frontend), config)
    settings: cfg.RunConfig = cfg.build(cfg.RunConfig, options)
    front: Any = make_front_end(frontend, settings.frontend)
    if watch is not None and hasattr(front, "watch"):
        front = replace(front, watch=watch)
    effective = effective_config(log.name, frontend, solver, seed, front.config, settings)
    noticed = check_streams(log)
    folder = None if out is None else RunFolder.start(out, effective, resume=resume)

    back = BackEnd(settings.backend, solver, imu=ImuPart(imus_of(log), settings.imu))
    gps = gps_stream(log)
    if gps is not None and settings.gps.use != "none":
        back.add_gps(split(gps, settings.gps)[0], settings.gps)

    drops = DropCounter()
    submaps, work = _front_to_back(log, front, back, SeedTree(seed), folder, drops, progress)
    if not submaps:
        raise MissingDataError("the log gave no submap", where=log.name)
    if undo is None:  # what was taken out of a run stays out when it is gone on with
        undo = undone_of_run(folder.path) if folder is not None and resume else ()
    solution = back.finish(undo)
    seconds["frontend"] = work.seconds
    seconds |= {f"backend_{k}": v for k, v in back.seconds.items()}
    seconds["backend"] = sum(back.seconds.values())
    seconds["total"] = time.perf_counter() - begin

    result = _judge(log, front, gps, settings, submaps, back, solution, seconds, work, drops, effective, noticed)
    if folder is None:
        return result
    write_outputs(folder, result)
    return replace(result, folder=folder.path)


def load_log_source(source: str | Path | SensorLog, **options: Any) -> SensorLog:
    """A log from a card name, a folder on disk, or itself; ``options`` are for the reader."""
    if isinstance(source, SensorLog):
        return source
    log = load(source, **options)
    if not isinstance(log, SensorLog):
        raise MissingDataError(
            f"{source} holds no sensor log", got=type(log).__name__, wanted="a log of sensor streams"
        )
    return log


def gps_stream(log: SensorLog) -> Gps | None:
    """The GPS stream of a log, if it has one."""
    name = log.of_type(Gps)
    return None if name is None else log[name]


def effective_config(
    source: str, frontend: str, solver: str, seed: int, front_config: Any, settings: cfg.RunConfig
) -> dict[str, Any]:
    """What ``config.toml`` holds: names, seed, and every option with its value."""
    run_part = {"source": source, "frontend": frontend, "solver": solver, "seed": seed}
    return {
        "run": run_part,
        "frontend": cfg.as_dict(front_config),
        "backend": cfg.as_dict(settings.backend),
        "gps": cfg.as_dict(settings.gps),
        "imu": cfg.as_dict(settings.imu),
        "map": cfg.as_dict(settings.map),
    }


@dataclass(frozen=True, slots=True)
class FrontEndWork:
    """What the front end did in this session.

    Parameters
    ----------
    seconds : float
    resumed : int
        Submaps that were there already.
    per_scan : (k,)
        Seconds a scan of each submap but the first, which may have compiled.
    """

    seconds: float
    resumed: int
    per_scan: Array


def _front_to_back(
    log: SensorLog,
    front: Any,
    back: BackEnd,
    seed: SeedTree,
    folder: RunFolder | None,
    drops: DropCounter,
    progress: bool,
) -> tuple[list[Submap], FrontEndWork]:
    """Feed every submap to the back end as soon as it is finished and stored."""
    store = None if folder is None else folder.submaps_with(load_npz if back.config.loops else None)
    submaps = store.complete_prefix() if store is not None else []
    if store is not None and len(submaps) < len(store):
        store.truncate(len(submaps))
    t_first, t_last = log.interval
    bar = tqdm(total=round(t_last - t_first, 1), unit="s", desc=log.name, disable=not progress, leave=False)
    for s in submaps:
        back.add(s)
    if submaps:
        logger.info("resumed after submap %d at %.2f s", submaps[-1].key, submaps[-1].interval[1])
        bar.update(submaps[-1].interval[1] - t_first)
    bar.set_postfix_str("kernels are compiled at their first use ever, about half a minute")
    front_s, resumed, cost = 0.0, len(submaps), []
    stream = front.submaps(log, seed=seed.child("frontend"), after=submaps[-1] if submaps else None, drops=drops)
    while True:
        start = time.perf_counter()
        submap = next(stream, None)
        spent = time.perf_counter() - start
        front_s += spent
        if submap is None:
            break
        if store is not None:
            store.append(submap)
        back.add(submap)
        submaps.append(submap)
        cost.append(spent / max(int(submap.report.get("scans", 1)), 1))
        bar.update(submap.interval[1] - submap.interval[0])
        bar.set_postfix(submaps=len(submaps), landmarks=len(back.graph.values.landmarks))
    bar.close()
    return submaps, FrontEndWork(front_s, resumed, np.array(cost[1:]))


def _judge(
    log: SensorLog,
    front: Any,
    gps: Gps | None,
    settings: cfg.RunConfig,
    submaps: list[Submap],
    back: BackEnd,
    solution: Solution,
    seconds: dict[str, float],
    work: FrontEndWork,
    drops: DropCounter,
    effective: dict[str, Any],
    noticed: Sequence[Noticed],
) -> Run:
    """Metrics, residuals, and the value that the user gets."""
    hits = back.landmark_hits(submaps)
    global_map = make_map(solution, submaps, hits, settings.backend.confirmed_hits)
    out = Metrics()
    front_end_metrics(out, submaps)
    solution_metrics(out, solution, len(global_map.landmarks))
    imu_metrics(out, back.graph, drops)
    fused, why_not = _fused_map(submaps, global_map, settings.map, effective)
    if fused is not None:
        fused.metrics(out)
        seconds["map"] = fused.divide_s + fused.fuse_s + fused.move_s
        seconds["total"] += seconds["map"]
    scans = sum(int(s.report.get("scans", 0)) for s in submaps[work.resumed :])
    time_metrics(out, seconds, log.duration, scans, work.per_scan)
    residuals = {}
    reckoned = dead_reckoning(log, global_map.trajectory)
    if gps is not None:
        withheld = ~used_fixes(gps, settings.gps)
        residuals = gps_metrics(out, global_map.trajectory, gps, withheld, solution.T_gps_world)
        if back.graph.dim == 2:
            dead_reckoning_metrics(out, reckoned, gps)
    truth, identities = map_truth(log, submaps), "run"
    true_path = truth_path(log, global_map.trajectory.times, submaps[0])
    identified = [s.with_ids(back.graph.landmark_ids_of(s.key)) if s.landmarks is not None else s for s in submaps]
    checks = check_without_truth(out, back.graph, identified, global_map.base_poses, gps, settings)
    if truth is not None:
        known = all(s.landmarks is None or bool(np.all(s.landmarks.ids >= 0)) for s in submaps)
        if back.graph.dim == 2:
            truth_metrics(out, solution, truth, identities=known, path=true_path)
        else:
            truth_metrics_in_space(out, solution, truth, path=true_path)
        identities = "truth" if known else "run"
    audit_association(out, log, front, *back.observation_labels(submaps))
    report = {
        "format": "graphslam.run/1",
        **effective["run"],
        "backend": effective["backend"],
        "gps": effective["gps"],
        "imu": effective["imu"],
        "T_world_base": true_first_base(log, submaps[0]),
        "versions": versions(),
        "seconds": seconds,
        "resumed_submaps": work.resumed,
        "flagged_submaps": flag_counts(submaps),
        "records_read": dict(log.read) or {k: len(s.times) for k, s in log.streams.items()},
        "records_dropped": {**log.dropped, **drops.counts},
        "source_meta": dict(log.meta),
        "identities": identities,
        "covariance_scale": settings.backend.covariance_scale,
        "objective": solution.objective,
        "converged": solution.converged,
        "graph": graph_facts(back.graph, checks.classes),
    }
    if why_not:
        report["map_left_out"] = why_not
    used = frozenset().union(*(s.uses for s in submaps))
    streams = stream_use(log, back.graph, settings, {**log.dropped, **drops.counts}, used)
    report["streams"] = [s.as_row() for s in streams]
    metrics = out.table()
    figures = Figures(report, dict(zip(metrics["key"], metrics["value"])), back.graph.events)
    reports = [s.report for s in submaps]
    seen = [*sighting_findings(log, reports, {**log.dropped, **drops.counts}), *systematic_findings(reports)]
    report["verdict"] = verdict_json([*observed(streams, noticed, submaps), *seen, *verdict(figures)])
    return Run(
        name=log.name,
        submaps=identified,
        map=global_map,
        metrics=metrics,
        report=report,
        events=list(back.graph.events),
        ledger=back.graph.ledger.table(),
        gps=residuals,
        fixes=None if gps is None or settings.gps.use == "none" else split(gps, settings.gps)[0],
        log=log,
        truth=truth,
        truth_path=true_path,
        dead_reckoning=reckoned,
        solution=solution,
        graph=back.graph,
        checks=checks,
        fused=fused,
    )


def _fused_map(
    submaps: list[Submap], m: GlobalMap, config: cfg.MapConfig, effective: Mapping[str, Any]
) -> tuple[RunMap | None, str]:
    """The fused map of submaps with grids; or None, and why where there could have been one."""
    if not (config.fuse and has_grids(submaps)):
        return None, ""
    try:
        return make_run_map(submaps, m, reach=sensor_reach(effective), config=config), ""
    except GraphSlamError as error:  # a run that is solved is not thrown away for its map
        logger.warning("no fused map: %s", error)
        return None, str(error)


def make_map(solution: Solution, submaps: list[Submap], hits: dict[int, int], confirmed: int) -> GlobalMap:
    """Trajectory at full rate, nodes, and the landmarks seen at least ``confirmed`` times."""
    n = np.array([hits.get(int(i), 0) for i in solution.landmark_ids], dtype=np.int64)
    keep = n >= confirmed
    return GlobalMap(
        trajectory=solution.trajectory(),
        node_times=solution.node_times,
        node_poses=solution.poses,
        node_covariances=solution.node_covariances(),
        landmark_ids=solution.landmark_ids[keep],
        landmarks=solution.landmarks[keep],
        landmark_covariances=solution.landmark_covariances()[keep],
        landmark_hits=n[keep],
        T_gps_world=solution.T_gps_world,
        base_nodes=np.append(solution.base_nodes, solution.exit_nodes[-1]).astype(np.int64),
    )
