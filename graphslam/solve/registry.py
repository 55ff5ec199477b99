"""Registry of the solvers of a :class:`~graphslam.graph.factor_graph.FactorGraph`."""

from __future__ import annotations

from typing import Any, Protocol

from graphslam.core.errors import UnknownNameError
from graphslam.graph.factor_graph import FactorGraph
from graphslam.solve.batch import BatchSolver, PcgSolver
from graphslam.solve.gnc import GncSolver
from graphslam.solve.isam2 import Isam2Solver
from graphslam.solve.solution import Solution


class Solver(Protocol):
    """Interface of a solver; it reads the graph at each call and writes the result to its values."""

    graph: FactorGraph

    def update(self) -> None:
        """Process the changes of the graph."""
        ...

    def solve_to_optimum(self) -> None:
        """Solve to the batch optimum reached from here."""
        ...

    def solution(self, *, gap: bool = True) -> Solution:
        """Values, score, and whether they are the optimum."""
        ...


SOLVERS: dict[str, type] = {
    "isam2": Isam2Solver,
    "batch": BatchSolver,
    "lm": BatchSolver,
    "gnc": GncSolver,
    "pcg": PcgSolver,
}


def make_solver(name: str, graph: FactorGraph, **options: Any) -> Solver:
    """A registered solver of ``graph``."""
    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    solver: Solver = SOLVERS[name](graph, **options)
    return solver
