"""Graduated non-convexity over a whole graph: outliers are downweighted, reported and removed.

Truncated least squares by graduated non-convexity (Yang et al., RA-L 2020, algorithm 1): every tested factor has a
weight in [0, 1]; the surrogate of the truncated loss starts convex and becomes less convex in each round. Tested are
matches, loops, fixes, distances, headings and similar; the chain of submaps, IMU factors and priors count as inliers.
The limit of a factor is the χ² quantile at ``confidence`` of its dimension.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from graphslam.core.config import check_options
from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import FactorRecord, batch_of
from graphslam.graph.noise import NO_KERNEL
from graphslam.solve.batch import BatchSolver, LevenbergConfig, optimise_problem
from graphslam.solve.solution import Solution
from graphslam.solve.sparse import SparseProblem

BELIEVED = frozenset({"submap", "dense-submap", "levelled", "imu", "declination"})
"""Classes of factors that always count as inliers; so do priors."""
BY_CHANCE = 0.1
"""Share of the GPS fixes that can agree by chance: any two whose distance is right determine a datum."""


@dataclass(frozen=True, slots=True)
class GncConfig:
    """Configuration of the outlier test.

    Parameters
    ----------
    confidence : float
        An inlier is within its limit with this probability.
    growth : float
        Growth of μ per round: larger is less convex.
    """

    confidence: float = 0.999
    growth: float = 1.4
    max_rounds: int = 100

    def __post_init__(self) -> None:
        ranges = {"in (0.5, 1)": "confidence", "> 1 or inf": "growth", "≥ 1": "max_rounds"}
        check_options(self, "graduated non-convexity: ", ranges)


class GncSolver(BatchSolver):
    """Batch solver that removes outliers when it solves to the optimum.

    :meth:`update` solves by least squares. :meth:`solve_to_optimum` runs graduated non-convexity from there, removes
    the outliers from the graph (events ``outlier``: factor, class, χ² and its limit), and ends at the optimum of the
    rest.
    """

    name = "gnc"

    def __init__(self, graph: FactorGraph, config: LevenbergConfig | None = None, gnc: GncConfig | None = None) -> None:
        super().__init__(graph, config)
        self.gnc = gnc or GncConfig()
        self._searched = -1  # revision of the graph at the last search for outliers

    def solve_to_optimum(self) -> None:
        """Find and remove the outliers, and solve to the full tolerance."""
        t0 = time.perf_counter()
        if self.graph.revision != self._searched:
            for record, d2, limit in find_outliers(self.graph, self.gnc, self.config):
                self.graph.log_event(
                    "outlier", factor_id=record.factor_id, factor=record.label(), group=record.group,
                    chi2=d2, limit=limit,
                )  # fmt: skip
                why = f"outlier: χ² {d2:.1f} where {limit:.1f} is the limit"
                if d2 <= limit:
                    why = "so few of the fixes agree with the map that it can be chance"
                self.graph.remove(record.factor_id, reason=why)
            self._searched = self.graph.revision
        self.seconds += time.perf_counter() - t0
        self._solve(self.config)

    def solution(self, *, gap: bool = True) -> Solution:
        """See :meth:`BatchSolver.solution`; outliers are removed first if the graph changed."""
        if self.graph.revision != self._searched:
            self.solve_to_optimum()
        return super().solution(gap=gap)


def find_outliers(
    graph: FactorGraph, config: GncConfig | None = None, solver: LevenbergConfig | None = None
) -> list[tuple[FactorRecord, float, float]]:
    """Factors with a final weight below 0.5, with their final χ² and its limit.

    All GPS fixes, if so few of them are left that they can agree by chance. The graph is not changed.
    """
    cfg = config or GncConfig()
    records: list[Any] = list(graph.records.values())
    doubtful = np.array([not batch_of(type(r)).prior and r.group not in BELIEVED for r in records], dtype=bool)
    if not np.any(doubtful):
        return []
    plain = [replace(r, robust=NO_KERNEL) if d and hasattr(r, "robust") else r for r, d in zip(records, doubtful)]
    flat, values = FactorArrays(plain, graph.values.layout()), graph.values
    limit = 2.0 * gammaincinv(0.5 * np.array([r.rows for r in records]), cfg.confidence)
    w = np.ones(len(records))
    d2 = flat.evaluate(values, hessian=False).chi2
    worst = float(np.max(d2[doubtful] / limit[doubtful]))
    if worst <= 1.0:  # no factor exceeds its limit: plain least squares
        return []
    mu = 1.0 / max(2.0 * worst - 1.0, 1e-6)
    for _ in range(cfg.max_rounds):
        w[doubtful] = truncation_weights(d2[doubtful] / limit[doubtful], mu)
        try:
            optimum = optimise_problem(SparseProblem(flat, w), values, solver)
        except IndeterminateError:  # too many zero weights: the rest is not connected
            break
        values, d2 = optimum.values, flat.evaluate(optimum.values, hessian=False).chi2
        if np.all((w < 1e-3) | (w > 1.0 - 1e-3)) and mu > 1.0:
            break
        mu *= cfg.growth
    w[doubtful] = truncation_weights(d2[doubtful] / limit[doubtful], max(mu, 1e3))
    out = doubtful & (w < 0.5)
    fixes = doubtful & np.array([r.group == "gps" for r in records])
    if (out & fixes).any() and np.count_nonzero(fixes & ~out) < max(graph.dim + 1, BY_CHANCE * np.count_nonzero(fixes)):
        out |= fixes
    return [(records[k], float(d2[k]), float(limit[k])) for k in np.flatnonzero(out)]


def truncation_weights(ratio: Array, mu: float) -> Array:
    """Weights of truncated least squares as a function of χ² over its limit (Yang et al., eq. 14)."""
    low, high = mu / (mu + 1.0), (mu + 1.0) / mu
    between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratio, 1e-12)) - mu
    return np.where(ratio <= low, 1.0, np.where(ratio >= high, 0.0, np.clip(between, 0.0, 1.0)))
