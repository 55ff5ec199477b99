"""Merge runs of dense submaps into one graph: by GPS, by common places, or by both."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from graphslam.app.run.run import Run
from graphslam.app.sessions.dense import session_of
from graphslam.backend.sessions import (
    SESSION,
    ConnectedSession,
    DenseSession,
    add_session,
    connect_by_gps,
    connect_session,
)
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.plan_view import plan_path
from graphslam.core.poses import group_of
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.metrics import Metrics, base_metrics, metric_table, metric_value
from graphslam.evaluate.trajectory_error import ate
from graphslam.graph.factor_graph import FactorGraph
from graphslam.plots.paths import plot_paths
from graphslam.solve.registry import make_solver
from graphslam.solve.solution import Solution

if TYPE_CHECKING:
    import pandas as pd

By = Literal["auto", "places", "gps"]


@dataclass(frozen=True, slots=True)
class PlacedSession:
    """One run inside a merged graph.

    Parameters
    ----------
    session : DenseSession
        Its submaps with the keys and the times of the common graph.
    attached : ConnectedSession or None
        Connection to another session; None for the one whose first base is fixed.
    trajectory : Trajectory
        Its path in the common frame, with its own times and covariances.
    T_world_base, covariance : (7,) or (3,), (d, d)
        Its first base in the common frame; zeros for the fixed one.
    """

    name: str
    run: Run
    session: DenseSession
    first_node: int
    attached: ConnectedSession | None
    trajectory: Trajectory
    T_world_base: Array
    covariance: Array


@dataclass(frozen=True)
class MergedSubmaps:
    """Result of merging runs of dense submaps: everything in the frame of the first run's first base.

    Parameters
    ----------
    solution : Solution
        One least-squares problem over all chains.
    """

    sessions: list[PlacedSession]
    solution: Solution
    graph: FactorGraph
    metric_rows: list[dict[str, Any]]
    report: dict[str, Any] = field(default_factory=dict)

    def metric(self, key: str) -> float:
        """Value of one metric; KeyError if there is none."""
        return metric_value(self.metric_rows, key)

    @property
    def metrics(self) -> pd.DataFrame:
        """The metrics as a table, one row each: ``key``, ``value``, ``unit``, ``direction`` (what is better)."""
        return metric_table(self.metric_rows)

    def plot(self, ax: Any = None) -> Any:
        """The paths of all sessions from above, with their ellipses."""
        paths = {s.name: s.trajectory for s in self.sessions}
        if self.graph.dim == 3:
            paths = {k: plan_path(v) for k, v in paths.items()}
        count = sum(len(s.attached.used) for s in self.sessions if s.attached is not None)
        return plot_paths(ax, paths, title=f"{len(paths)} sessions, {count} loop closures between them")

    def __repr__(self) -> str:
        return f"MergedSubmaps({len(self.sessions)} sessions, {len(self.graph.submaps)} submaps)"


def merge_dense(runs: Sequence[Run], names: Sequence[str], *, by: By = "auto", solver: str = "batch") -> MergedSubmaps:
    """Merge runs of dense submaps into one graph, and solve it as one problem.

    The first base of the first run is fixed. Every other run is attached to one that is already in the graph: by GPS if
    both have fixes in their graphs (in the same frame), by places that look alike, register and agree, or by both.
    Chains, re-entries and loops of every run are those of its own graph. Of a run refined with its scans, the chain
    consists of the refined submaps, and it has no loop closures of its own.

    Parameters
    ----------
    names : sequence of str
        Unique names of the sessions.
    by : {"auto", "places", "gps"}
        ``auto``: GPS if both have it, and then places that are near each other; otherwise places.
    """
    if by not in ("auto", "places", "gps"):
        raise ConfigError(f"by = {by!r}; known for dense submaps: auto, places, gps")
    begin = time.perf_counter()
    sessions: list[DenseSession] = []
    key, clock = 0, -np.inf
    for run, name in zip(runs, names):
        s = session_of(run, name, first_key=key, after=clock)
        sessions.append(s)
        key, clock = key + len(s.submaps), s.submaps[-1].interval[1]
    dims = {s.submaps[0].dim for s in sessions}
    if len(dims) > 1:
        raise DataError("runs in the plane and in space cannot be merged", got=sorted(dims))
    graph = FactorGraph(dims.pop())
    solve = make_solver(solver, graph)
    add_session(graph, replace(sessions[0], fixes=None) if by == "places" else sessions[0])
    solve.solve_to_optimum()
    first: dict[int, int] = {0: 0}
    how: dict[int, ConnectedSession] = {}
    waiting = list(range(1, len(sessions)))
    while waiting:
        errors: dict[int, list[str]] = {}
        for k in list(waiting):
            for at in list(first):
                try:
                    how[k] = _attach(graph, solve, sessions[at], first[at], sessions[k], by)
                except DataError as error:
                    errors.setdefault(k, []).append(error.what)
                    continue
                first[k] = how[k].first_node
                waiting.remove(k)
                break
        if len(errors) and set(waiting) <= set(errors) and len(waiting) == len(errors):
            k = waiting[0]
            raise DataError(f"cannot be merged with the other runs: {'; '.join(errors[k])}", where=names[k])
    solution = solve.solution()
    placed = _placed(runs, sessions, first, how, solution)
    metrics = _metrics(placed, solution)
    report = {
        "format": "graphslam.merge/1",
        "by": by,
        "solver": solver,
        "sessions": [_session_row(s) for s in placed],
        "seconds": time.perf_counter() - begin,
    }
    return MergedSubmaps(placed, solution, graph, metrics, report)


def _attach(
    graph: FactorGraph, solver: Any, known: DenseSession, known_node: int, new: DenseSession, by: By
) -> ConnectedSession:
    both = all(s.fixes is not None and s.T_gps_base is not None for s in (known, new))
    if by == "gps" or (by == "auto" and both):
        return connect_by_gps(graph, solver, known, known_node, new, places=by == "auto")
    if by != "auto":
        new = replace(new, fixes=None)
    return connect_session(graph, solver, known, known_node, new)


def _placed(
    runs: Sequence[Run],
    sessions: list[DenseSession],
    first: dict[int, int],
    how: dict[int, ConnectedSession],
    s: Solution,
) -> list[PlacedSession]:
    P, out = s.node_covariances(), []
    for k, (run, session) in enumerate(zip(runs, sessions)):
        path = s.trajectory(keys={m.key for m in session.submaps})
        own = Trajectory(path.times - session.shift, path.poses, path.covariances)
        node = first[k]
        out.append(PlacedSession(session.name, run, session, node, how.get(k), own, s.poses[node], P[node]))
    return out


def _metrics(placed: Sequence[PlacedSession], solution: Solution) -> list[dict[str, Any]]:
    """Metrics of a merged graph.

    ``path_rmse_aligned`` uses one common alignment of all sessions to one ground truth, if the logs share its world, so
    it includes errors between the sessions. ``<name>_path_rmse_alone`` is that of the single run, aligned separately.
    """
    out = Metrics()
    out.add("sessions", len(placed))
    out.add("submaps", sum(len(s.session.submaps) for s in placed))
    out.add("objective", solution.objective)
    out.add("converged", float(solution.converged), "", "higher")
    if SESSION in solution.score.classes:
        score = solution.score[SESSION]
        out.add("links", score.factors)
        out.add("links_chi2", score.chi2)
        out.add("links_chi2_per_residual", score.chi2 / max(score.rows, 1), "", "one")
    for s in placed[1:]:
        g = group_of(s.T_world_base)
        at, turn = s.covariance[g.position, g.position], s.covariance[g.heading, g.heading]
        out.add(f"{s.name}_base_sigma", float(np.sqrt(np.trace(at))), "m", "lower")
        out.add(f"{s.name}_base_heading_sigma", float(np.rad2deg(np.sqrt(turn))), "deg", "lower")
        if s.attached is not None:
            out.add(f"{s.name}_ties", len(s.attached.used))
            out.add(f"{s.name}_ties_dropped", s.attached.dropped)
    _score(out, placed)
    return out.rows


def _score(out: Metrics, placed: Sequence[PlacedSession]) -> None:
    """Errors against ground truths in a common world."""
    bases = [s.run.report.get("T_world_base") for s in placed]
    shared = all("T_world_frame" in s.run.report.get("source_meta", {}) for s in placed)
    if not shared or any(b is None for b in bases) or any(s.run.truth_path is None for s in placed):
        return
    g = group_of(placed[0].T_world_base)
    times, estimated, true, shift = [], [], [], 0.0
    for s, base in zip(placed, bases):
        T = g.between(np.asarray(bases[0], dtype=np.float64), np.asarray(base, dtype=np.float64))
        truth = s.run.truth_path
        assert truth is not None
        path = s.trajectory
        keep = (path.times >= truth.times[0]) & (path.times <= truth.times[-1])
        times.append(path.times[keep] + shift)
        estimated.append(path.poses[keep])
        true.append(truth.transformed(T).interpolate(path.times[keep]))
        shift = times[-1][-1] + 1.0 - min(path.times[0], 0.0)
        if s.attached is not None:
            base_metrics(out, s.name, s.T_world_base, T, s.covariance)
        if any(r["key"] == "path_rmse_aligned" for r in s.run.metric_rows):
            out.add(f"{s.name}_path_rmse_alone", s.run.metric("path_rmse_aligned"), "m", "lower")
    both = Trajectory(np.concatenate(times), np.concatenate(estimated))
    whole = ate(both, Trajectory(both.times, np.concatenate(true)), alignment="se")
    out.add("path_rmse_aligned", whole.statistics.rmse, "m", "lower")
    out.add("path_max_aligned", whole.statistics.maximum, "m", "lower")


def _session_row(s: PlacedSession) -> dict[str, Any]:
    a = s.attached
    return {
        "name": s.name,
        "source": s.run.name,
        "submaps": len(s.session.submaps),
        "points_not_used": s.run.points_of_survey,
        "refined": s.session.refined,
        "T_world_first_base": s.T_world_base.tolist(),
        "hangs_on": None if a is None else a.known.name,
        "gps": s.session.fixes is not None,
        "links": None if a is None else len(a.used),
        "links_dropped": None if a is None else a.dropped,
        "candidates": [] if a is None or a.candidates is None else a.candidates.rows(),
    }
