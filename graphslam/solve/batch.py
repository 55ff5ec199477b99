"""Batch solving of a graph, to the optimum at every update."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.variables import Values
from graphslam.solve.descent import DescentLimits, Optimum, descend_to_minimum
from graphslam.solve.solution import Solution, make_solution
from graphslam.solve.sparse import PcgProblem, SparseProblem


@dataclass(frozen=True, slots=True)
class LevenbergConfig:
    """When to stop.

    Parameters
    ----------
    max_iterations : int
        Gauss-Newton and damped steps together.
    tolerance : float
        Converged when the Newton decrement ``gᵀ A⁻¹ g``, the decrease that the quadratic model still promises, is at
        most ``tolerance · (1 + objective)``.
    """

    max_iterations: int = 100
    tolerance: float = 1e-12


class BatchSolver:
    """Levenberg–Marquardt over the whole graph.

    Parameters
    ----------
    graph : FactorGraph
        Read at every call; its values are written back.
    """

    name = "batch"

    def __init__(self, graph: FactorGraph, config: LevenbergConfig | None = None) -> None:
        self.graph = graph
        self.config = config or LevenbergConfig()
        self.seconds = 0.0
        self.iterations = 0

    def update(self) -> None:
        """Solve what the graph holds now, from its present values.

        Reweighting under robust kernels converges slowly, so with kernels it stops here when a step promises less than
        1e-6 of the objective; :meth:`solve_to_optimum` goes all the way.
        """
        kernels = self.graph.flat().has_kernels
        self._solve(replace(self.config, tolerance=max(self.config.tolerance, 1e-6)) if kernels else self.config)

    def solve_to_optimum(self) -> None:
        """Solve until nothing is left to gain."""
        self._solve(self.config)

    def problem(self) -> SparseProblem:
        """What the graph holds now, with the way to make its steps."""
        return SparseProblem(self.graph.flat())

    def _solve(self, config: LevenbergConfig) -> None:
        t0 = time.perf_counter()
        optimum = optimise_graph(self.graph, config, self.problem())
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


class PcgSolver(BatchSolver):
    """Batch solving by preconditioned conjugate gradients: for graphs too large to factorise."""

    name = "pcg"

    def problem(self) -> SparseProblem:
        """See :meth:`BatchSolver.problem`."""
        return PcgProblem(self.graph.flat())


def optimise_problem(problem: SparseProblem, values: Values, config: LevenbergConfig | None = None) -> Optimum:
    """Minimise a problem from ``values``: Gauss–Newton steps while they help, damped ones when they do not."""
    cfg = config or LevenbergConfig()
    initial = problem.objective(values)
    if not np.isfinite(initial):
        raise SolverError(f"objective is {initial} at the initial values; a factor or a value is not finite")
    if problem.flat.layout.size == 0:
        return Optimum(values, initial, initial, 0.0, 0, "converged")
    limits = DescentLimits(cfg.tolerance, cfg.tolerance, patience=1)
    found = descend_to_minimum(problem, values, max_iterations=cfg.max_iterations, limits=limits)
    if not np.isfinite(found.decrement):
        raise IndeterminateError("the Gauss-Newton matrix is singular")
    return found


def optimise_graph(
    graph: FactorGraph, config: LevenbergConfig | None = None, problem: SparseProblem | None = None
) -> Optimum:
    """Optimum of a graph from its present values; the graph is not changed.

    Parameters
    ----------
    problem : SparseProblem, optional
        How its steps are made; by direct solves if not given.
    """
    try:
        return optimise_problem(problem or SparseProblem(graph.flat()), graph.values, config)
    except IndeterminateError:
        graph.diagnose().raise_if_bad()
        raise


def linearisation_gap(graph: FactorGraph) -> float:
    """Objective at the graph's values less the batch optimum reached from there."""
    optimum = optimise_graph(graph)
    return optimum.objective_initial - optimum.objective


def state_of(graph: FactorGraph) -> Optimum:
    """The present values seen as an (unconverged) optimum: objective, and the decrease still promised."""
    problem = SparseProblem(graph.flat())
    objective, decrement = problem.objective(graph.values), 0.0
    if graph.flat().layout.size:
        decrement = problem.decrement(graph.values)
    if not np.isfinite(decrement):
        graph.diagnose().raise_if_bad()
        raise IndeterminateError("the Gauss-Newton matrix is singular")
    return Optimum(graph.values, objective, objective, decrement, 0, "stalled")
