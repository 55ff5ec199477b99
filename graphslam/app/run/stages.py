"""From a solved graph to a run: path refinement, map fusion, evaluation, and verdict."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from graphslam.app.machine import Stopwatch, versions
from graphslam.app.run.audit import audit_association
from graphslam.app.run.calibration import bias_findings, bias_table, explain_disagreement
from graphslam.app.run.control import check_metrics, control_facts, control_findings, left_out_of_refinement
from graphslam.app.run.maps import sensor_reach
from graphslam.app.run.outputs import graph_metrics
from graphslam.app.run.residual_consistency import ResidualConsistency, check_residual_consistency
from graphslam.app.run.run import Run
from graphslam.app.run.run_inputs import RunInputs
from graphslam.app.run.stream_use import stream_use
from graphslam.app.run.submap_slam import SubmapSlam, tell_stage
from graphslam.app.run.summary import summarise_run
from graphslam.app.verdict.checks import run_findings
from graphslam.app.verdict.figures import RunMetrics
from graphslam.app.verdict.observed import findings_from_run
from graphslam.backend.config import GpsOptions
from graphslam.backend.refining import RefinedRun, refine_run, refined_ledger
from graphslam.backend.streams import split_fixes, used_fixes
from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding, verdict_json
from graphslam.core.heap import trim_heap
from graphslam.core.log import DropCounter
from graphslam.core.map_truth import MapTruth
from graphslam.core.poses import remove_roll_pitch
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.bias_test import bias_test_findings
from graphslam.evaluate.check_points import CheckPoints, check_points
from graphslam.evaluate.covariance_assessment import consistency_tests_as_json, pooled_nonlinearity
from graphslam.evaluate.dead_reckoning_baseline import dead_reckoned_path
from graphslam.evaluate.gps import GpsResiduals
from graphslam.evaluate.landmark_checks import observation_findings
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
from graphslam.evaluate.trajectory_error import ate
from graphslam.graph.ledger import Ledger
from graphslam.graph.sensors.control import ROBUST, SPANNED, ControlFactors
from graphslam.maps.global_map import GlobalMap, make_global_map
from graphslam.maps.refined import map_of_frames
from graphslam.maps.run_map import RunMap, has_maps, make_run_map
from graphslam.solve.solution import Solution

logger = logging.getLogger(__name__)


class RunClock:
    """Run time of the parts of a run [s].

    Parameters
    ----------
    before : float
        Seconds of earlier work.
    """

    def __init__(self, before: float = 0.0) -> None:
        self.watch = Stopwatch(before)
        self.seconds = {"load": 0.0, "calibrate": 0.0}
        self._last = time.perf_counter()

    def lap(self, part: str) -> None:
        """Assign the time since the previous call to this part."""
        now = time.perf_counter()
        self.seconds[part], self._last = now - self._last, now

    def until_now(self, slam: SubmapSlam) -> dict[str, float]:
        """Seconds per part, including front end and back end."""
        back = slam.back.seconds
        spent = self.seconds | {"frontend": slam.timing.seconds} | {f"backend_{k}": v for k, v in back.items()}
        spent |= {"backend": sum(back.values()), "compilation": self.watch.compilation()}
        return spent | {"total": self.watch.seconds()}


@dataclass
class SolvedMap:
    """A solved graph to which each stage of the run adds its results.

    Parameters
    ----------
    map : GlobalMap
        Of the graph, or along the refined path.
    findings : list of Finding
        Of refinement and map fusion.
    truth, truth_path, base
        Ground truth of the map, in its frame; pose of the first base in the world.
    """

    inputs: RunInputs
    slam: SubmapSlam
    solution: Solution
    seconds: dict[str, float]
    map: GlobalMap
    ledger: Ledger
    config: dict[str, Any]
    out: Metrics = field(default_factory=Metrics)
    drops: DropCounter = field(default_factory=DropCounter)
    refined: RefinedRun | None = None
    findings: list[Finding] = field(default_factory=list)
    fused: RunMap | None = None
    why_no_map: str = ""
    residuals: dict[str, GpsResiduals] = field(default_factory=dict)
    checked: CheckPoints | None = None
    control_rows: list[str] = field(default_factory=list)
    dead_reckoning: Trajectory | None = None
    truth: MapTruth | None = None
    truth_path: Trajectory | None = None
    base: list[float] | None = None

    @property
    def gps(self) -> Gps | None:
        """The GPS stream of the log, if it has one."""
        name = self.inputs.log.of_type(Gps)
        return None if name is None else self.inputs.log[name]

    def fuse(self, submaps: list[Submap], frames: GlobalMap) -> None:
        """Fuse the dense submaps; if this fails, keep the reason."""
        self.fused, self.why_no_map = None, ""
        config = self.slam.options.settings.map
        if not (config.fuse and has_maps(submaps)):
            return
        try:
            self.fused = make_run_map(submaps, frames, reach=sensor_reach(self.config), config=config)
        except GraphSlamError as error:  # a failed map does not discard the solved run
            logger.warning("no fused map: %s", error)
            self.why_no_map = str(error)


def run_of_solution(inputs: RunInputs, slam: SubmapSlam, solution: Solution, clock: RunClock) -> Run:
    """Make the run of a solved graph: refine, fuse, evaluate, and add the verdict."""
    hits, settings = slam.back.landmark_hits(slam.submaps), slam.options.settings
    graph_map = make_global_map(solution, slam.submaps, hits, settings.backend.confirmed_hits)
    made = SolvedMap(
        inputs, slam, solution, clock.until_now(slam), graph_map, slam.back.graph.ledger, slam.options.as_config()
    )
    front_end_metrics(made.out, slam.submaps)
    solution_metrics(made.out, solution, len(graph_map.landmarks))
    imu_metrics(made.out, slam.back.graph, made.drops)
    if settings.refine.use:
        tell_stage(slam.back.observers, "refinement")
    _refine(made)
    if settings.map.fuse and has_maps(slam.submaps):
        tell_stage(slam.back.observers, "fused map")
    _fuse(made, graph_map)
    tell_stage(slam.back.observers, "evaluation")
    _time_and_path(made)
    _gps(made)
    _check(made)
    identified = [
        s.with_ids(slam.back.graph.landmark_ids_of(s.key)) if s.landmarks is not None else s for s in slam.submaps
    ]
    path, bases = made.map.trajectory, made.map.base_poses
    checks = check_residual_consistency(made.out, slam.back.graph, identified, path, bases, made.gps, settings)
    identities = _truth(made, graph_map.trajectory)
    if inputs.identities is not None:
        audit_association(made.out, inputs.identities, *slam.back.observation_labels(slam.submaps))
    report = _report(made, checks, identities)
    _verdict(made, report)
    fixes = None if made.gps is None or settings.gps.use == "none" else split_fixes(made.gps, settings.gps)[0]
    two, refined = slam.back.two_maps, made.refined
    return Run(
        name=inputs.log.name,
        submaps=identified,
        map=made.map,
        metric_rows=list(made.out.rows),
        report=report,
        events=list(slam.back.graph.events),
        ledger_rows=made.ledger.rows(),
        gps=made.residuals,
        fixes=fixes,
        inputs=inputs,
        truth=made.truth,
        truth_path=made.truth_path,
        dead_reckoning=made.dead_reckoning,
        solution=solution,
        graph=slam.back.graph,
        checks=checks,
        fused=made.fused,
        graph_path=None if refined is None else refined.graph_path,
        refined=refined,
        two_maps=None if two is None else (two.maps[0].path, two.maps[1].path),
    )


def _refine(made: SolvedMap) -> None:
    """Refine the path with its scans."""
    clock, settings = time.perf_counter(), made.slam.options.settings
    gps, submaps, graph = made.gps, made.slam.submaps, made.slam.back.graph
    fixes = None
    if gps is not None and made.solution.T_gps_world is not None:
        fixes = split_fixes(gps, settings.gps)[0], settings.gps
    control = None if made.slam.control is None else ControlFactors.of(graph)
    own = None if fixes is not None or control is None else control.as_fixes()
    if own is not None:
        baseline = SPANNED * float(np.median(own[0].sigma))
        fixes = own[0], GpsOptions(robust=ROBUST, baseline=baseline, errors="stated")
    what = "GPS fixes" if own is None else "control points"
    made.refined, findings = refine_run(
        settings.refine, made.inputs.scans, submaps, made.map, gps=fixes, graph=graph, fixes=what
    )
    made.findings = list(findings)
    if made.refined is not None:
        if control is not None:
            if own is not None and made.refined.refinement.fixes is not None:
                made.control_rows = own[1]
            held = len(made.control_rows)
            if held < len(control.used):
                made.findings.append(left_out_of_refinement(held, len(control.used)))
            if own is not None and control.frame != "gps":  # the frame of the control points is not the GPS frame
                made.refined = replace(made.refined, map=replace(made.refined.map, T_gps_world=None))
        made.seconds["refine"] = time.perf_counter() - clock
        made.seconds["total"] += made.seconds["refine"]
    trim_heap()


def _fuse(made: SolvedMap, graph_map: GlobalMap) -> None:
    """The fused map, along the refined path if there is one."""
    submaps, refined, frames = made.slam.submaps, made.refined, graph_map
    if refined is not None:
        made.map = refined.map
        made.ledger, spent = refined_ledger(made.ledger, submaps, refined.refinement, made.control_rows)
        made.findings += spent
        refinement_metrics(made.out, refined.refinement)
        if refined.submaps:
            submaps, frames = refined.submaps, map_of_frames(refined.map)
    made.fuse(submaps, frames)
    fused = made.fused
    if fused is not None:
        for row in fused.metrics():
            made.out.add(*row)
        made.seconds["map"] = fused.divide_s + fused.fuse_s
        made.seconds["total"] += made.seconds["map"]
        removed, every = fused.moving
        if removed:
            text = f"moving objects: {removed} of {every} points ({removed / every:.1%}) — removed from the map."
            made.findings.append(Finding("", "moving", text))


def _time_and_path(made: SolvedMap) -> None:
    submaps, work, log = made.slam.submaps, made.slam.timing, made.inputs.log
    now = submaps[work.resumed :]
    scans = sum(int(s.report.get("scans", 0)) for s in now)
    begun = log.interval[0] if not work.resumed else submaps[work.resumed - 1].interval[1]
    time_metrics(made.out, made.seconds, log.interval[1] - begun if now else 0.0, scans, work.per_scan)
    made.out.add("path_length", made.map.trajectory.length(), "m")


def _gps(made: SolvedMap) -> None:
    """Compare the path with the fixes, used and withheld, and add dead reckoning."""
    path, gps = made.map.trajectory, made.gps
    made.dead_reckoning = dead_reckoned_path(made.inputs.log, path)
    if gps is None:
        return
    withheld = ~used_fixes(gps, made.slam.options.settings.gps)
    made.residuals = gps_metrics(made.out, path, gps, withheld, made.map.T_gps_world)
    if made.slam.back.graph.dim == 2:
        dead_reckoning_metrics(made.out, made.dead_reckoning, gps)


def _check(made: SolvedMap) -> None:
    """Compare the path with the check points."""
    table, r = made.slam.check, made.refined
    if table is not None:
        refined = None if r is None else (r.refinement, r.map.trajectory)
        made.checked = check_points(made.slam.back.graph, table, refined)
        check_metrics(made.out, made.checked)


def _truth(made: SolvedMap, graph_path: Trajectory) -> str:
    """Compare with ground truth, if known; returns the source of the landmark identities, ``truth`` or ``run``."""
    log, submaps, out, path, refined = (
        made.inputs.log,
        made.slam.submaps,
        made.out,
        made.map.trajectory,
        made.refined,
    )
    truth = map_truth(log, submaps)
    base = true_first_base(log, submaps[0])
    true_path = truth_path(log, path.times, submaps[0])
    identities, dim = "run", made.slam.back.graph.dim
    if truth is not None:
        known = all(s.landmarks is None or bool(np.all(s.landmarks.ids >= 0)) for s in submaps)
        if refined is not None:
            truth, true_path = level_truth(truth, true_path, np.array(base), path)
            base = remove_roll_pitch(np.array(base)).tolist() if dim == 3 else base
            refined_truth_metrics(out, made.map, refined.refinement, submaps, truth, path=true_path)
            if true_path is not None and len(true_path) >= 3:
                out.add("path_rmse_aligned_graph", ate(graph_path, true_path).statistics.rmse, "m")
                out.add("path_heading_rmse", np.rad2deg(heading_error(path, true_path)), "deg", "lower")
        elif dim == 2:
            truth_metrics(out, made.solution, truth, identities=known, path=true_path)
        else:
            truth_metrics_in_space(out, made.solution, truth, path=true_path)
        identities = "truth" if known else "run"
    made.truth, made.truth_path, made.base = truth, true_path, base
    return identities


def _report(made: SolvedMap, checks: ResidualConsistency, identities: str) -> dict[str, Any]:
    """Content of ``run.json`` without the verdict."""
    log, back, config, fused = made.inputs.log, made.slam.back, made.config, made.fused
    submaps, refined, settings = made.slam.submaps, made.refined, made.slam.options.settings
    names, dropped = config["run"]["frontend"], {**log.dropped, **made.drops.counts}
    report = {
        "format": "graphslam.run/1",
        **{k: v for k, v in config["run"].items() if k not in ("control", "check")},
        "frontend": names if isinstance(names, str) else ", ".join(names),
        "backend": config["backend"],
        "gps": config["gps"],
        "imu": config["imu"],
        "calibrate": config.get("calibrate", {}),
        "T_world_base": made.base,
        "versions": versions(),
        "seconds": made.seconds,
        "resumed_submaps": made.slam.timing.resumed,
        "flagged_submaps": flag_counts(submaps),
        "records_read": dict(log.read),
        "records_dropped": dropped,
        "source_meta": dict(log.meta),
        "identities": identities,
        "covariance_scale": settings.backend.covariance_scale,
        "objective": made.solution.objective,
        "converged": made.solution.converged,
        "graph": graph_metrics(back.graph, checks.classes),
        "evidence": consistency_tests_as_json(checks.evidence(submaps, refined=refined is not None)),
        "nonlinearity": pooled_nonlinearity([s.report for s in submaps]) if refined is None else 0.0,
    }
    if made.truth is not None:
        report["nees_chart"] = "group" if refined is not None or back.graph.dim == 3 else made.solution.chart
    if checks.gps is not None:
        report["gps_innovations"] = checks.gps.facts()
    biases = bias_table(back.graph)
    if biases:
        report["biases"] = biases
    if made.slam.control is not None:
        report["control_points"] = control_facts(back.graph, made.slam.control)
    if made.checked is not None:
        report["check_points"] = made.checked.facts()
    if refined is not None:
        report["refine"] = refinement_facts(refined.refinement)
    if back.two_maps is not None:
        report["two_maps"] = back.two_maps.facts()
    if made.why_no_map:
        report["map_left_out"] = made.why_no_map
    if fused is not None and fused.coarse_note():
        report["map_coarser"] = fused.coarse_note()
    if fused is not None and len(fused.passes.pairs):
        report["map_passes"] = fused.passes.facts()
    return report


def _verdict(made: SolvedMap, report: dict[str, Any]) -> None:
    """Add the use of every stream, and the findings, to the report."""
    log, submaps, graph = made.inputs.log, made.slam.submaps, made.slam.back.graph
    settings, dropped = made.slam.options.settings, report["records_dropped"]
    used = frozenset().union(*(s.uses | s.assisting_streams for s in submaps))
    streams = stream_use(log, graph, settings, dropped, used)
    report["streams"] = [s.as_row() for s in streams]
    figures = RunMetrics.of_rows(report, made.out.rows, graph.events)
    reports = [s.report for s in submaps]
    join = figures.metrics.get("join_chi2_per_dof"), figures.metrics.get("join_dof", 0.0)
    corrected = "noise" in made.config.get("frontend", {})
    lines = [
        *findings_from_run(streams, made.inputs.noticed, submaps, graph.events),
        *explain_disagreement(log, settings.calibrate, *join, ranges_corrected=corrected),
        *bias_findings(report.get("biases", [])),
        *observation_findings(log, reports, dropped),
        *bias_test_findings(reports),
        *made.findings,
        *control_findings(report),
        *run_findings(figures),
    ]
    report["verdict"] = verdict_json(summarise_run(figures, lines), lines)
