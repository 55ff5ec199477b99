"""Join and solve the same submaps with several methods, and compare the results in one table."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np

from graphslam.app.memory import MemoryProbe
from graphslam.core.errors import DataError
from graphslam.core.map_truth import MapTruth
from graphslam.core.poses import group_of
from graphslam.core.progress import Bar
from graphslam.core.tables import data_frame
from graphslam.evaluate.consistency import consistency_index, joint_nees, pose_error
from graphslam.evaluate.map_error import match_ids
from graphslam.join.association import MapAssociationConfig
from graphslam.join.registry import (
    Material,
    association_of,
    compile_method,
    identify_landmarks,
    methods_for,
    prepare_submaps,
)
from graphslam.join.submap_solver import SubmapEstimate

if TYPE_CHECKING:
    import pandas as pd

    from graphslam.join.graph_join import GraphEstimate

logger = logging.getLogger(__name__)

MapEstimate: TypeAlias = Union[SubmapEstimate, "GraphEstimate"]
"""A joined map: of planar landmark submaps, or of any graph."""

DEFAULT_METHODS = ("isam2", "batch", "eif-tree", "eif-sequential", "ekf")
JSON_COLUMNS = (
    *("method", "objective", "objective_polished", "seconds", "peak_mb", "states", "landmarks", "nnz"),
    *("dof", "nees_unpolished", "nees", "nees_plain", "nees_dof", "ci_unpolished", "ci"),
    *("rmse_poses", "rmse_landmarks", "factors"),
)


def default_methods(submaps: Material) -> tuple[str, ...]:
    """All five methods, without the dense EKF if the graph has too many states for it."""
    if isinstance(submaps, Sequence):
        return DEFAULT_METHODS
    from graphslam.join.graph_join import MOST_STATES

    if submaps.states <= MOST_STATES:
        return DEFAULT_METHODS
    logger.warning("no EKF: %d states, a dense filter is limited to %d", submaps.states, MOST_STATES)
    return tuple(m for m in DEFAULT_METHODS if m != "ekf")


def map_nees(
    estimate: MapEstimate, keys: Sequence[int], truth: MapTruth, *, chart: str | None = None
) -> tuple[float, int]:
    """Joint NEES of all poses and landmarks with ground truth, gauge "first base fixed", and its dimension (eq. 18).

    Computed in the parametrisation of the map, or in another one (:mod:`graphslam.core.charts`).

    Parameters
    ----------
    keys : (m,)
        Keys of the joined submaps.
    truth : MapTruth
        In the frame of the first base.
    chart : "cartesian" or "group", optional
    """
    error, known = _errors(estimate, keys, truth, chart)
    if len(known) == 0:
        raise DataError("no pose and no landmark has ground truth", got=len(truth.keys), wanted="common keys or ids")
    if estimate.information is not None and len(known) == estimate.states:
        return joint_nees(error[np.argsort(known)], information=estimate.information), len(known)
    return joint_nees(error, covariance=estimate.covariance_block(known)), len(known)


def _errors(
    estimate: MapEstimate, keys: Sequence[int], truth: MapTruth, chart: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all scalars with ground truth, and their indices in the state vector."""
    g = group_of(estimate.poses)
    if truth.exit_poses.shape[1] != g.size:
        raise DataError("ground truth has another dimension", got=truth.exit_poses.shape, wanted=f"(m, {g.size})")
    i, j = match_ids(np.asarray(keys), truth.keys)
    a, b = match_ids(estimate.landmark_ids, truth.landmark_ids)
    if not isinstance(estimate, SubmapEstimate):  # right tangents of the end poses, then positions
        layout, rows = estimate.problem.graph.flat().layout, estimate.exits[i]
        exits = pose_error(estimate.poses[rows], truth.exit_poses[j])
        marks = truth.landmarks[b] - estimate.landmarks[a]
        if chart != "cartesian" and len(a):
            known = dict(zip(rows.tolist(), truth.exit_poses[j]))
            marks = estimate.anchored_errors(a, truth.landmarks[b], known)
        columns = layout.pose_columns(rows).ravel(), layout.at("l", a).ravel()
        return np.concatenate([exits.ravel(), marks.ravel()]), np.concatenate(columns)
    m = len(estimate.poses) - 1
    poses, landmarks = estimate.poses[1:].copy(), estimate.landmarks.copy()  # without ground truth the error is zero
    poses[i] = truth.exit_poses[j]
    landmarks[a] = truth.landmarks[b]
    d, n = g.dof, g.dim
    at = np.concatenate([(d * i[:, None] + np.arange(d)).ravel(), (d * m + n * a[:, None] + np.arange(n)).ravel()])
    return estimate.difference(poses, landmarks, chart=chart)[at], at


def _judge(estimate: MapEstimate, keys: Sequence[int], truth: MapTruth | None) -> dict[str, Any]:
    if truth is None:
        unknown = ("nees", "nees_plain", "nees_dof", "ci", "rmse_poses", "rmse_landmarks")
        return dict.fromkeys(unknown)
    d2, dof = map_nees(estimate, keys, truth)
    rows = np.arange(1, len(estimate.poses)) if isinstance(estimate, SubmapEstimate) else estimate.exits
    i, j = match_ids(np.asarray(keys), truth.keys)
    a, b = match_ids(estimate.landmark_ids, truth.landmark_ids)
    dim = group_of(estimate.poses).dim
    return {
        "nees": d2,
        "nees_plain": map_nees(estimate, keys, truth, chart="cartesian")[0],
        "nees_dof": dof,
        "ci": float(consistency_index(d2, dof)),
        "rmse_poses": _rmse(estimate.poses[rows[i], :dim] - truth.exit_poses[j, :dim]),
        "rmse_landmarks": _rmse(estimate.landmarks[a] - truth.landmarks[b]),
    }


def _rmse(error: np.ndarray) -> float | None:
    """Root mean square of distances ``(n, dim)`` [m]."""
    return math.sqrt(float(np.mean(np.sum(error**2, axis=1)))) if len(error) else None


def compare_methods(
    submaps: Material,
    methods: Sequence[str] = DEFAULT_METHODS,
    *,
    truth: MapTruth | None = None,
    polish: bool = True,
    associate: str | MapAssociationConfig = "given",
    covariance_scale: float = 1.0,
    memory: bool = True,
    progress: bool = False,
) -> pd.DataFrame:
    """Apply every method to the same submaps with the same landmark ids; one row per method.

    Parameters
    ----------
    submaps : sequence of Submap, or JoinProblem
        See :func:`join`.
    methods : sequence of str
        See :func:`join`.
    truth : MapTruth, optional
        Gives NEES, its dimension, CI (eq. 20) and RMS errors, all in the gauge "first base fixed". For dense submaps
        only the end poses are compared, with errors in right tangents.
    polish : bool
        Refine the result of every method to the least-squares optimum.
    associate, covariance_scale
        See :func:`join`; landmarks are associated once, for all methods.
    memory : bool
        Measure ``peak_mb``: each method runs once more in its own process, which measures the growth of its resident
        memory, native allocations included. Takes about one second per method.
    progress : bool
        Show a progress bar.

    Returns
    -------
    pandas.DataFrame
        ``objective`` is that of the method, ``objective_polished`` that after the refinement. ``nees`` and ``ci`` are
        in the parametrisation of the map, ``nees_plain`` is that of the plain vector. They and the errors are of the
        final map, refined with ``polish``; ``nees_unpolished`` and ``ci_unpolished`` are of the method alone. ``dof``
        is the number of measured scalars minus the number of states. ``seconds`` is wall time with refinement, without
        compilation; ``nnz`` the number of stored entries of the information matrix (of the dense covariance for an
        EKF without refinement).
    """
    submaps = prepare_submaps(submaps, associate=associate, covariance_scale=covariance_scale)
    available = methods_for(submaps)
    for m in methods:
        available.check(m)
    association = association_of(associate)
    if association is not None and isinstance(submaps, Sequence):
        submaps = identify_landmarks(submaps, association, progress=progress)
        # Associated landmarks have new ids, so only the poses can be compared with ground truth.
        truth = None if truth is None else _poses_only(truth)
    keys = submap_keys(submaps)
    rows = []
    for method in Bar(methods, name="compare", unit="method", shown=progress):
        own: dict[str, Any] = {}
        compile_method(submaps, method, polish=polish)
        if method in available.joiners:
            joined = available.joiners[method](submaps)
            if polish:
                own = _judge(joined, keys, truth)
            estimate: MapEstimate = available.polish(submaps, joined) if polish else joined
        else:
            estimate = available.solvers[method](submaps, polish=polish, progress=False)
            if polish and truth is not None:
                own = _judge(available.solvers[method](submaps, polish=False, progress=False), keys, truth)
        rows.append(
            {
                **_describe(method, submaps, estimate),
                **_judge(estimate, keys, truth),
                "nees_unpolished": own.get("nees"),
                "ci_unpolished": own.get("ci"),
                "iterations": estimate.iterations,
                "converged": estimate.converged,
            }
        )
    with MemoryProbe(submaps if memory else None) as probe:
        for row, megabytes in zip(rows, probe.measure(methods, polish=polish)):
            row["peak_mb"] = megabytes
    return data_frame(rows)


def submap_keys(submaps: Material) -> list[int]:
    """Keys of the submaps."""
    return [s.key for s in submaps] if isinstance(submaps, Sequence) else submaps.keys.tolist()


def degrees_of_freedom(submaps: Material, estimate: MapEstimate) -> int:
    """Number of scalars measured by submaps and constraints, minus the number of states."""
    if not isinstance(submaps, Sequence):
        return submaps.dof
    g = group_of(estimate.poses)
    return sum(g.dof + g.dim * (0 if s.landmarks is None else len(s.landmarks)) for s in submaps) - estimate.states


def _describe(method: str, submaps: Material, estimate: MapEstimate) -> dict[str, Any]:
    return {
        "method": method,
        "objective": estimate.objective,
        "objective_polished": estimate.objective_polished,
        "seconds": estimate.seconds,
        "peak_mb": None,
        "states": estimate.states,
        "landmarks": len(estimate.landmark_ids),
        "nnz": estimate.nnz,
        "dof": degrees_of_freedom(submaps, estimate),
        "factors": factor_text(submaps),
    }


def factor_text(submaps: Material) -> str:
    """Number of factors of each class in every solution, such as ``"gps 36, imu 12, submap 8"``."""
    counts = {"submap": len(submaps)} if isinstance(submaps, Sequence) else submaps.factor_counts()
    return ", ".join(f"{name} {n}" for name, n in counts.items())


def _poses_only(truth: MapTruth) -> MapTruth:
    none = np.zeros(0, dtype=np.int64)
    return MapTruth(keys=truth.keys, exit_poses=truth.exit_poses, landmark_ids=none, landmarks=np.zeros((0, 2)))


def methods_json(table: pd.DataFrame) -> dict[str, list[dict[str, Any]]]:
    """The table as ``{"methods": [{"method", "objective", …}]}``; unknown values are null."""
    return {"methods": [_json_row(r) for r in table.to_dict("records")]}


def _json_row(row: Mapping[Any, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name in JSON_COLUMNS:
        value = row.get(name)
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            values[name] = None
        elif name in ("method", "factors"):
            values[name] = str(value)
        elif name in ("states", "landmarks", "nnz", "dof", "nees_dof"):
            values[name] = int(value)
        else:
            values[name] = float(value)
    return values | before_and_after(values)


def before_and_after(row: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Objective, NEES and CI of a method's own map, and after the refinement.

    Parameters
    ----------
    row : mapping
        Of a method (:data:`JSON_COLUMNS`). Without a refinement the values are in ``before`` and those in ``after`` are
        None.

    Returns
    -------
    dict
        ``before`` and ``after``, each with ``objective``, ``nees`` and ``ci``.
    """
    refined = row["objective_polished"] is not None and not (row["nees"] is not None and row["nees_unpolished"] is None)
    before = {"objective": row["objective"], "nees": row["nees_unpolished"], "ci": row["ci_unpolished"]}
    if not refined:
        before = {"objective": row["objective"], "nees": row["nees"], "ci": row["ci"]}
        return {"before": before, "after": dict.fromkeys(before)}
    return {"before": before, "after": {"objective": row["objective_polished"], "nees": row["nees"], "ci": row["ci"]}}


def comparison_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of :func:`methods_json` as a readable table: values before and after the refinement side by side."""
    out = []
    for r in rows:
        n = r["nees_dof"]
        line: dict[str, Any] = {"method": r["method"]}
        for key, name in (("objective", "objective"), ("nees", "NEES/n"), ("ci", "CI")):
            for when in ("before", "after"):
                value = r[when][key]
                line[f"{name} {when}"] = value / n if key == "nees" and value is not None and n else value
        shown = ("rmse_poses", "rmse_landmarks", "seconds", "peak_mb", "states", "landmarks", "nnz", "dof", "factors")
        out.append(line | {k: r[k] for k in shown})
    known = any(r["nees_dof"] for r in rows)
    unknown = ("NEES", "CI", "rmse")
    return out if known else [{k: v for k, v in x.items() if not k.startswith(unknown)} for x in out]


def join_json(
    submaps: Material,
    method: str,
    estimate: MapEstimate,
    *,
    truth: MapTruth | None = None,
    own: MapEstimate | None = None,
) -> dict[str, list[dict[str, Any]]]:
    """One joined map in the same form as :func:`methods_json`; memory is not measured.

    Parameters
    ----------
    own : MapEstimate, optional
        The map before its refinement.
    """
    before = {} if own is None else _judge(own, submap_keys(submaps), truth)
    row = {
        **_describe(method, submaps, estimate),
        **_judge(estimate, submap_keys(submaps), truth),
        "nees_unpolished": before.get("nees"),
        "ci_unpolished": before.get("ci"),
    }
    return {"methods": [_json_row(row)]}
