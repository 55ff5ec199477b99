"""Batch solvers of a graph: each update solves to the optimum."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.core.gaussian import chi2_quantile
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.variables import Values
from graphslam.solve.descent import DescentLimits, Optimum, descend_to_minimum
from graphslam.solve.solution import Solution, make_solution
from graphslam.solve.sparse import PcgProblem, SparseProblem


@dataclass(frozen=True, slots=True)
class LevenbergConfig:
    """Stopping rule.

    Parameters
    ----------
    max_iterations : int
        Gauss-Newton and damped steps together.
    tolerance : float
        Converged when the Newton decrement ``gᵀ A⁻¹ g``, the predicted decrease of the quadratic model, is at most
        ``tolerance · (1 + objective)``.
    """

    max_iterations: int = 100
    tolerance: float = 1e-12


class BatchSolver:
    """Levenberg–Marquardt over the whole graph.

    Parameters
    ----------
    graph : FactorGraph
        Read at every call; the result is written to its values.
    """

    name = "batch"

    def __init__(self, graph: FactorGraph, config: LevenbergConfig | None = None) -> None:
        self.graph = graph
        self.config = config or LevenbergConfig()
        self.seconds = 0.0
        self.iterations = 0

    def update(self) -> None:
        """Solve the graph from its current values.

        Reweighting with robust kernels converges slowly, so with kernels the update stops when the predicted decrease
        is below 1e-6 of the objective; :meth:`solve_to_optimum` continues.
        """
        kernels = self.graph.flat().has_kernels
        self._solve(replace(self.config, tolerance=max(self.config.tolerance, 1e-6)) if kernels else self.config)

    def solve_to_optimum(self) -> None:
        """Solve to the full tolerance."""
        self._solve(self.config)

    def problem(self) -> SparseProblem:
        """Least-squares problem of the current graph, with the linear solver."""
        return SparseProblem(self.graph.flat())

    def _solve(self, config: LevenbergConfig) -> None:
        t0 = time.perf_counter()
        optimum = best_optimum(self.graph, config, self.problem())
        self.graph.set_values(optimum.values)
        self.iterations += optimum.iterations
        self.seconds += time.perf_counter() - t0

    def solution(self, *, gap: bool = True) -> Solution:
        """Solution at the current values; not converged if the graph changed since the last update."""
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
    """Batch solver with preconditioned conjugate gradients, for graphs too large to factorise."""

    name = "pcg"

    def problem(self) -> SparseProblem:
        """See :meth:`BatchSolver.problem`."""
        return PcgProblem(self.graph.flat())


def optimise_problem(problem: SparseProblem, values: Values, config: LevenbergConfig | None = None) -> Optimum:
    """Minimise a problem from ``values``: Gauss–Newton steps while the objective decreases, otherwise damped steps."""
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
    """Optimum of a graph, starting at its current values; the graph is not changed.

    Parameters
    ----------
    problem : SparseProblem, optional
        The problem with its linear solver; default: direct solves.
    """
    try:
        return optimise_problem(problem or SparseProblem(graph.flat()), graph.values, config)
    except IndeterminateError:
        graph.diagnose().raise_if_bad()
        raise


def best_optimum(
    graph: FactorGraph, config: LevenbergConfig | None = None, problem: SparseProblem | None = None
) -> Optimum:
    """:func:`optimise_graph`, and after the removal of a factor also from the chain of submaps; the lower optimum.

    Values that a wrong factor has bent can be so far away that the descent ends in another minimum. The chain is tried
    only if χ² of the first optimum is larger than in 999 of 1000 consistent graphs.
    """
    found = optimise_graph(graph, config, problem)
    removed, graph.factor_removed = graph.factor_removed, False
    flat = graph.flat()
    if not removed or not found.objective > chi2_quantile(0.999, flat.measurements - flat.layout.size):
        return found
    problem = problem or SparseProblem(flat)
    again = optimise_problem(problem, chain_values(graph), config)
    return again if again.objective < found.objective else found


def chain_values(graph: FactorGraph) -> Values:
    """The values with all nodes along the chain of submaps, and each landmark with the first submap that has it."""
    values = graph.values.copy()
    g, before, poses = values.group, values.poses.copy(), values.poses.copy()
    landmarks, row_of = values.landmarks.copy(), values.layout().row_of
    moved = np.zeros(len(landmarks), dtype=bool)
    for s in graph.submaps:
        base = poses[s.node].copy()
        poses[list(s.nodes)] = g.compose(np.broadcast_to(base, s.T_base_node.shape), s.T_base_node)
        rows = np.array([row_of[int(i)] for i in graph.landmark_ids_of(s.key)], dtype=np.int64)
        rows = rows[~moved[rows]]
        landmarks[rows] = g.transform(base, g.transform(g.inverse(before[s.node]), landmarks[rows]))
        moved[rows] = True
    values.poses, values.landmarks = poses, landmarks
    return values


def linearisation_gap(graph: FactorGraph) -> float:
    """Objective at the graph's values minus the batch optimum reached from there."""
    optimum = optimise_graph(graph)
    return optimum.objective_initial - optimum.objective


def state_of(graph: FactorGraph) -> Optimum:
    """The current values as an (unconverged) optimum: objective and predicted decrease."""
    problem = SparseProblem(graph.flat())
    objective, decrement = problem.objective(graph.values), 0.0
    if graph.flat().layout.size:
        decrement = problem.decrement(graph.values)
    if not np.isfinite(decrement):
        graph.diagnose().raise_if_bad()
        raise IndeterminateError("the Gauss-Newton matrix is singular")
    return Optimum(graph.values, objective, objective, decrement, 0, "stalled")
