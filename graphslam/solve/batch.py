"""Batch solving of a graph, to the optimum at every update."""

from __future__ import annotations

import time
from dataclasses import replace

import gtsam
import numpy as np

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.gtsam_values import from_gtsam, to_gtsam
from graphslam.graph.pose_graph import PoseGraph
from graphslam.graph.variables import Values
from graphslam.solve.levenberg import LevenbergConfig, Optimum, newton_step, optimise
from graphslam.solve.solution import Solution, make_solution


class BatchSolver:
    """Levenberg–Marquardt over the whole graph.

    Parameters
    ----------
    graph : PoseGraph
        Read at every call; its values are written back.
    config : LevenbergConfig, optional
    """

    name = "batch"

    def __init__(self, graph: PoseGraph, config: LevenbergConfig | None = None) -> None:
        self.graph = graph
        self.config = config or LevenbergConfig()
        self.seconds = 0.0
        self.iterations = 0

    def update(self) -> None:
        """Solve what the graph holds now, from its present values.

        Reweighting under robust kernels converges slowly, so with kernels it stops here when a step promises less than
        1e-6 of the objective; :meth:`solve_to_optimum` goes all the way.

        Raises
        ------
        IndeterminateError
            Names the unconstrained variables; the graph's values stay as they were.
        """
        kernels = self.graph.flat().has_kernels
        self._solve(replace(self.config, tolerance=max(self.config.tolerance, 1e-6)) if kernels else self.config)

    def solve_to_optimum(self) -> None:
        """Solve until nothing is left to gain."""
        self._solve(self.config)

    def _solve(self, config: LevenbergConfig) -> None:
        t0 = time.perf_counter()
        optimum = optimise_graph(self.graph, config)
        self.graph.set_values(optimum.values)
        self.iterations += optimum.iterations
        self.seconds += time.perf_counter() - t0

    def gap(self) -> float:
        """Objective now less the batch optimum reached from here."""
        return linearisation_gap(self.graph)

    def covariance(self) -> JointCovariance:
        """Joint covariance at the present values."""
        return self.graph.covariance()

    def solution(self, *, gap: bool = True) -> Solution:
        """Solution at the present values; says so if the graph changed since the last update."""
        here = state_of(self.graph)
        return make_solution(
            self.name,
            self.graph,
            here,
            iterations=self.iterations,
            gap=linearisation_gap(self.graph) if gap else None,
            seconds=self.seconds,
        )


def optimise_graph(graph: PoseGraph, config: LevenbergConfig | None = None) -> Optimum:
    """Optimum of a graph from its present values; the graph is not changed.

    Raises
    ------
    IndeterminateError
        Names the unconstrained variables and what would fix them.
    """
    try:
        return optimise(graph.flat(), graph.values, config)
    except IndeterminateError:
        graph.diagnose().raise_if_bad()
        raise


def linearisation_gap(graph: PoseGraph) -> float:
    """Objective at the graph's values less the batch optimum reached from there."""
    optimum = optimise_graph(graph)
    return optimum.objective_initial - optimum.objective


def state_of(graph: PoseGraph) -> Optimum:
    """The present values seen as an (unconverged) optimum: objective, and the decrease still promised."""
    flat = graph.flat()
    system = flat.evaluate(graph.values)
    try:
        _, decrement = newton_step(system)
    except IndeterminateError:
        graph.diagnose().raise_if_bad()
        raise
    return Optimum(graph.values, system.objective, system.objective, decrement, 0, False, system.chi2)


def optimise_with_gtsam(graph: PoseGraph, *, max_iterations: int = 100) -> tuple[Values, float]:
    """The same optimum by GTSAM's own Levenberg–Marquardt, as an independent check (ten times slower).

    Returns
    -------
    values : Values
    objective : float
        Twice GTSAM's error, i.e. ``Σ rᵀ P⁻¹ r``.
    """
    factors = gtsam.NonlinearFactorGraph()
    for record in graph.records.values():
        factors.push_back(gtsam_factor(record, graph.origin))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(1e-12)
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, to_gtsam(graph.values), parameters)
    values = from_gtsam(optimiser.optimize(), graph.values)
    objective = 2.0 * float(factors.error(to_gtsam(values)))
    if not np.isfinite(objective):
        raise SolverError(f"GTSAM ended at objective {objective}")
    return values, objective
