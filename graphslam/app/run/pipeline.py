"""Raw log → submaps → graph → map: the main line of the project, one step after the other."""

from __future__ import annotations

import logging
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import read_consistently
from graphslam.app.folders.lock import lock_folder
from graphslam.app.machine import Stopwatch, one_blas_thread, versions
from graphslam.app.run import config as cfg
from graphslam.app.run.audit import audit_association, reference_identities
from graphslam.app.run.calibration import (
    apply_calibration,
    bias_findings,
    bias_table,
    configure_for_calibration,
    explain_disagreement,
    uses_preset_noise,
    without_noise,
)
from graphslam.app.run.choice import choose_front_end, reading_line
from graphslam.app.run.files import read_options, read_report, removed_loops_of_run
from graphslam.app.run.folder import CONFIG, RunFolder
from graphslam.app.run.front_ends import (
    FrontEndLike,
    check_name,
    make_front_end,
    name_of,
    preset_of,
    recommended_options,
)
from graphslam.app.run.front_to_back import FrontEndTiming, SubmapPipeline
from graphslam.app.run.maps import sensor_reach
from graphslam.app.run.outputs import graph_metrics, write_outputs
from graphslam.app.run.residual_consistency import check_residual_consistency
from graphslam.app.run.run import Run
from graphslam.app.run.run_bar import RunBar
from graphslam.app.run.run_inputs import RunInputs, collect_inputs, read_inputs
from graphslam.app.run.source import load_log_source
from graphslam.app.run.stream_use import stream_use
from graphslam.app.run.summary import summarise_run
from graphslam.app.run.verdict import RunMetrics, findings_from_run, run_findings
from graphslam.backend.back_end import BackEnd, Observer
from graphslam.backend.refining import refine_run, refined_ledger
from graphslam.backend.streams import GpsSource, ImuSource, beacons_of, compasses_of, split_fixes, used_fixes
from graphslam.core.config import build_config, dump_toml, merge_options, options_dict
from graphslam.core.errors import GraphSlamError, MissingDataError, UnknownNameError
from graphslam.core.findings import verdict_json
from graphslam.core.heap import trim_heap
from graphslam.core.json_file import check_json
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.evaluate.bias_test import bias_test_findings
from graphslam.evaluate.covariance_assessment import consistency_tests_as_json, pooled_nonlinearity
from graphslam.evaluate.dead_reckoning_baseline import dead_reckoned_path
from graphslam.evaluate.landmark_checks import sighting_findings
from graphslam.evaluate.metrics import (
    Metrics,
    dead_reckoning_metrics,
    flag_counts,
    front_end_metrics,
    gps_metrics,
    imu_metrics,
    map_truth,
    solution_metrics,
    time_metrics,
    true_first_base,
    truth_metrics,
    truth_metrics_in_space,
    truth_path,
)
from graphslam.evaluate.refined import (
    heading_error,
    level_truth,
    refined_truth_metrics,
    refinement_facts,
    refinement_metrics,
)
from graphslam.evaluate.stream_checks import StreamFinding, check_streams
from graphslam.evaluate.trajectory_error import ate
from graphslam.evidence.spilled_grid import load_spilled
from graphslam.graph.factor_graph import FactorGraph
from graphslam.io.log_digest import log_digest
from graphslam.io.submap_store import read_submaps
from graphslam.loops.ledger import LoopDecision
from graphslam.maps.contradictions import Contradictions
from graphslam.maps.global_map import GlobalMap, make_global_map
from graphslam.maps.refined import map_of_frames
from graphslam.maps.run_map import RunMap, has_maps, make_run_map
from graphslam.refine.scans import Scans
from graphslam.solve.registry import SOLVERS
from graphslam.solve.solution import Solution
from graphslam_frontends.base import FrontEnd

logger = logging.getLogger(__name__)


def run(
    source: str | Path | SensorLog,
    *,
    frontend: FrontEndLike | Sequence[FrontEndLike] | None = None,
    solver: str = "isam2",
    seed: int = 0,
    out: str | Path | None = None,
    config: Mapping[str, Any] | None = None,
    resume: bool = False,
    progress: bool = True,
    undo: Sequence[int | LoopDecision] | None = None,
    observers: Sequence[Observer] = (),
    reader: str | None = None,
    reader_options: Mapping[str, Any] | None = None,
    preset: str | None = None,
) -> Run:
    """Run a front end over a log, join its submaps in a graph, and score what can be scored.

    Parameters
    ----------
    source : card name, file, folder, or SensorLog
    frontend : str, class or object, or a list of these, optional
        Registered name; by default the one that fits what the log holds (:mod:`graphslam.app.run.choice`). Or a class
        that inherits from :class:`~graphslam_frontends.base.FrontEnd`, or an object of one, which has its own options.
        One of landmarks and one of planar scans map a log together: each the intervals that suit it
        (:mod:`graphslam_frontends.mixed`), in one graph.
    solver : str
        Registered name.
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
    undo : sequence of int or LoopDecision, optional
        Loops that are taken out again at the end, by their numbers in the ledger of loops, or as an earlier ledger has
        them. By default those that were undone before where the run is resumed, none otherwise.
    observers : sequence of Observer
        Told what goes on while it does: steps of a front end that can be watched, submaps, loops, the solution
        (`graphslam.backend.back_end.Observer`).
    reader : str, optional
        Name of the reader of the source; by default the one that recognises it.
    reader_options : mapping, optional
        For the reader.
    preset : str, optional
        Name of the source whose recommended settings are taken, ``"none"`` for defaults; by default those of the log,
        its reader, or its kind.

    Returns
    -------
    Run
        In the frame of the first base [m, rad].

    Raises
    ------
    GraphSlamError
        Or one of its children; says what, where, got, wanted.

    Examples
    --------
    >>> made = gs.run(log, frontend="rbpf-ekf", solver="batch", config={"frontend": {"particles": 10}}, progress=False)
    >>> made.metric("converged")
    1.0
    """
    if isinstance(frontend, (list, tuple)) and len(frontend) < 2:
        frontend = frontend[0] if frontend else None
    # what is wrong with the call is said before anything is read (of a log in memory, a moment later)
    name = None if frontend is None else name_of(frontend)
    for each in frontend if isinstance(frontend, (list, tuple)) else [frontend]:
        if isinstance(each, str) and not isinstance(source, SensorLog):
            check_name(each)
    if solver not in SOLVERS:
        raise UnknownNameError("solver", solver, SOLVERS)
    with one_blas_thread(), RunBar(progress) as bar:
        begin = Stopwatch()
        _stage([bar, *observers], "reading")
        log = load_log_source(source, reader=reader, **(reader_options or {}))
        loading = begin.seconds()
        bar.log_read(log)
        name, suggested, own = _chosen(log, name, preset)
        front: FrontEndLike | Sequence[FrontEndLike] = name if frontend is None else frontend
        if isinstance(front, FrontEnd) and not isinstance(front, type):
            suggested = {k: v for k, v in suggested.items() if k != "frontend"}
        asked = config or {}
        watch = [bar, *observers]
        return _run(log, begin, loading, front, solver, seed, out, suggested, own, asked, resume, undo, watch)


def _chosen(
    log: SensorLog, frontend: str | list[str] | None, preset: str | None
) -> tuple[str | list[str], dict[str, Any], bool]:
    """Front end, preset, and whether it was made for this very set; what was read and chosen is told in a line each."""
    read = reading_line(log)
    if read:
        logger.warning(read)
    why = "as asked for"
    if frontend is None:
        choice = choose_front_end(log)
        frontend, why = choice.frontend, choice.why
    options = recommended_options(log, frontend, preset)
    if read:
        taken = preset or preset_of(log, frontend)[0] or "none"
        names = frontend if isinstance(frontend, str) else ", ".join(frontend)
        logger.warning("front end: %s (%s); preset: %s", names, why, taken)
    own = bool(options) and (preset is not None or preset_of(log, frontend)[1])
    return frontend, options, own


def _run(
    log: SensorLog,
    begin: Stopwatch,
    loading: float,
    frontend: FrontEndLike | Sequence[FrontEndLike],
    solver: str,
    seed: int,
    out: str | Path | None,
    suggested: Mapping[str, Any],
    own: bool,
    config: Mapping[str, Any],
    resume: bool,
    undo: Sequence[int | LoopDecision] | None,
    observers: Sequence[Observer],
) -> Run:
    seconds = {"load": loading}
    mixed = isinstance(frontend, (list, tuple))
    kept = suggested if own and uses_preset_noise(config) else without_noise(suggested, mixed=mixed)
    options = merge_options(kept, config)
    settings: cfg.RunConfig = build_config(cfg.RunConfig, options)
    front = make_front_end(frontend, settings.frontend)
    noticed = check_streams(log)
    recorded, clock = log, time.perf_counter()
    _stage(observers, "calibration")
    log, applied, said, found = apply_calibration(log, front, settings.calibrate, config, own=own, seed=seed)
    front = configure_for_calibration(front, log, applied.given, found, config)
    settings = replace(settings, calibrate=applied)
    seconds["calibrate"] = time.perf_counter() - clock
    noticed = [*noticed, *(StreamFinding("", f) for f in said)]
    effective = effective_config(log.name, name_of(frontend), solver, seed, front.config, settings)
    back = back_end(RecordSource(log), settings, solver, observers)

    def finish(folder: RunFolder | None, undone: Sequence[int | LoopDecision]) -> Run:
        tree = SeedTree(seed)
        _stage(observers, "front end")
        work = SubmapPipeline(RecordSource(log), front, back, tree, folder, with_grids(settings))
        work.step()
        return solve_and_evaluate(log, work, settings, effective, seconds, begin, undone, noticed)

    if out is None:
        return finish(None, undo or ())
    effective = with_digest(effective, recorded)
    with RunFolder.start(out, effective, resume=resume) as folder:
        if undo is None:  # what was taken out of a run stays out when it is gone on with
            undo = removed_loops_of_run(folder.path) if resume else ()
        made = finish(folder, undo)
        _stage(observers, "figures")
        return write_outputs(folder.path, made)


def _stage(observers: Sequence[Observer], name: str) -> None:
    for o in observers:
        o.stage(name)


def with_digest(effective: dict[str, Any], log: SensorLog) -> dict[str, Any]:
    """The options of a run and what tells its log from others, as they come back from the folder, order and all."""
    effective = {**effective, "run": {**effective["run"], "log": log_digest(log)}}
    return tomllib.loads(dump_toml(effective))


def solve_and_evaluate(
    log: SensorLog,
    work: SubmapPipeline,
    settings: cfg.RunConfig,
    effective: dict[str, Any],
    seconds: dict[str, float],
    begin: Stopwatch,
    undo: Sequence[int | LoopDecision],
    noticed: Sequence[StreamFinding],
) -> Run:
    """The run of a log whose submaps are all in the graph of the back end: solved and judged.

    Where the passes of its map deny each other, as they do when the particles lost their way, particles are drawn anew
    and the better map is kept. A folder that settled on a draw before, or of which loops were taken out by hand, keeps
    its own.
    """
    if not work.submaps:
        raise MissingDataError("the log gave no submap", where=log.name)
    front = work.front
    steps = front.steps(log) if settings.refine.use else None
    scans = None if steps is None else Scans.of(steps)
    del steps
    release_memory(work)
    taken = collect_inputs(log, work.drops.counts, reference_identities(log, front), noticed, scans)
    attempts = _MapCandidates([] if work.settled is None else work.settled.attempts)

    def solve() -> _MapCandidate:
        made = work.submaps, work.back, seconds, begin, work.work, effective, undo
        _solved(taken, settings, *made, work.draw, attempts)
        assert attempts.best is not None
        return attempts.best

    best = solve()
    while best.denied and front.draws and work.settled is None and not undo and work.draw + 1 < settings.backend.draws:
        logger.warning("overlapping submaps still contradict each other: making submaps again with another seed")
        bars = _bars(work.back)
        _stage(bars, "front end")
        work = work.with_next_seed(back_end(RecordSource(log), settings, effective["run"]["solver"], bars))
        work.step()
        release_memory(work)
        best = solve()
    if work.folder is not None and work.settled is None and work.draw:
        work.folder.settle(best.draw, attempts.of_others(best.draw))
    return replace(attempts.result(), log=log)


def _bars(back: BackEnd) -> list[Observer]:
    return [o for o in back.observers if isinstance(o, RunBar)]


def release_memory(work: SubmapPipeline) -> None:
    """Let go of what making the submaps took."""
    work.front.forget()
    trim_heap()


def rerun_without_loops(folder: str | Path, undo: Sequence[LoopDecision], *, progress: bool = True) -> Run:
    """Make a finished run again from what its folder holds, without these loops, and write its files anew.

    No log is read, and no submap made.

    Parameters
    ----------
    undo : sequence of LoopDecision
        Loops that are taken out.
    progress : bool
        Show a progress bar on stderr.
    """
    root = Path(folder)
    begin = Stopwatch()
    with one_blas_thread(), lock_folder(root), RunBar(progress) as bar:
        bar.stage("reading")
        taken, _ = read_consistently(root, read_inputs)
        effective, settings, back, submaps = _stored(root, taken, [bar])
        seconds = {"load": begin.seconds()}
        bar.log_read(taken.log)
        bar.stage("front end")
        for s in submaps:
            back.add(s)
        work = FrontEndTiming(0.0, len(submaps), np.zeros(0))
        settled = RunFolder(root).settled()
        draw, earlier = (0, []) if settled is None else (settled.draw, settled.attempts)
        attempts = _MapCandidates(earlier)
        _solved(taken, settings, submaps, back, seconds, begin, work, effective, undo, draw, attempts)
        bar.stage("figures")
        return write_outputs(root, attempts.result())


def resolve_from_folder(folder: str | Path) -> tuple[FactorGraph, Solution]:
    """Graph and solution of a finished run, from what its folder holds, without the loops that were undone."""
    root = Path(folder)
    with one_blas_thread():
        taken, _ = read_consistently(root, read_inputs)
        _, _, back, submaps = _stored(root, taken, [])
        attempts = read_consistently(root, read_report).get("map_attempts", [])
        if any(a["kept"] and a["loops"] for a in attempts):  # of "auto", once its first map contradicted itself
            back.config = replace(back.config, loops=True)
        for s in submaps:
            back.add(s)
        solution = back.finish(removed_loops_of_run(root))
    return back.graph, solution


def _stored(
    root: Path, taken: RunInputs, observers: Sequence[Observer]
) -> tuple[dict[str, Any], cfg.RunConfig, BackEnd, list[Submap]]:
    """Options and submaps of a run folder, and a back end that is to have them."""
    effective = read_options(root)
    wanted = {"run": {"source": str, "frontend": object, "solver": str, "seed": int}}
    said = check_json(effective, wanted, str(root / CONFIG))["run"]
    settings: cfg.RunConfig = build_config(cfg.RunConfig, {k: v for k, v in effective.items() if k != "run"})
    back = back_end(RecordSource(taken.log), settings, said["solver"], observers)
    return effective, settings, back, read_submaps(root, load_grid=load_spilled if with_grids(settings) else None)


def back_end(feed: RecordSource, settings: cfg.RunConfig, solver: str, observers: Sequence[Observer]) -> BackEnd:
    """A back end that has its IMUs, and the fixes that are to be used."""
    fixes = GpsSource(feed, settings.gps)
    back = BackEnd(settings.backend, solver, imu=ImuSource(feed, settings.imu), observers=observers, fixes=fixes)
    if not feed.ended:  # compasses and beacons are given whole
        return back
    for name, compass in compasses_of(feed.log, settings.compass).items():
        back.add_compass(name, compass, settings.compass)
    for name, ranges in beacons_of(feed.log, settings.beacons).items():
        back.add_beacons(name, ranges, settings.beacons)
    return back


def with_grids(settings: cfg.RunConfig) -> bool:
    """Are the grids of stored submaps needed?"""
    return bool(settings.backend.looks or settings.map.fuse)


@dataclass(frozen=True, slots=True)
class _MapCandidate:
    """One graph that was solved for a run.

    Parameters
    ----------
    draw : int
        Of the random numbers its submaps were made of.
    loops : bool
        With loops that the back end looked for.
    """

    run: Run
    draw: int
    loops: bool

    @property
    def passes(self) -> Contradictions | None:
        """What the passes of its map say of each other; None where it has no fused map."""
        return None if self.run.fused is None else self.run.fused.passes

    @property
    def denied(self) -> bool:
        """Do passes of its map deny each other?"""
        return self.passes is not None and self.passes.is_contradictory

    def beats(self, other: _MapCandidate) -> bool:
        """Do its passes deny each other less?"""
        known = self.passes is not None and other.passes is not None
        return known and self.passes.agrees_better(other.passes)  # type: ignore[union-attr, arg-type]

    def row(self) -> dict[str, Any]:
        """What a report says of it, JSON-serialisable."""
        facts = {"share": None} if self.passes is None else self.passes.facts()
        return {"draw": self.draw, "loops": self.loops, **facts}


class _MapCandidates:
    """Graphs that were solved for a run, of which the best is kept; maps of the others take no memory.

    Parameters
    ----------
    earlier : sequence of dict
        Rows of draws that a folder settled on not to use.
    """

    def __init__(self, earlier: Sequence[Mapping[str, Any]] = ()) -> None:
        self.rows = [dict(r) for r in earlier]
        self.best: _MapCandidate | None = None

    def add(self, attempt: _MapCandidate) -> None:
        """One more."""
        self.rows.append(attempt.row())
        if self.best is None or attempt.beats(self.best):
            self.best = attempt

    def of_others(self, draw: int) -> list[dict[str, Any]]:
        """Rows of all draws but one."""
        return [r for r in self.rows if r["draw"] != draw]

    def result(self) -> Run:
        """The best run, with what became of the others in its report and verdict."""
        best = self.best
        assert best is not None
        if len(self.rows) < 2:
            return best.run
        rows = sorted(self.rows, key=lambda r: (r["draw"], r["loops"]))
        rows = [{**r, "kept": (r["draw"], r["loops"]) == (best.draw, best.loops)} for r in rows]
        report = {**best.run.report, "map_attempts": rows}
        figures = RunMetrics(report, dict(zip(best.run.metrics["key"], best.run.metrics["value"])), best.run.events)
        lines = run_findings(figures)
        report["verdict"] = verdict_json(summarise_run(figures, lines), lines)
        return replace(best.run, report=report)


def _solved(
    taken: RunInputs,
    settings: cfg.RunConfig,
    submaps: list[Submap],
    back: BackEnd,
    seconds: dict[str, float],
    begin: Stopwatch,
    work: FrontEndTiming,
    effective: dict[str, Any],
    undo: Sequence[int | LoopDecision],
    draw: int,
    attempts: _MapCandidates,
) -> None:
    """Try the graph of a back end that has all submaps; where its passes deny each other a second one with loops.

    A graph without a loop and one with a wrong loop both show in the fused map: walls of one pass stand in what another
    one saw to be free. So the front end's matches alone are tried first, then loops that the back end looks for.
    """

    def made(back: BackEnd) -> _MapCandidate:
        _stage(back.observers, "graph")
        solution = back.finish(undo)
        spent = seconds | {"frontend": work.seconds} | {f"backend_{k}": v for k, v in back.seconds.items()}
        spent |= {"backend": sum(back.seconds.values()), "compilation": begin.compilation()}
        spent["total"] = begin.seconds()
        run = _evaluate_run(taken, settings, submaps, back, solution, spent, work, effective)
        return _MapCandidate(run, draw, back.config.looks)

    first = made(back)
    attempts.add(first)
    if settings.backend.loops != "auto" or not first.denied:
        return
    looking = replace(settings, backend=replace(settings.backend, loops=True))
    logger.warning("overlapping submaps contradict each other: searching loop closures between submaps")
    other = back_end(RecordSource(taken.log), looking, effective["run"]["solver"], _bars(back))
    for s in submaps:
        other.add(s)
    attempts.add(made(other))


def gps_stream(log: SensorLog) -> Gps | None:
    """The GPS stream of a log, if it has one."""
    name = log.of_type(Gps)
    return None if name is None else log[name]


def effective_config(
    source: str, frontend: str | list[str], solver: str, seed: int, front_config: Any, settings: cfg.RunConfig
) -> dict[str, Any]:
    """What ``config.toml`` holds: names, seed, and every option with its value."""
    run_part = {"source": source, "frontend": frontend, "solver": solver, "seed": seed}
    return {
        "run": run_part,
        "frontend": options_dict(front_config),
        "backend": options_dict(settings.backend),
        "gps": options_dict(settings.gps),
        "imu": options_dict(settings.imu),
        "compass": options_dict(settings.compass),
        "beacons": options_dict(settings.beacons),
        "refine": options_dict(settings.refine),
        "map": options_dict(settings.map),
        "calibrate": options_dict(settings.calibrate),
    }


def _evaluate_run(
    taken: RunInputs,
    settings: cfg.RunConfig,
    submaps: list[Submap],
    back: BackEnd,
    solution: Solution,
    seconds: dict[str, float],
    work: FrontEndTiming,
    effective: dict[str, Any],
) -> Run:
    """Metrics, residuals, and the value that the user gets."""
    log, drops = taken.log, DropCounter()
    gps = gps_stream(log)
    hits = back.landmark_hits(submaps)
    global_map = make_global_map(solution, submaps, hits, settings.backend.confirmed_hits)
    out = Metrics()
    front_end_metrics(out, submaps)
    solution_metrics(out, solution, len(global_map.landmarks))
    imu_metrics(out, back.graph, drops)
    clock, graph_path = time.perf_counter(), global_map.trajectory
    fixes = None if gps is None or solution.T_gps_world is None else (split_fixes(gps, settings.gps)[0], settings.gps)
    if settings.refine.use:
        _stage(back.observers, "refinement")
    refined, refining = refine_run(settings.refine, taken.scans, submaps, global_map, gps=fixes, graph=back.graph)
    seconds_refine = time.perf_counter() - clock
    trim_heap()
    if settings.map.fuse and has_maps(submaps):
        _stage(back.observers, "fused map")
    fused, why_not = _fused_map(submaps, global_map, settings.map, effective)
    ledger = back.graph.ledger
    if refined is not None:
        global_map = refined.map
        ledger, spent = refined_ledger(ledger, submaps, refined.refinement)
        refining = [*refining, *spent]
        seconds["refine"] = seconds_refine
        seconds["total"] += seconds["refine"]
        refinement_metrics(out, refined.refinement)
        if fused is not None and refined.submaps:
            unit = "m³" if fused.fused.dim == 3 else "m²"
            out.add("map_entropy_graph", fused.fused.entropy(), f"nat {unit}")
            out.add("map_known_volume_graph", fused.fused.known_volume(), unit)
            # the open chain is that of the front end, whose exits the refinement replaced
            chain = fused.open_entropy, fused.open_volume
            fused = None  # two maps of a long run at once would take twice the memory
            fused, why_not = _fused_map(refined.submaps, map_of_frames(refined.map), settings.map, effective)
            fused = None if fused is None else replace(fused, open_entropy=chain[0], open_volume=chain[1])
    if fused is not None:
        for row in fused.metrics():
            out.add(*row)
        seconds["map"] = fused.divide_s + fused.fuse_s + fused.move_s
        seconds["total"] += seconds["map"]
    _stage(back.observers, "evaluation")
    now = submaps[work.resumed :]
    scans = sum(int(s.report.get("scans", 0)) for s in now)
    begun = log.interval[0] if not work.resumed else submaps[work.resumed - 1].interval[1]
    time_metrics(out, seconds, log.interval[1] - begun if now else 0.0, scans, work.per_scan)
    out.add("path_length", global_map.trajectory.length(), "m")
    residuals = {}
    reckoned = dead_reckoned_path(log, global_map.trajectory)
    if gps is not None:
        withheld = ~used_fixes(gps, settings.gps)
        residuals = gps_metrics(out, global_map.trajectory, gps, withheld, global_map.T_gps_world)
        if back.graph.dim == 2:
            dead_reckoning_metrics(out, reckoned, gps)
    truth, identities = map_truth(log, submaps), "run"
    base = true_first_base(log, submaps[0])
    true_path = truth_path(log, global_map.trajectory.times, submaps[0])
    identified = [s.with_ids(back.graph.landmark_ids_of(s.key)) if s.landmarks is not None else s for s in submaps]
    checks = check_residual_consistency(
        out, back.graph, identified, global_map.trajectory, global_map.base_poses, gps, settings
    )
    if truth is not None:
        known = all(s.landmarks is None or bool(np.all(s.landmarks.ids >= 0)) for s in submaps)
        if refined is not None:
            truth, true_path = level_truth(truth, true_path, np.array(base))
            base = remove_roll_pitch(np.array(base)).tolist() if back.graph.dim == 3 else base
            refined_truth_metrics(out, global_map, refined.refinement, submaps, truth, path=true_path)
            if true_path is not None and len(true_path) >= 3:
                out.add("path_rmse_aligned_graph", ate(graph_path, true_path).statistics.rmse, "m")
                out.add(
                    "path_heading_rmse", np.rad2deg(heading_error(global_map.trajectory, true_path)), "deg", "lower"
                )
        elif back.graph.dim == 2:
            truth_metrics(out, solution, truth, identities=known, path=true_path)
        else:
            truth_metrics_in_space(out, solution, truth, path=true_path)
        identities = "truth" if known else "run"
    if taken.identities is not None:
        audit_association(out, taken.identities, *back.observation_labels(submaps))
    report = {
        "format": "graphslam.run/1",
        **effective["run"],
        "frontend": names if isinstance(names := effective["run"]["frontend"], str) else ", ".join(names),
        "backend": effective["backend"],
        "gps": effective["gps"],
        "imu": effective["imu"],
        "calibrate": effective.get("calibrate", {}),
        "T_world_base": base,
        "versions": versions(),
        "seconds": seconds,
        "resumed_submaps": work.resumed,
        "flagged_submaps": flag_counts(submaps),
        "records_read": dict(log.read),
        "records_dropped": {**log.dropped, **drops.counts},
        "source_meta": dict(log.meta),
        "identities": identities,
        "covariance_scale": settings.backend.covariance_scale,
        "objective": solution.objective,
        "converged": solution.converged,
        "graph": graph_metrics(back.graph, checks.classes),
        "evidence": consistency_tests_as_json(checks.evidence(submaps, refined=refined is not None)),
        "nonlinearity": pooled_nonlinearity([s.report for s in submaps]) if refined is None else 0.0,
    }
    if truth is not None:
        report["nees_chart"] = "group" if refined is not None or back.graph.dim == 3 else solution.chart
    if checks.gps is not None:
        report["gps_innovations"] = checks.gps.facts()
    lasting = bias_table(back.graph)
    if lasting:
        report["lasting"] = lasting
    if refined is not None:
        report["refine"] = refinement_facts(refined.refinement)
    if back.two_maps is not None:
        report["two_maps"] = back.two_maps.facts()
    if why_not:
        report["map_left_out"] = why_not
    if fused is not None and fused.said():
        report["map_coarser"] = fused.said()
    if fused is not None and len(fused.passes.pairs):
        report["map_passes"] = fused.passes.facts()
    used = frozenset().union(*(s.uses | s.assisting_streams for s in submaps))
    streams = stream_use(log, back.graph, settings, {**log.dropped, **drops.counts}, used)
    report["streams"] = [s.as_row() for s in streams]
    metrics = out.table()
    figures = RunMetrics(report, dict(zip(metrics["key"], metrics["value"])), back.graph.events)
    reports = [s.report for s in submaps]
    join = figures.metrics.get("join_chi2_per_dof"), figures.metrics.get("join_dof", 0.0)
    corrected = "noise" in effective.get("frontend", {})
    causes = explain_disagreement(log, settings.calibrate, *join, ranges_corrected=corrected)
    causes = [*causes, *bias_findings(lasting)]
    seen = [*causes, *sighting_findings(log, reports, {**log.dropped, **drops.counts}), *bias_test_findings(reports)]
    lines = [
        *findings_from_run(streams, taken.noticed, submaps, back.graph.events),
        *seen,
        *refining,
        *run_findings(figures),
    ]
    report["verdict"] = verdict_json(summarise_run(figures, lines), lines)
    return Run(
        name=log.name,
        submaps=identified,
        map=global_map,
        metrics=metrics,
        report=report,
        events=list(back.graph.events),
        ledger=ledger.table(),
        gps=residuals,
        fixes=None if gps is None or settings.gps.use == "none" else split_fixes(gps, settings.gps)[0],
        taken=taken,
        truth=truth,
        truth_path=true_path,
        dead_reckoning=reckoned,
        solution=solution,
        graph=back.graph,
        checks=checks,
        fused=fused,
        graph_path=None if refined is None else refined.graph_path,
        refined=refined,
        two_maps=None if back.two_maps is None else (back.two_maps.maps[0].path, back.two_maps.maps[1].path),
    )


def _fused_map(
    submaps: list[Submap], m: GlobalMap, config: cfg.MapConfig, effective: Mapping[str, Any]
) -> tuple[RunMap | None, str]:
    """The fused map of dense submaps; or None, and why where there could have been one."""
    if not (config.fuse and has_maps(submaps)):
        return None, ""
    try:
        return make_run_map(submaps, m, reach=sensor_reach(effective), config=config), ""
    except GraphSlamError as error:  # a run that is solved is not thrown away for its map
        logger.warning("no fused map: %s", error)
        return None, str(error)
