"""A finished run as a value: what a notebook holds in its hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from graphslam.core.findings import Finding, Findings, findings_of_json, headline_of_json
from graphslam.core.geometry import se2_transform
from graphslam.core.log import SensorLog, Truth
from graphslam.core.map_truth import MapTruth
from graphslam.core.markup import Markup, html_element, html_frame, inline_picture, join_parts
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import GpsResiduals
from graphslam.maps.global_map import GlobalMap

if TYPE_CHECKING:
    from graphslam.app.run.residual_consistency import ResidualConsistency
    from graphslam.app.run.run_inputs import RunInputs
    from graphslam.backend.refining import RefinedRun
    from graphslam.graph.factor_graph import FactorGraph
    from graphslam.maps.run_map import RunMap
    from graphslam.solve.solution import Solution

_MAX_STRETCH = 2.5
"""A dead-reckoned path this many times larger than the map is not drawn: the map would be a dot."""


class DeferredPart:
    """A part of a run that is made when it is first asked for.

    Parameters
    ----------
    make : callable
        Without arguments.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make


class _Part:
    """A field of a run that may be a :class:`DeferredPart`; None by default."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Any, owner: type) -> Any:
        if run is None:
            return None  # the default of the field
        part = run.__dict__[self.name]
        if isinstance(part, DeferredPart):
            part = run.__dict__[self.name] = part.make()
        return part

    def __set__(self, run: Any, value: Any) -> None:
        run.__dict__[self.name] = value


@dataclass(frozen=True)
class Run:
    """Result of :func:`graphslam.run` or :func:`graphslam.open_run`.

    Parameters
    ----------
    name : str
    submaps : list of Submap
        With the landmark identities that the back end gave them.
    map : GlobalMap
    metrics : DataFrame
        ``key, value, unit, direction``.
    report : dict
        ``run.json``: versions, seed, counts of records read, used and dropped; and the seconds of ``timings.json``.
    events : list of dict
    ledger : DataFrame or None
        Which factor used which stream when.
    gps : mapping of str to GpsResiduals
        ``all`` and, where GPS was in the graph, ``withheld``; empty for a run read back from disk.
    fixes : Gps or None
        What of GPS became factors.
    folder : Path or None
    log : SensorLog or None
    inputs : RunInputs or None
        Subset of the log used for the graph and the metrics; None for a run read back from disk.
    truth : MapTruth or None
        Ends of the submaps and landmarks.
    truth_path, dead_reckoning : Trajectory or None
        In the frame of the first base.
    solution, graph : Solution, FactorGraph or None
        The solver's own view. Of a run that :func:`graphslam.open_run` read they are solved again, once, when they are
        first asked for; None where its folder does not hold what that needs.
    checks : ResidualConsistency or None
        Consistency checks without ground truth; None for a run read back from disk, whose metrics hold the figures.
    fused : RunMap or None
        Fused evidence grid of submaps that have grids. Of a run that :func:`graphslam.open_run` read it is made again,
        once, when it is first asked for.
    graph_path : Trajectory or None
        Of a refined run the path of the graph, where the refinement began; from disk without covariances.
    refined : RefinedRun or None
        The path refined by its scans; None for a run read back from disk, whose ``map`` has the refined path.
    two_maps : tuple of two Trajectory, or None
        Where two groups of loops cannot both be right and nothing told which is: the path of the graph with either,
        of which ``map`` has neither; from disk without covariances. What is in dispute is in ``report["two_maps"]``.

    Examples
    --------
    >>> opened = gs.open_run("runs/field")
    >>> opened
    Run('landmark-field': 7 submaps, 40 landmarks)
    >>> opened.verdict[0].level, opened.map.landmarks.shape
    ('', (40, 2))
    """

    name: str
    submaps: Sequence[Submap]
    map: GlobalMap
    metrics: pd.DataFrame
    report: dict[str, Any]
    events: list[dict[str, Any]] = field(default_factory=list)
    ledger: pd.DataFrame | None = None
    gps: dict[str, GpsResiduals] = field(default_factory=dict)
    fixes: Gps | None = None
    folder: Path | None = None
    log: SensorLog | None = None
    inputs: RunInputs | None = None
    truth: MapTruth | None = None
    truth_path: Trajectory | None = None
    dead_reckoning: Trajectory | None = None
    solution: Solution | None = _Part()  # type: ignore[assignment]
    graph: FactorGraph | None = _Part()  # type: ignore[assignment]
    checks: ResidualConsistency | None = None
    fused: RunMap | None = _Part()  # type: ignore[assignment]
    graph_path: Trajectory | None = None
    refined: RefinedRun | None = None
    two_maps: tuple[Trajectory, Trajectory] | None = None

    def holds(self, part: str) -> bool:
        """Is ``solution``, ``graph`` or ``fused`` there, made already?"""
        return self.__dict__[part] is not None and not isinstance(self.__dict__[part], DeferredPart)

    def metric(self, key: str) -> float:
        """Value of one metric.

        Raises
        ------
        KeyError
        """
        return metric_value(self.metrics, key)

    @property
    def verdict(self) -> Findings:
        """Findings on the run: solved, consistent, complete, all requested data used. ``print(run.verdict)``."""
        return findings_of_json(self.report.get("verdict"))

    @property
    def headline(self) -> Finding:
        """First line of the verdict: overall result, main values, next step."""
        return headline_of_json(self.report.get("verdict")) or Finding("", "headline", "No verdict.")

    @property
    def points_of_survey(self) -> int:
        """Control rows and check rows that were used."""
        return int(self.report.get("control_points", {}).get("used", 0)) + len(self.check_points)

    @property
    def check_points(self) -> pd.DataFrame:
        """Check points, a row each: ``line``, ``name``, ``place``, ``frame``, ``error`` [m] and its predicted
        ``sigma`` [m], ``nis``, ``dof``; none where the run had no check rows. The test of all of them together is in
        ``report["check_points"]``."""
        columns = ["line", "name", "place", "frame", "error", "sigma", "nis", "dof"]
        return pd.DataFrame(self.report.get("check_points", {}).get("rows", []), columns=columns)

    def to_pandas(self) -> pd.DataFrame:
        """The path at full rate, a row an instant, in the frame of the first base: :meth:`Trajectory.to_pandas`."""
        return self.map.trajectory.to_pandas()

    def plot(self, ax: Any = None, *, plane: str = "xy") -> Any:
        """Map with path, landmarks and 95 % ellipses, GPS fixes and ground truth.

        In the GPS frame (east, north) where fixes were scored, else in the frame of the first base. A map in space is
        drawn by its path in ``plane``, ``"xy"`` or ``"xz"``.
        """
        if self.map.dim == 3:
            return self._plot_paths(ax, plane)
        from graphslam.plots.map import plot_map

        m = self.map
        fixes, T = None, np.zeros(3)
        scored = self.gps.get("all")
        if scored is not None:
            fixes, T = scored.points + scored.residuals, scored.T_gps_map
        landmarks, covariances = m.landmarks_in(T)
        truth = None
        if self.truth is not None:
            path = self.truth_path
            if path is None:
                path = Trajectory(m.base_times, np.vstack([np.zeros((1, 3)), self.truth.exit_poses]))
            truth = Truth(path.transformed(T), self.truth.landmark_ids, se2_transform(T, self.truth.landmarks))
        title = f"{self.name}: {len(self.submaps)} submaps, {len(m.landmarks)} landmarks"
        if scored is not None:
            title += f", GPS RMSE {scored.statistics.rmse:.2f} m"
        reckoned = self._fitting_dead_reckoning()
        axes = plot_map(
            ax,
            trajectory=m.trajectory.transformed(T),
            landmarks=landmarks,
            covariances=covariances,
            gps=fixes,
            truth=truth,
            dead_reckoning=None if reckoned is None else reckoned.transformed(T),
            before=None if self.graph_path is None else self.graph_path.transformed(T),
        )
        axes.set_title(title)
        if scored is not None:
            axes.set_xlabel("east [m]")
            axes.set_ylabel("north [m]")
        return axes

    def _plot_paths(self, ax: Any, plane: str) -> Any:
        """Path of a map in space with its ellipses, ground truth and dead reckoning."""
        from graphslam.plots.paths import GRAPH, plot_paths

        paths = {"path": self.map.trajectory}
        if self.graph_path is not None:
            paths[GRAPH] = Trajectory(self.graph_path.times, self.graph_path.poses)  # its ellipses would hide the map's
        reckoned = self._fitting_dead_reckoning()
        if reckoned is not None and reckoned.dim == 3:
            paths["dead reckoning"] = reckoned
        title = f"{self.name}: {len(self.submaps)} submaps, {len(self.map.node_poses)} nodes"
        return plot_paths(ax, paths, truth=self.truth_path, ellipses=12, plane=plane, title=title)

    def _fitting_dead_reckoning(self) -> Trajectory | None:
        """Dead reckoning, if it does not make the map a dot in the figure."""
        if self.dead_reckoning is None:
            return None
        own = np.ptp(self.dead_reckoning.positions, axis=0).max()
        beside = np.ptp(self.map.trajectory.positions, axis=0).max()
        return self.dead_reckoning if own <= _MAX_STRETCH * max(beside, 1.0) else None

    def __repr__(self) -> str:
        return f"Run({self.name!r}: {len(self.submaps)} submaps, {len(self.map.landmarks)} landmarks)"

    def _repr_html_(self) -> str:
        where = f" in {self.folder.name}" if self.folder else ""
        said = f"{where}: {len(self.submaps)} submaps, {len(self.map.landmarks)} landmarks"
        weighty = Findings(f for f in self.verdict if f.level in ("look", "bad"))
        figures = html_frame(self.metrics[["key", "value", "unit"]])
        return join_parts(
            [
                html_element("p", html_element("b", self.headline.text)),
                html_element("p", html_element("b", f"Run of {self.name}"), said),
                weighty._repr_html_(),
                self._picture(),
                html_element("details", html_element("summary", f"{len(self.metrics)} figures"), figures),
            ]
        )

    def _picture(self) -> Markup | None:
        """The map as a small picture; None without a path."""
        from graphslam.plots.save import figure_png

        if len(self.map.trajectory) < 2:
            return None
        return inline_picture(figure_png(self.plot()), f"Map of {self.name}")


def metric_value(metrics: pd.DataFrame, key: str) -> float:
    """Value of one row of a table of metrics (``key, value, …``)."""
    row = metrics[metrics["key"] == key]
    if row.empty:
        raise KeyError(key)
    return float(row["value"].iloc[0])
