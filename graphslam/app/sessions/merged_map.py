"""Result of a merge of several runs by common landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.app.run.run import Run
from graphslam.core.geometry import Array
from graphslam.core.markup import html_element, html_table, join_parts
from graphslam.evaluate.gauge import gauge_directions, inner_covariance
from graphslam.evaluate.metrics import metric_table, metric_value
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.places import Ints
from graphslam.loops.sessions import Alignment
from graphslam.maps.global_map import GlobalMap
from graphslam.solve.solution import Solution

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True)
class Session:
    """One run inside a merged map.

    Parameters
    ----------
    name : str
        Unique among the sessions.
    keys : tuple of int
        Keys of its submaps in the common graph.
    first_node : int
        Node of its first base.
    alignment : Alignment or None
        Initial alignment by landmarks; None for the session whose first base is fixed.
    map : GlobalMap
        Its path in the common frame, with all landmarks of the merged map.
    """

    name: str
    run: Run
    keys: tuple[int, ...]
    first_node: int
    alignment: Alignment | None
    map: GlobalMap


@dataclass(frozen=True)
class MergedMap:
    """Result of :func:`graphslam.merge`: everything in the frame of the first run's first base.

    Parameters
    ----------
    landmark_ids, landmarks, landmark_covariances : (n,), (n, 2), (n, 2, 2)
    landmark_sessions : (n,) int64
        Number of sessions that observed it.
    solution : Solution
        One least-squares problem over all chains.
    """

    sessions: list[Session]
    landmark_ids: Ints
    landmarks: Array
    landmark_covariances: Array
    landmark_sessions: Ints
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
        """Landmarks and the path of every session; the ellipses show the uncertainty of the *shape* of the map."""
        from graphslam.plots.merged import plot_merged

        centred = self.landmarks - self.landmarks.mean(axis=0)
        joint = self.solution.joint_marginal(f"l{i}" for i in self.landmark_ids.tolist())
        P = inner_covariance(joint, gauge_directions(np.zeros((0, 3)), centred))
        k = 2 * np.arange(len(centred))[:, None] + np.arange(2)
        blocks = P[k[:, :, None], k[:, None, :]] + 1e-12 * np.eye(2)
        paths = {s.name: s.map.trajectory for s in self.sessions}
        return plot_merged(ax, paths, self.landmarks, blocks, self.landmark_sessions)

    def __repr__(self) -> str:
        shared = int(np.sum(self.landmark_sessions > 1))
        return f"MergedMap({len(self.sessions)} sessions, {len(self.landmarks)} landmarks, {shared} of them shared)"

    def _repr_html_(self) -> str:
        return join_parts([html_element("b", repr(self)), html_table(self.metric_rows, ["key", "value", "unit"])])
