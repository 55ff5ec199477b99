"""Batch least squares on GTSAM's native factors: Gauss-Newton while it helps, damped steps where it does not.

GTSAM's own stopping rules look at the fall of the objective, which says nothing where progress is merely slow, and
its LM returns the initial values without a word when the factorisation fails. So the iteration is driven from here,
and an answer counts as converged only if the *predicted* remaining fall of a full Gauss-Newton step (the decrement
``‖r‖² - min_δ ‖J δ + r‖²``, by exact sparse elimination) is negligible.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.solve.network.factors import from_values, to_graph, to_values

log = logging.getLogger(__name__)

Status = Literal["converged", "rejected", "stalled", "out of iterations"]
# Converged: the next step would lower the objective by less than this share of it …
RELATIVE = 1e-9
# … or by less than this per residual (a network without noise has objective zero).
ABSOLUTE = 1e-14
# Above this ratio of extreme information eigenvalues normal equations lose the small ones: QR instead of Cholesky.
CHOLESKY_LIMIT = 1e9
# Gauss-Newton may climb to this multiple of the best objective, and for this many steps.
CLIMB, PATIENCE = 1e4, 8
# A damped step that lowers the objective by less than this share of it is not worth another one of its kind.
LITTLE = 1e-3
# The trust region begins with this radius [m, rad]; shrinking it costs evaluations of the objective, no solves.
FIRST_RADIUS = 10.0
# A start that after so many steps is still above the best of the others is given up.
CHALLENGE = 10


@dataclass(frozen=True, slots=True)
class Polished:
    """Where a local solver ended.

    Parameters
    ----------
    values : object
        As the problem holds them.
    objective : float
        ``Σ rᵀ Ω r``.
    decrement : float
        Predicted further fall of the objective; infinite if the linear system could not be solved.
    iterations : int
        Steps taken, Gauss-Newton and damped.
    status : str
    """

    values: Any
    objective: float
    decrement: float
    iterations: int
    status: Status


class Problem(Protocol):
    """What :func:`polish` needs of a problem; ``values`` are whatever the problem makes of them."""

    network: PoseNetwork
    factorization: str

    def values(self, poses: Array, landmarks: Array) -> Any: ...

    def arrays(self, values: Any) -> tuple[Array, Array]: ...

    def objective(self, values: Any) -> float: ...

    def newton_step(self, values: Any) -> tuple[Any, float]: ...

    def decrement(self, values: Any) -> float: ...

    def damped(self, values: Any, objective: float, budget: int) -> tuple[Any, list[float], int]: ...


def is_converged(network: PoseNetwork, objective: float, decrement: float) -> bool:
    """Whether a decrement is negligible: 1e-9 of the objective, or 1e-14 per residual."""
    return bool(decrement <= RELATIVE * objective + ABSOLUTE * network.residuals)


class BatchProblem:
    """A network as a GTSAM graph, with the linear solver that its numbers need.

    Parameters
    ----------
    network : PoseNetwork
    used : (m + k,) bool, optional
        Which edges and observations enter; all of them if not given.
    """

    def __init__(self, network: PoseNetwork, used: np.ndarray | None = None) -> None:
        self.network = network
        self.graph = to_graph(network, used)
        self.factorization = "QR" if _spread(network) > CHOLESKY_LIMIT else "CHOLESKY"

    def values(self, poses: Array, landmarks: Array) -> gtsam.Values:
        """Arrays to GTSAM values."""
        return to_values(self.network, poses, landmarks)

    def arrays(self, values: gtsam.Values) -> tuple[Array, Array]:
        """GTSAM values to arrays."""
        return from_values(self.network, values)

    def objective(self, values: gtsam.Values) -> float:
        """``Σ rᵀ Ω r`` (GTSAM's error is half of it)."""
        return float(2.0 * self.graph.error(values))

    def newton_step(self, values: gtsam.Values) -> tuple[gtsam.Values, float]:
        """One full Gauss-Newton step and the fall of the objective it predicts.

        Raises
        ------
        RuntimeError
            GTSAM's, if the linear system is singular to working precision.
        """
        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType(f"MULTIFRONTAL_{self.factorization}")
        optimizer = gtsam.GaussNewtonOptimizer(self.graph, values, params)
        linear = optimizer.iterate()
        moved = optimizer.values()
        step = values.localCoordinates(moved)
        zero = gtsam.VectorValues.Zero(step)
        return moved, float(2.0 * (linear.error(zero) - linear.error(step)))

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
        values : gtsam.Values
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


def _spread(network: PoseNetwork) -> float:
    top, low = 0.0, np.inf
    for information in (network.information, network.observation_information):
        if len(information):
            w = np.linalg.eigvalsh(information)
            top = max(top, float(w.max()))
            positive = w[w > 0.0]
            low = min(low, float(positive.min()) if len(positive) else np.inf)
    return top / low


def polish(problem: Problem, values: Any, *, best_known: float = np.inf, max_iterations: int = 200) -> Polished:
    """Descend from ``values`` to the local minimum, or give up early if it cannot compete.

    Parameters
    ----------
    best_known : float
        Objective that another start has reached. The descent is rejected once it cannot get below it in reasonable
        time: after 10 steps, or when its recent rate kept up for twenty times as long would not do.
    max_iterations : int
        Gauss-Newton and damped steps together.

    Returns
    -------
    Polished
        Never worse than ``values``.
    """
    best = _descend(problem, values, best_known, max_iterations)
    if best.status == "stalled" and not np.isfinite(best.decrement) and problem.factorization == "CHOLESKY":
        # the normal equations are what failed; QR squares no condition number
        log.info("%s: Cholesky made no progress, going on with QR", problem.network.source)
        problem.factorization = "QR"
        again = _descend(problem, best.values, best_known, max_iterations)
        if again.objective <= best.objective:
            best = Polished(
                again.values, again.objective, again.decrement, best.iterations + again.iterations, again.status
            )
    return best


def _descend(problem: Problem, values: Any, best_known: float, budget: int) -> Polished:
    objective, used, attempts = problem.objective(values), 0, 0
    history = [objective]
    while used < budget:
        found = _newton(problem, values, objective, min(budget - used, 40), PATIENCE if attempts == 0 else 2)
        used, attempts = used + found.iterations, attempts + 1
        if found.objective < objective:
            values, objective = found.values, found.objective
            history.append(objective)
        if found.status == "converged":
            return Polished(values, objective, found.decrement, used, "converged")
        if _hopeless(history, best_known, used):
            return Polished(values, objective, found.decrement, used, "rejected")
        # damped: always downhill, until Gauss-Newton is worth another try
        before = objective
        values, taken, steps = problem.damped(values, objective, budget - used)
        history += taken
        objective = history[-1]
        used += max(steps, 1)
        if _hopeless(history, best_known, used):
            return Polished(values, objective, float("inf"), used, "rejected")
        if not objective < before:
            decrement = problem.decrement(values)
            done = is_converged(problem.network, objective, decrement)
            return Polished(values, objective, decrement, used, "converged" if done else "stalled")
    decrement = problem.decrement(values)
    done = is_converged(problem.network, objective, decrement)
    return Polished(values, objective, decrement, used, "converged" if done else "out of iterations")


def _newton(problem: Problem, values: Any, objective: float, budget: int, patience: int) -> Polished:
    """Full Gauss-Newton steps, allowed to climb for a while.

    After rotations-first the first step often trades a higher objective for the right shape, and the next ones fall
    far below the start; a monotone method creeps instead. ``patience`` steps without a new best end the attempt.
    """
    best, lowest, steps, since = values, objective, 0, 0
    while steps < budget and since < patience:
        try:
            moved, fall = problem.newton_step(values)
        except RuntimeError:
            break
        steps += 1
        now = problem.objective(moved)
        # at a minimum to rounding the step may go either way by a trifle; a clearly negative fall is a failed solve
        if values is best and is_converged(problem.network, lowest, abs(fall)):
            if now < lowest:
                best, lowest = moved, now
            return Polished(best, lowest, max(fall, 0.0), steps, "converged")
        if not np.isfinite(now) or fall < 0.0 or now > CLIMB * lowest:
            break
        values, since = moved, since + 1
        if now < lowest:
            best, lowest, since = moved, now, 0
    return Polished(best, lowest, float("inf"), steps, "stalled")


def _hopeless(history: list[float], best_known: float, used: int) -> bool:
    """Whether a descent is above the best known objective and will not get below it in reasonable time."""
    if not history[-1] > best_known * (1.0 + 1e-6):
        return False
    if used > CHALLENGE and history[-1] > 1.001 * best_known:
        return True
    recent = history[-5:]
    return len(history) > 8 and recent[-1] - 20.0 * (recent[0] - recent[-1]) > best_known
