"""Metrics of a run: front end, map joining, time, GPS, ground truth."""

from __future__ import annotations

import difflib
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.core.charts import apply_inverse_left_jacobian
from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.map_truth import MapTruth
from graphslam.core.plan_view import plan_path, plan_pose
from graphslam.core.poses import group_of, rotation_matrices
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.consistency import joint_nees, vector_pose_error
from graphslam.evaluate.gauge import aligned_nees
from graphslam.evaluate.gps import GpsResiduals, gps_residuals
from graphslam.evaluate.map_error import landmark_error, match_ids
from graphslam.evaluate.residual_consistency import NOT_TESTED, class_consistency, two_sided_bounds
from graphslam.evaluate.trajectory_error import ate
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.solve.solution import Solution

if TYPE_CHECKING:
    import pandas as pd

logger = logging.getLogger(__name__)

TRUTH_GAP = 0.5
"""Longest interval between ground-truth records over which the true pose is interpolated [s]."""


TIMES = re.compile(r"^seconds_|_seconds$|^times_real_time$|^frontend_ms_per_scan$|^frontend_last_to_first_quarter$")
"""Metrics that are measured with a clock: they differ between runs and are stored in a separate file."""


def is_time(key: object) -> bool:
    """Is it the key of a metric that was measured with a clock?"""
    return TIMES.search(str(key)) is not None


COLUMNS = ("key", "value", "unit", "direction")
"""Columns of the metrics as a table."""


@dataclass
class Metrics:
    """Rows of ``metrics.json`` and ``timings.json``."""

    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, key: str, value: float, unit: str = "", direction: str = "none") -> None:
        """Add one metric; ``direction`` is what is better: lower, higher, one (nearer to 1) or none."""
        self.rows.append({"key": key, "value": float(value), "unit": unit, "direction": direction})


def metric_value(rows: Iterable[Mapping[str, Any]], key: str) -> float:
    """Value of one row of metrics; KeyError if there is none."""
    values = {row["key"]: float(row["value"]) for row in rows}
    if key not in values:
        close = ", ".join(difflib.get_close_matches(key, values)) or "none is similar"
        raise KeyError(f"no metric {key!r} in this run ({close}); run.metrics lists all")
    return values[key]


def metric_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Metrics as a pandas table, one row each: key, value, unit, and which direction is better."""
    from graphslam.evaluate.figure_table import FigureTable

    return FigureTable(list(rows), columns=COLUMNS)


def front_end_metrics(out: Metrics, submaps: Sequence[Submap]) -> None:
    """Counts, χ²/dof summed over the submaps, effective sample size, number of flagged submaps."""
    out.add("submaps", len(submaps))
    reports = [s.report for s in submaps]
    for key, unit in (("scans", ""), ("observations", ""), ("used", ""), ("not_associated", ""), ("trimmed", "")):
        if all(key in r for r in reports):
            out.add(f"frontend_{key}", sum(r[key] for r in reports), unit)
    if all("chi2" in r for r in reports) and sum(r["dof"] for r in reports) > 0:
        chi2, dof = sum(r["chi2"] for r in reports), sum(r["dof"] for r in reports)
        used, scans = sum(r["used"] for r in reports), sum(r["scans"] for r in reports)
        out.add("submap_chi2_per_dof", chi2 / dof, "", "one")
        for part in ("range", "bearing"):
            if all(f"chi2_{part}" in r for r in reports):
                total = sum(r[f"chi2_{part}"] for r in reports)
                out.add(f"submap_chi2_{part}", total / max(used, 1), "per observation")
        if all("chi2_odometry" in r for r in reports):
            out.add("submap_chi2_odometry", sum(r["chi2_odometry"] for r in reports) / (3 * scans), "per component")
    if all("min_ess" in r for r in reports):
        out.add("min_ess_median", float(np.median([r["min_ess"] for r in reports])), "particles", "higher")
    if any("flag" in r for r in reports):
        out.add("flagged_submaps", flag_counts(submaps)["any"], "", "lower")


def flag_counts(submaps: Sequence[Submap]) -> dict[str, int]:
    """Number of submaps that the front end flagged, for each reason and for ``any``."""
    flags = [s.report.get("flag", []) for s in submaps]
    reasons = sorted({reason for f in flags for reason in f})
    return {"any": sum(bool(f) for f in flags)} | {r: sum(r in f for f in flags) for r in reasons}


def solution_metrics(out: Metrics, solution: Solution, confirmed: int) -> None:
    """Objective, χ² and dof per class of factors, gap, number of landmarks."""
    out.add("objective", solution.objective, "", "lower")
    classes: dict[str, tuple[float, float]] = {}
    for name, c in solution.score.classes.items():
        label = "join" if name in ("submap", "dense-submap") else name
        chi2, dof = classes.get(label, (0.0, 0.0))
        classes[label] = chi2 + c.chi2, dof + c.dof
    for label, (chi2, dof) in classes.items():
        out.add(f"{label}_chi2", chi2)
        out.add(f"{label}_dof", dof)
        if dof > 0 and label not in NOT_TESTED:
            out.add(f"{label}_chi2_per_dof", chi2 / dof, "", "one")
    out.add("gap", solution.gap if solution.gap is not None else float("nan"), "", "lower")
    out.add("converged", float(solution.converged), "", "higher")
    out.add("states", solution.states)
    out.add("landmarks", len(solution.landmarks))
    out.add("landmarks_confirmed", confirmed)


def gps_metrics(
    out: Metrics, trajectory: Trajectory, gps: Gps, withheld: np.ndarray, T_gps_world: Array | None
) -> dict[str, GpsResiduals]:
    """RMSE, median and p95 at the antenna, with the graph's datum or after rigid alignment to the scored fixes."""
    results: dict[str, GpsResiduals] = {}
    if len(gps.times) < 2:
        return results
    if trajectory.dim == 3:  # scored in the plane, seen from above
        trajectory = plan_path(trajectory)
        T_gps_world = None if T_gps_world is None else plan_pose(T_gps_world)
    try:
        if T_gps_world is None:
            results["all"] = gps_residuals(trajectory, gps)
        else:
            results["all"] = gps_residuals(trajectory, gps, T_gps_map=T_gps_world)
            if np.any(withheld):
                results["withheld"] = gps_residuals(trajectory, gps, T_gps_map=T_gps_world, score=withheld)
    except DataError:  # no fix on the path
        return results
    for name, r in results.items():
        s = r.statistics
        prefix = "gps" if name == "all" else "gps_withheld"
        for key, value in (("rmse", s.rmse), ("median", s.median), ("p95", s.p95), ("max", s.maximum)):
            out.add(f"{prefix}_{key}", value, "m", "lower")
        out.add(f"{prefix}_fixes", s.count)
        out.add(f"{prefix}_fixes_off_the_path", r.outside + r.in_gap)
    return results


def dead_reckoning_metrics(out: Metrics, path: Trajectory | None, gps: Gps) -> None:
    """GPS error of pure dead reckoning, as a baseline for that of the map."""
    if path is None or len(gps.times) < 2:
        return
    try:
        s = gps_residuals(path, gps).statistics
    except DataError:
        return
    out.add("gps_dead_reckoning_rmse", s.rmse, "m")
    out.add("gps_dead_reckoning_median", s.median, "m")


def map_truth(log: SensorLog, submaps: Sequence[Submap]) -> MapTruth | None:
    """True poses at the ends of the submaps and true landmarks, in the frame of the first base; None if unknown.

    Submaps that end in a gap of the ground truth (:data:`TRUTH_GAP`) or after its last record are left out.
    """
    if log.truth is None or not submaps:
        return None
    path = log.truth.trajectory
    start = np.array([submaps[0].interval[0]])
    if not _covered(path, start)[0]:
        return None
    g = group_of(path.poses)
    base = true_base(path, submaps[0])
    times = np.array([s.interval[1] for s in submaps])
    known = _covered(path, times)
    ends = path.interpolate(times[known])
    if g.dim == 3:  # in 3-D the frame at an exit can differ from the body's: bases are level
        ends = g.compose(ends, np.array([_exit_of_body(s) for s in submaps])[known])
    return MapTruth(
        keys=np.array([s.key for s in submaps], dtype=np.int64)[known],
        exit_poses=g.between(np.broadcast_to(base, ends.shape), ends),
        landmark_ids=log.truth.landmark_ids,
        landmarks=g.transform(g.inverse(base), log.truth.landmarks)
        if len(log.truth.landmarks)
        else np.zeros((0, g.dim)),
    )


def true_base(path: Trajectory, first: Submap) -> Array:
    """True pose of the first submap's base, in the frame of the true ``path``.

    In 3-D a base can be a level frame that differs from the body (as in SegSLAM); the submap's own path gives the pose
    of the body in it.
    """
    at = path.interpolate(np.array([first.interval[0]]))[0]
    own = first.trajectory
    if path.dim == 2 or own is None or not len(own):
        return at
    return group_of(at).compose(at, group_of(at).inverse(own.poses[0]))


def _exit_of_body(submap: Submap) -> Array:
    """``T_body_exit`` at the end of a submap's path."""
    g, own = group_of(submap.exit_pose), submap.trajectory
    return g.identity if own is None or not len(own) else g.between(own.poses[-1], submap.exit_pose)


def _covered(path: Trajectory, times: Array) -> np.ndarray:
    """Mask of ``times`` inside the path and outside its gaps."""
    inside = (times >= path.times[0]) & (times <= path.times[-1])
    j = np.clip(np.searchsorted(path.times, times), 1, len(path) - 1)
    return np.asarray(inside & (path.times[j] - path.times[j - 1] <= TRUTH_GAP))


def truth_path(log: SensorLog, times: Array, first: Submap | None = None) -> Trajectory | None:
    """True path at those of ``times`` where it is known, in the frame of the base at the first of them.

    Parameters
    ----------
    first : Submap, optional
        The first submap, whose base can differ from the body in 3-D (:func:`true_base`).
    """
    if log.truth is None:
        return None
    path = log.truth.trajectory
    inside = times[_covered(path, times)]
    if len(inside) == 0:
        return None
    poses = path.interpolate(inside)
    base = poses[0]
    if path.dim == 3 and first is not None and _covered(path, np.array([first.interval[0]]))[0]:
        base = true_base(path, first)
    return Trajectory(inside, group_of(poses).between(np.broadcast_to(base, poses.shape), poses))


def true_first_base(log: SensorLog, first: Submap) -> list[float] | None:
    """True pose of the first base in the world frame of the log, which several logs may share; None if unknown.

    Logs of one simulated world share a frame (``meta["T_world_frame"]``); the others use the ground-truth frame.
    """
    if log.truth is None or not _covered(log.truth.trajectory, np.array([first.interval[0]]))[0]:
        return None
    path = log.truth.trajectory
    base = true_base(path, first) if path.dim == 3 else path.interpolate(np.array([first.interval[0]]))[0]
    if "T_world_frame" in log.meta:
        base = group_of(base).compose(np.asarray(log.meta["T_world_frame"], dtype=np.float64), base)
    return [float(v) for v in base]


def truth_metrics(
    out: Metrics, solution: Solution, truth: MapTruth, *, identities: bool, path: Trajectory | None = None
) -> None:
    """RMSE and NEES with the first base fixed, and after a rigid alignment; landmarks only with true identities.

    The first gauge uses the true pose of the first base; an error of its heading adds to all errors. Its NEES uses the
    parametrisation of the map (:mod:`graphslam.core.charts`), ``nees_plain`` that of plain vectors. In the second gauge
    the map is aligned with the ground truth (three degrees of freedom less in the NEES): separately for landmarks and
    path, and by generalised least squares over all for the NEES.

    Parameters
    ----------
    path : Trajectory, optional
        True path at full rate, for the error of the whole path.
    """
    i, j = match_ids(solution.submap_keys, truth.keys)
    node = solution.exit_nodes[i]
    true_poses = truth.exit_poses[j]
    e_pose = vector_pose_error(solution.poses[node], true_poses)
    out.add("pose_rmse", float(np.sqrt(np.mean(np.sum(e_pose[:, :2] ** 2, axis=1)))), "m", "lower")
    out.add("heading_rmse", float(np.rad2deg(np.sqrt(np.mean(e_pose[:, 2] ** 2)))), "deg", "lower")
    P = solution.joint_covariance()
    first_landmark = 3 * (len(solution.poses) - 1)
    error, points = e_pose.ravel(), np.zeros((0, 2))
    ix = (3 * (node - 1)[:, None] + np.arange(3)).ravel()
    n_pose = len(error)
    turned = np.zeros(len(solution.poses))  # heading errors
    turned[node] = e_pose[:, 2]
    charted = np.column_stack([apply_inverse_left_jacobian(e_pose[:, :2], e_pose[:, 2]), e_pose[:, 2]]).ravel()
    if identities:
        ours, theirs = match_ids(solution.landmark_ids, truth.landmark_ids)
        points = solution.landmarks[ours]
        e_lm = truth.landmarks[theirs] - points
        out.add("landmark_rmse", float(np.sqrt(np.mean(np.sum(e_lm**2, axis=1)))), "m", "lower")
        error = np.concatenate([error, e_lm.ravel()])
        charted = np.concatenate([charted, apply_inverse_left_jacobian(e_lm, turned[solution.anchors[ours]]).ravel()])
        ix = np.concatenate([ix, (first_landmark + 2 * ours[:, None] + np.arange(2)).ravel()])
        if len(ours) >= 2:
            rigid = landmark_error(
                truth.landmark_ids[theirs], points, truth.landmark_ids, truth.landmarks, gauge="rigid"
            )
            out.add("landmark_rmse_aligned", rigid.statistics.rmse, "m", "lower")
    if path is not None and len(path) >= 3:
        whole = ate(solution.trajectory(covariances=False), path, alignment="se")
        out.add("path_rmse_aligned", whole.statistics.rmse, "m", "lower")
        out.add("path_max_aligned", whole.statistics.maximum, "m", "lower")
    P = P[np.ix_(ix, ix)]
    add_nees(out, "nees", joint_nees(charted if solution.chart == "group" else error, covariance=P), len(error))
    out.add("nees_plain", joint_nees(error, covariance=P))
    poses_error = (charted if solution.chart == "group" else error)[:n_pose].reshape(-1, 3)
    add_axis_nees(out, poses_error, P[:n_pose, :n_pose], AXES[2])
    true_points = truth.landmarks[theirs] if identities else points
    parts = {"": slice(None), "_poses": slice(0, n_pose), "_landmarks": slice(n_pose, None)}
    for name, part in parts.items():
        m, n = (0 if name == "_landmarks" else len(node)), (0 if name == "_poses" else len(points))
        dof = 3 * m + 2 * n - 3
        if dof > 0:
            estimate, true = (solution.poses[node][:m], points[:n]), (true_poses[:m], true_points[:n])
            add_nees(out, f"nees_aligned{name}", aligned_nees(*estimate, true, P[part, part]), dof)


def add_nees(out: Metrics, key: str, nees: float, dof: int) -> None:
    """A NEES, its dimension, their ratio, and the consistency index (eq. 20)."""
    out.add(key, nees)
    out.add(f"{key}_dof", dof)
    out.add(f"{key}_per_dof", nees / dof, "", "one")
    out.add("ci" if key == "nees" else key.replace("nees", "ci"), nees / chi2_quantile(0.95, dof), "", "lower")


def time_metrics(out: Metrics, seconds: Mapping[str, float], duration: float, scans: float, cost: Array) -> None:
    """Seconds per stage, speed relative to real time, and whether the cost per scan grows over the log.

    The speed excludes compilation. ``duration`` is that of the records processed in this run, not before a resume.
    """
    for stage, value in seconds.items():
        out.add(f"seconds_{stage}", value, "s", "lower")
    total = seconds.get("total", 0.0) - seconds.get("compilation", 0.0)
    if total > 0 and duration > 0:
        out.add("times_real_time", duration / total, "x", "higher")
    if scans:
        out.add("frontend_ms_per_scan", 1e3 * seconds.get("frontend", 0.0) / scans, "ms", "lower")
    if len(cost) >= 8:
        quarter = len(cost) // 4
        out.add(
            "frontend_last_to_first_quarter", float(np.median(cost[-quarter:]) / np.median(cost[:quarter])), "x", "one"
        )


def imu_metrics(out: Metrics, graph: FactorGraph, drops: DropCounter) -> None:
    """Final biases, number of nodes, and dropped readings; also as events and drop counts."""
    events: list[dict[str, Any]] = [e for e in graph.events if e["event"] == "imu"]
    imus = ImuFactors.of(graph)
    for stream in imus.used:
        states = imus.states(stream)
        mine = [e for e in events if e["stream"] == stream]
        for reason, n in (mine[-1]["dropped"] if mine else {}).items():
            drops.drop(stream, f"no factor: {reason}", n)
        if not states.order:
            continue
        row = states.bias[states.order[-1]]
        bias, P = graph.values.imu_biases[row], graph.covariance().marginal(f"imubias{row}")
        sigma = np.sqrt(np.diag(P))
        prefix = stream if stream.startswith("imu") else f"imu_{stream}"
        out.add(f"{prefix}_nodes", len(states.order))
        turns = 1 if graph.dim == 2 else 3
        for name, part, unit in (("gyro", slice(turns), "rad/s"), ("force", slice(turns, None), "m/s²")):
            out.add(f"{prefix}_{name}_bias", float(np.linalg.norm(bias[part])), unit)
            out.add(f"{prefix}_{name}_bias_sigma", float(np.linalg.norm(sigma[part])), unit)
        graph.log_event("imu-bias", stream=stream, bias=bias.tolist(), sigma=sigma.tolist())
    _contradiction(graph)


def _contradiction(graph: FactorGraph) -> None:
    """Log a warning if the χ² of the preintegrated IMU factors exceeds the upper bound at 99.9 % (two-sided)."""
    test = class_consistency(graph).get("imu") if ImuFactors.of(graph).used else None
    if test is None or not np.isfinite(test.ratio):
        return
    high = two_sided_bounds(test.ratio, test.dof, 0.999)[1]
    if test.ratio > high:
        graph.log_event("imu-contradicted", chi2_per_dof=test.ratio, high=high)
        logger.warning(
            "submaps and IMU contradict each other: χ²/dof %.1f [≤ %.1f]; the assumed noise of one of them is too "
            "small",
            test.ratio,
            high,
        )


BLOCKS = {"position": slice(3, 6), "heading": slice(2, 3), "level": slice(0, 2)}
"""Tangent components of the NEES blocks: position, heading, roll and pitch."""


def truth_metrics_in_space(
    out: Metrics, solution: Solution, truth: MapTruth, *, path: Trajectory | None = None
) -> None:
    """RMSE and NEES of the ends of the submaps with the first base fixed, and errors of the path after an alignment.

    Errors are right tangents, ``Log(T_est⁻¹ T_true)``. The NEES of a block is the mean over the submaps from their
    marginals; ``nees`` is that of all ends jointly.

    Parameters
    ----------
    path : Trajectory, optional
        True path at full rate.
    """
    i, j = match_ids(solution.submap_keys, truth.keys)
    nodes = solution.exit_nodes[i]
    P = solution.joint_marginal([f"x{n}" for n in nodes])
    end_metrics(out, solution.poses[nodes], P, truth.exit_poses[j], solution.trajectory(covariances=False), path)


def end_metrics(
    out: Metrics, poses: Array, P: Array, true_poses: Array, estimate: Trajectory, path: Trajectory | None
) -> None:
    """RMSE and NEES of the ends of submaps ``(m, 7|3)`` with joint covariance ``P`` ``(m d, m d)``, and of a path."""
    g = group_of(poses)
    blocks = BLOCKS if g.dim == 3 else {"position": g.position, "heading": slice(2, 3)}
    e = g.log(g.between(poses, true_poses))
    out.add("pose_rmse", rms(e[:, blocks["position"]]), "m", "lower")
    out.add("heading_rmse", np.rad2deg(rms(e[:, blocks["heading"]])), "deg", "lower")
    if "level" in blocks:
        out.add("level_rmse", np.rad2deg(rms(e[:, blocks["level"]])), "deg", "lower")
    if path is not None and len(path) >= 3:
        for name, alignment in (("path_rmse", "none"), ("path_rmse_aligned", "se")):
            whole = ate(estimate, path, alignment=alignment)  # type: ignore[arg-type]
            out.add(name, whole.statistics.rmse, "m", "lower")
            out.add(name.replace("rmse", "max"), whole.statistics.maximum, "m", "lower")
    nees = float(e.ravel() @ np.linalg.solve(P, e.ravel()))
    add_nees(out, "nees", nees, e.size)
    chart = np.zeros((len(poses), g.dof, g.dof))  # right tangents along the axes of the map
    R = rotation_matrices(poses)
    chart[:, g.position, g.position] = R
    if g.dim == 3:
        chart[:, :3, :3] = R
    else:
        chart[:, 2, 2] = 1.0
    k = np.arange(len(poses))
    joint = P.reshape(len(k), g.dof, len(k), g.dof)
    turned = np.einsum("kab,kblc,lec->kale", chart, joint, chart, optimize=True).reshape(P.shape)
    add_axis_nees(out, np.einsum("kab,kb->ka", chart, e), turned, AXES[g.dim])
    marginals = joint[k, :, k, :]
    for name, block in blocks.items():
        d = e[:, block]
        each = np.einsum("ki,kij,kj->k", d, np.linalg.inv(marginals[:, block, block]), d)
        out.add(f"anees_{name}_per_dof", float(np.mean(each)) / d.shape[1], "", "one")


AXES = {2: ("x", "y", "heading"), 3: ("roll", "pitch", "heading", "x", "y", "z")}
"""Components of the error of a pose along the axes of the map, by dimension."""


def add_axis_nees(out: Metrics, errors: Array, P: Array, axes: Sequence[str]) -> None:
    """NEES of all nodes per axis: a single axis can be overconfident although the total is not.

    Parameters
    ----------
    errors : (m, d)
        Along the axes of the map.
    P : (m d, m d)
        Joint covariance.
    """
    d = len(axes)
    for a, name in enumerate(axes):
        own = np.ascontiguousarray(P[a::d, a::d])
        add_nees(out, f"nees_{name}", float(errors[:, a] @ np.linalg.solve(own, errors[:, a])), len(errors))


def rms(errors: np.ndarray) -> float:
    """Root mean square of the lengths of errors ``(n, d)``."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def base_metrics(out: Metrics, name: str, T_estimate: Array, T_true: Array, covariance: Array) -> None:
    """Position error of the first base of a session in a common frame, and the NEES of its pose."""
    g = group_of(T_estimate)
    e = g.log(g.between(T_estimate, T_true))
    out.add(f"{name}_base_error", float(np.linalg.norm(e[g.position])), "m", "lower")
    out.add(f"{name}_base_nees", float(e @ np.linalg.solve(covariance, e)))
    out.add(f"{name}_base_nees_dof", g.dof)
