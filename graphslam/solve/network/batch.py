"""Batch least squares on GTSAM's native factors, where plain numpy is slower (3-D) or loses digits (QR).

GTSAM's LM returns the initial values without a word when the factorisation fails, so the iteration is driven from here
(:mod:`~graphslam.solve.descent`).
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from graphslam.core.network import PoseNetwork
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.gtsam_values import from_gtsam, to_gtsam
from graphslam.graph.network import network_values, problem_of_network
from graphslam.graph.variables import Values
from graphslam.solve.descent import RELATIVE
from graphslam.solve.network.factors import to_graph

# Above this spread of information normal equations lose the small directions: QR instead of Cholesky.
CHOLESKY_LIMIT = 1e10
# A damped step that lowers the objective by less than this share of it is not worth another one of its kind.
LITTLE = 1e-3
# The trust region begins with this radius [m, rad]; shrinking it costs evaluations of the objective, no solves.
FIRST_RADIUS = 10.0


class BatchProblem:
    """A network as a GTSAM graph, with the linear solver that its numbers need.

    Parameters
    ----------
    used : (m + k,) bool, optional
        Which edges and observations enter; all of them if not given.
    """

    def __init__(self, network: PoseNetwork, used: np.ndarray | None = None, flat: FactorArrays | None = None) -> None:
        self.network = network
        self.flat = problem_of_network(network, ordered=False) if flat is None else flat
        self.graph = to_graph(network, used, self.flat)
        self._ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(self.graph)
        self.factorization = "QR" if information_spread(network) > CHOLESKY_LIMIT else "CHOLESKY"

    def pack(self, values: Values) -> gtsam.Values:
        """Values as GTSAM holds them."""
        return to_gtsam(values, held=True)

    def unpack(self, values: gtsam.Values) -> Values:
        """GTSAM's values as ours."""
        return from_gtsam(values, network_values(self.network, self.network.poses))

    def objective(self, values: gtsam.Values) -> float:
        """``Σ rᵀ Ω r`` (GTSAM's error is half of it)."""
        return float(2.0 * self.graph.error(values))

    def newton_step(self, values: gtsam.Values) -> tuple[gtsam.Values, float, float]:
        """One full Gauss-Newton step, the fall of the objective that it predicts, and the objective after it."""
        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType(f"MULTIFRONTAL_{self.factorization}")
        params.setOrdering(self._ordering)
        optimizer = gtsam.GaussNewtonOptimizer(self.graph, values, params)
        before = optimizer.error()
        linear = optimizer.iterate()
        moved = optimizer.values()
        fall = before - linear.error(values.localCoordinates(moved))
        return moved, float(2.0 * fall), float(2.0 * optimizer.error())

    def decrement(self, values: gtsam.Values) -> float:
        """Predicted remaining fall of the objective; infinite if the linear system could not be solved."""
        try:
            fall = self.newton_step(values)[1]
        except RuntimeError:
            return float("inf")
        # a negative prediction is rounding at a minimum, or a solve that failed
        return abs(fall) if np.isfinite(fall) else float("inf")

    def damped(self, values: gtsam.Values, objective: float, budget: int) -> tuple[gtsam.Values, list[float], int]:
        """Up to ten LM steps, and where they make little of it up to twenty of Powell's dog leg; all downhill.

        LM gets down from far away. In a curved valley (headings off by more than the residual is linear over) it
        creeps, with one damping for all directions, where steps in a trust region keep their full length along it: on
        15,000 poses with 0.3 rad of noise LM is 3 % above the dog leg after 150 steps of each.

        Returns
        -------
        objectives : list of float
            After every step taken.
        steps : int
            Steps tried.
        """
        lm = gtsam.LevenbergMarquardtParams()
        lm.setLinearSolverType(f"MULTIFRONTAL_{self.factorization}")
        lm.setlambdaUpperBound(1e12)
        optimizer: Any = gtsam.LevenbergMarquardtOptimizer(self.graph, values, lm)
        values, taken, steps = _downhill(optimizer, values, objective, min(10, budget), LITTLE)
        if steps < min(10, budget) or not taken:
            leg = gtsam.DoglegParams()
            leg.setLinearSolverType(f"MULTIFRONTAL_{self.factorization}")
            leg.setDeltaInitial(FIRST_RADIUS)
            optimizer = gtsam.DoglegOptimizer(self.graph, values, leg)
            objective = taken[-1] if taken else objective
            values, more, tried = _downhill(optimizer, values, objective, min(20, budget - steps), RELATIVE)
            taken, steps = taken + more, steps + tried
        return values, taken, steps


def _downhill(
    optimizer: Any, values: gtsam.Values, objective: float, budget: int, little: float
) -> tuple[gtsam.Values, list[float], int]:
    """Steps of one of GTSAM's optimizers until it fails, climbs, or lowers the objective by less than ``little``."""
    taken: list[float] = []
    for step in range(budget):
        try:
            optimizer.iterate()
        except RuntimeError:
            return values, taken, step
        now = float(2.0 * optimizer.error())
        if not now < objective:
            return values, taken, step + 1
        small = objective - now < little * objective
        values, objective = optimizer.values(), now
        taken.append(now)
        if small:
            return values, taken, step + 1
    return values, taken, budget


def information_spread(network: PoseNetwork) -> float:
    """Ratio of the extreme positive eigenvalues of all information matrices."""
    parts = [np.linalg.eigvalsh(i).ravel() for i in (network.information, network.observation_information)]
    w = np.concatenate(parts)
    return float(w.max(initial=0.0)) / float(w.min(initial=np.inf, where=w > 0.0))
