"""Result of a run: submaps, map, metrics, events and verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.core.findings import Finding, Findings, findings_of_json, headline_of_json
from graphslam.core.geometry import se2_transform
from graphslam.core.log import SensorLog, Truth
from graphslam.core.map_truth import MapTruth
from graphslam.core.markup import Markup, html_element, html_table, inline_picture, join_parts
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.tables import data_frame
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import GpsResiduals
from graphslam.evaluate.metrics import metric_table, metric_value
from graphslam.graph.ledger import COLUMNS
from graphslam.maps.global_map import GlobalMap

if TYPE_CHECKING:
    import pandas as pd

    from graphslam.app.run.residual_consistency import ResidualConsistency
    from graphslam.app.run.run_inputs import RunInputs
    from graphslam.backend.refining import RefinedRun
    from graphslam.graph.factor_graph import FactorGraph
    from graphslam.maps.run_map import RunMap
    from graphslam.solve.solution import Solution

_MAX_STRETCH = 2.5
"""Dead reckoning is not plotted if its extent is larger than this multiple of the map's extent."""


class DeferredPart:
    """A part of a run that is computed at its first use.

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
        With the landmark identities assigned by the back end.
    map : GlobalMap
    metric_rows : list of dict
        ``key, value, unit, direction``; :attr:`metrics` is the table.
    report : dict
        ``run.json``: versions, seed, counts of records read, used and dropped; and the seconds of ``timings.json``.
    events : list of dict
    ledger_rows : list of dict or None
        Which factor used which stream in which time interval; :attr:`ledger` is the table.
    gps : mapping of str to GpsResiduals
        ``all`` and, if GPS is in the graph, ``withheld``.
    fixes : Gps or None
        GPS fixes that became factors.
    folder : Path or None
    log : SensorLog or None
    inputs : RunInputs or None
        Subset of the log used for the graph and the metrics; None for a run read back from disk.
    truth : MapTruth or None
        Ends of the submaps and landmarks.
    truth_path, dead_reckoning : Trajectory or None
        In the frame of the first base.
    solution, graph : Solution, FactorGraph or None
        State of the solver. After :func:`graphslam.open_run` they are solved again, once, at their first use; None if
        the inputs are not in the folder.
    checks : ResidualConsistency or None
        Consistency checks without ground truth; None for a run read from disk, whose metrics have their values.
    fused : RunMap or None
        Fused evidence grid of submaps that have grids. After :func:`graphslam.open_run` it is computed again, once, at
        its first use.
    graph_path : Trajectory or None
        For a refined run the path of the graph, its initial guess; from disk without covariances.
    refined : RefinedRun or None
        The path refined with its scans; None for a run read from disk, whose ``map`` has the refined path.
    two_maps : tuple of two Trajectory, or None
        If two groups of loops contradict each other and it is undecided which is right: the path of the graph with each
        of them. ``map`` uses neither; from disk without covariances. ``report["two_maps"]`` lists the loops.

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
    metric_rows: list[dict[str, Any]]
    report: dict[str, Any]
    events: list[dict[str, Any]] = field(default_factory=list)
    ledger_rows: list[dict[str, Any]] | None = None
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
        """Is ``solution``, ``graph`` or ``fused`` available without computing it?"""
        return self.__dict__[part] is not None and not isinstance(self.__dict__[part], DeferredPart)

    def metric(self, key: str) -> float:
        """Value of one metric.

        Raises
        ------
        KeyError
        """
        return metric_value(self.metric_rows, key)

    @property
    def metrics(self) -> pd.DataFrame:
        """The metrics as a table, one row each: ``key``, ``value``, ``unit``, ``direction`` (what is better)."""
        return metric_table(self.metric_rows)

    @property
    def ledger(self) -> pd.DataFrame | None:
        """Which factor used which stream in which time interval, as a table; None in runs of older versions."""
        return None if self.ledger_rows is None else data_frame(self.ledger_rows, COLUMNS)

    @property
    def verdict(self) -> Findings:
        """Findings on the run: solved, consistent, complete, all requested data used. ``print(run.verdict)``."""
        return findings_of_json(self.report.get("verdict"))

    @property
    def headline(self) -> Finding:
        """First line of the verdict: overall result, main values, next step."""
        return headline_of_json(self.report.get("verdict")) or Finding("", "headline", "No verdict.")

    @property
    def trajectory(self) -> Trajectory:
        """The path at full rate with covariances, in the frame of the first base."""
        return self.map.trajectory

    @property
    def points_of_survey(self) -> int:
        """Control rows and check rows that were used."""
        return int(self.report.get("control_points", {}).get("used", 0)) + len(self._check_rows)

    @property
    def _check_rows(self) -> list[dict[str, Any]]:
        return list(self.report.get("check_points", {}).get("rows", []))

    @property
    def check_points(self) -> pd.DataFrame:
        """Check points, one per row: ``line``, ``name``, ``place``, ``frame``, ``error`` [m] and its predicted
        ``sigma`` [m], ``nis``, ``dof``; empty if the run had no check rows. Their joint test is in
        ``report["check_points"]``."""
        columns = ["line", "name", "place", "frame", "error", "sigma", "nis", "dof"]
        return data_frame(self._check_rows, columns)

    def to_pandas(self) -> pd.DataFrame:
        """:attr:`trajectory` as a table, one row per pose (:meth:`Trajectory.to_pandas`)."""
        return self.trajectory.to_pandas()

    def plot(self, ax: Any = None, *, plane: str = "xy") -> Any:
        """Map with path, landmarks and 95 % ellipses, GPS fixes and ground truth.

        In the GPS frame (east, north) if GPS residuals exist, otherwise in the frame of the first base. Of a 3-D map
        only the path is drawn, in ``plane``, ``"xy"`` or ``"xz"``.
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
        """Path of a 3-D map with its ellipses, ground truth and dead reckoning."""
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
        """Dead reckoning; None if it is missing or much larger than the map."""
        if self.dead_reckoning is None:
            return None
        own = np.ptp(self.dead_reckoning.positions, axis=0).max()
        beside = np.ptp(self.map.trajectory.positions, axis=0).max()
        return self.dead_reckoning if own <= _MAX_STRETCH * max(beside, 1.0) else None

    def __repr__(self) -> str:
        return f"Run({self.name!r}: {len(self.submaps)} submaps, {len(self.map.landmarks)} landmarks)"

    def _repr_html_(self) -> str:
        where = f" in {self.folder.name}" if self.folder else ""
        summary = f"{where}: {len(self.submaps)} submaps, {len(self.map.landmarks)} landmarks"
        weighty = Findings(f for f in self.verdict if f.level in ("look", "bad"))
        figures = html_table(self.metric_rows, ["key", "value", "unit"])
        return join_parts(
            [
                html_element("p", html_element("b", self.headline.text)),
                html_element("p", html_element("b", f"Run of {self.name}"), summary),
                weighty._repr_html_(),
                self._picture(),
                html_element("details", html_element("summary", f"{len(self.metric_rows)} figures"), figures),
            ]
        )

    def _picture(self) -> Markup | None:
        """The map as a small picture; None without a path."""
        from graphslam.plots.save import figure_png

        if len(self.map.trajectory) < 2:
            return None
        return inline_picture(figure_png(self.plot()), f"Map of {self.name}")
