"""Checks without ground truth: χ² per class, prediction of withheld GPS, loop closures against each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.app.run.config import RunConfig
from graphslam.backend.streams import split_fixes
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.markup import html_table
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.tables import data_frame
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.bias_test import sum_bias_windows
from graphslam.evaluate.covariance_assessment import (
    ConsistencyTest,
    Of,
    chi_square_ratio_test,
    largest_score_test,
    short_window_tests,
)
from graphslam.evaluate.gps import FixDistances, fix_distances
from graphslam.evaluate.gps_innovation import GpsInnovations, gps_innovations
from graphslam.evaluate.intervals import two_sided_width
from graphslam.evaluate.loop_consistency import LoopConsistency, find_landmark_loops, loop_consistency
from graphslam.evaluate.metrics import Metrics
from graphslam.evaluate.residual_consistency import NOT_TESTED, ClassConsistency, class_consistency
from graphslam.graph.factor_graph import FactorGraph

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("test", "value", "low", "high", "verdict", "dof")
"""Columns of the checks as a table."""
OF_THE_MAP = ("submap", "biases", "dense-submap", "match", "loop")
"""Factor classes whose χ² covers motion and observations."""
MOST_PREDICTED = {2: 1000, 3: 300}
"""Largest number of withheld fixes that are predicted, spread evenly over the run, by dimension of the graph."""


@dataclass(frozen=True)
class ResidualConsistency:
    """Consistency checks of a run without ground truth.

    Parameters
    ----------
    classes : dict of str to ClassConsistency
        χ² and effective dof of every class of factors.
    gps : GpsInnovations or None
        Withheld fixes; None if none were withheld or the graph has no GPS.
    loops : LoopConsistency or None
        None if no two submaps share two landmarks.
    fixes : FixDistances or None
        If the fixes are not in the graph.
    """

    classes: dict[str, ClassConsistency]
    gps: GpsInnovations | None
    loops: LoopConsistency | None
    fixes: FixDistances | None = None

    def rows(self) -> list[dict[str, Any]]:
        """One row per test: value (consistent: 1), two-sided bounds, verdict, and the dof behind the bounds."""
        rows = []
        for c in self.classes.values():
            r = c.as_row()
            rows.append((f"chi2 of {c.name}", r["chi2_per_dof"], r["low"], r["high"], r["verdict"], r["dof"]))
        if self.gps is not None:
            for r in self.gps.tests():
                rows.append((f"withheld GPS, {r['test']}", r["value"], r["low"], r["high"], r["verdict"], r["dof"]))
        if self.loops is not None:
            r = self.loops.test()
            rows.append(("loops", r["value"], r["low"], r["high"], r["verdict"], r["dof"]))
        return [dict(zip(COLUMNS, row)) for row in rows]

    def table(self) -> pd.DataFrame:
        """:meth:`rows` as a pandas table."""
        return data_frame(self.rows(), COLUMNS)

    def evidence(self, submaps: Sequence[Submap], *, refined: bool = False) -> list[ConsistencyTest]:
        """All tests of the covariances (:mod:`graphslam.evaluate.covariance_assessment`).

        Parameters
        ----------
        refined : bool
            The result is a path refined by its scans. The graph was only its initial guess, and its noise was estimated
            from its own residuals, so only tests with GPS fixes are valid for it.
        """
        rows = self._evidence(submaps)
        return [r for r in rows if r.of == "fixes"] if refined else rows

    def _evidence(self, submaps: Sequence[Submap]) -> list[ConsistencyTest]:
        out = short_window_tests(sum_bias_windows([s.report for s in submaps]))
        for name, c in ((n, c) for n, c in self.classes.items() if n not in NOT_TESTED):
            of: Of = "map" if name in OF_THE_MAP else "fixes" if name == "gps" else "other"
            chi2, dof = c.chi2, c.dof
            if name == "gps" and "gps-bias" in self.classes:  # a bias per fix absorbs part of its residual
                b = self.classes["gps-bias"]
                chi2, dof = chi2 + b.chi2, dof + b.dof
            if name != "gps-bias" and dof > 0:
                out += chi_square_ratio_test(f"χ² of {name}", of, chi2 / dof, dof * c.independent / max(c.dof, 1e-9))
            if c.whiteness is not None and np.isfinite(c.ratio):
                score = c.whiteness.score if c.whiteness.correlated() else min(c.whiteness.score, 0.0)
                out.append(largest_score_test(f"autocorrelation of {name} residuals", of, score))
        if self.gps is not None:
            for r in self.gps.tests():
                out += chi_square_ratio_test(f"withheld GPS, {r['test']}", "fixes", r["value"], r["dof"])
                if r["test"] == "joint" and np.isfinite(r["autocorrelation"]):
                    score = two_sided_width(0.95) * r["autocorrelation"] / r["white"]
                    out.append(largest_score_test("autocorrelation of withheld GPS errors", "fixes", score))
        if self.fixes is not None and self.fixes.ratio > 1.0:  # one-sided: small distances are no evidence
            f = self.fixes
            out.append(ConsistencyTest("squared distances from GPS fixes", "fixes", f.ratio, 1.0, f.chance, 1.0))
        if self.loops is not None:
            r = self.loops.test()
            out += chi_square_ratio_test("loop closures against each other", "map", r["value"], r["dof"])
        return out

    def _repr_html_(self) -> str:
        return html_table(self.rows(), COLUMNS)


def check_residual_consistency(
    out: Metrics,
    graph: FactorGraph,
    submaps: Sequence[Submap],
    path: Trajectory,
    poses: Array,
    gps: Gps | None,
    settings: RunConfig,
) -> ResidualConsistency:
    """Run the checks and add their values to the metrics.

    Parameters
    ----------
    graph : FactorGraph
        At its optimum.
    submaps : sequence of Submap
        Identified.
    path : Trajectory
        The result.
    poses : (m + 1, 3|7)
        Solved bases of the submaps and end of the last.
    gps : Gps or None
        GPS fixes of the log, used and withheld.
    """
    classes = class_consistency(graph)
    for name, c in classes.items():
        row = c.as_row()
        if not np.isfinite(c.ratio) or name in NOT_TESTED:
            continue
        out.add(f"consistency_{name}_chi2_per_dof", c.ratio, "", "one")
        out.add(f"consistency_{name}_dof", c.dof)
        out.add(f"consistency_{name}_low", row["low"])
        out.add(f"consistency_{name}_high", row["high"])
        if c.least_weight < 1.0:
            out.add(f"consistency_{name}_mean_weight", c.mean_weight)
    innovations = _innovations(graph, gps, settings)
    if innovations is not None:
        for row in innovations.tests():
            for key in ("value", "low", "high", "dof", "autocorrelation", "white", "inside"):
                direction = "one" if key == "value" else "none"
                out.add(f"gps_nis_{row['test']}_{key}", row[key], "", direction)
    fixes = None
    if gps is not None and graph.gps_origin is None:
        fixes = fix_distances(path, gps, sigma=settings.gps.sigma)
    if fixes is not None:
        out.add("gps_distance_median", fixes.median, "m", "lower")
        out.add("gps_distance_expected", fixes.expected, "m")
        out.add("gps_distance_chance", fixes.chance)
    loops = None
    if graph.dim == 3:  # loops are compared by landmarks, which a 3-D graph does not have
        return ResidualConsistency(classes, innovations, None, fixes)
    try:
        known = [graph.as_known(s) for s in submaps]
        found = find_landmark_loops(known, poses, covariance_scale=settings.backend.covariance_scale)
        loops = loop_consistency(found)
    except DataError:  # a chain without a loop has nothing to compare and adds no metrics
        return ResidualConsistency(classes, innovations, None, fixes)
    test = loops.test()
    for key in ("value", "low", "high", "dof", "loops", "inside", "shape"):
        out.add(f"loops_{key}", test[key], "", "one" if key in ("value", "shape") else "none")
    return ResidualConsistency(classes, innovations, loops, fixes)


def _innovations(graph: FactorGraph, gps: Gps | None, settings: RunConfig) -> GpsInnovations | None:
    if gps is None or graph.values.datum is None:
        return None
    c = settings.gps
    withheld = split_fixes(gps, c)[1]
    most, n = MOST_PREDICTED[graph.dim], len(withheld.times)
    if n > most:  # their joint covariance grows with the square of their number
        withheld = withheld.take(np.unique(np.linspace(0, n - 1, most).astype(int)))
    try:
        same = c.segment_gap if c.bias_time is None else max(c.segment_gap, c.bias_every)
        return gps_innovations(graph, withheld, sigma=c.sigma, bias_sigma=c.bias_sigma, segment_gap=same)
    except DataError:  # no withheld fix on the path; the GPS residuals report the counts
        return None
