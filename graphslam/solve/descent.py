"""Minimisation of a least-squares problem: Gauss-Newton while the objective decreases, otherwise damped steps.

A small decrease of the objective can also mean slow progress. A result is therefore converged only if the *predicted*
decrease of a full Gauss-Newton step (the decrement ``‖r‖² - min_δ ‖J δ + r‖²``, by exact sparse elimination) is
negligible; or, after full steps with the predicted effect, if extrapolation of the decrements is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.graph.variables import Values
from graphslam.solve.sparse import FAILED, RELATIVE, SparseProblem

Status = Literal["converged", "rejected", "stalled", "out of iterations"]
# Converged: the predicted decrease is less than RELATIVE times the objective, or less than this per residual (a network
# without noise has objective zero).
ABSOLUTE = 1e-14
# Relative difference of the objective below which two starts agree.
SAME = 1e-6
# Gauss-Newton may increase the objective to this multiple of the best, for this many steps.
CLIMB, PATIENCE = 1e4, 8
# The decrement is extrapolated if the last step changed the objective as predicted, up to this relative error, and if
# each decrement is at most this share of the previous one (with a third of the limit).
AS_PREDICTED, FAST = 0.1, 0.02
# A start is rejected if after this number of steps it is above the best of the others.
CHALLENGE = 10


@dataclass(frozen=True, slots=True)
class Optimum:
    """Result of a local solver.

    Parameters
    ----------
    values : Values
    objective_initial, objective : float
        ``Σ rᵀ Ω r`` before and after.
    decrement : float
        Predicted further decrease of the objective; infinite if the linear system could not be solved.
    iterations : int
        Number of steps, Gauss-Newton and damped.
    status : str
    """

    values: Values
    objective_initial: float
    objective: float
    decrement: float
    iterations: int
    status: Status

    @property
    def converged(self) -> bool:
        """Whether it is a stationary point."""
        return self.status == "converged"


@dataclass(frozen=True, slots=True)
class DescentLimits:
    """Convergence limits, and how long Gauss-Newton may increase the objective.

    Parameters
    ----------
    relative, absolute : float
        Converged: predicted decrease below ``relative`` times the objective plus ``absolute``.
    patience : int
        Most consecutive Gauss-Newton steps without a new best objective.
    """

    relative: float
    absolute: float
    patience: int = PATIENCE

    def reached(self, objective: float, decrement: float) -> bool:
        """Whether a decrement is negligible."""
        return bool(decrement <= self.relative * objective + self.absolute)


def limits_of(measurements: int) -> DescentLimits:
    """A decrement is negligible at 1e-9 of the objective, or 1e-14 per residual."""
    return DescentLimits(RELATIVE, ABSOLUTE * measurements)


def descend_to_minimum(
    problem: SparseProblem,
    values: Values,
    *,
    best_known: float = np.inf,
    max_iterations: int = 200,
    predict: bool = False,
    limits: DescentLimits | None = None,
) -> Optimum:
    """Descend from ``values`` to the local minimum, or stop early if another start is better.

    Parameters
    ----------
    best_known : float
        Objective that another start has reached. The descent is rejected if it is above it after 10 steps, or if twenty
        times its recent decrease would not reach it.
    max_iterations : int
        Gauss-Newton and damped steps together.
    predict : bool
        Skip the last step if the rate of convergence predicts a negligible change.
    limits : DescentLimits, optional
        Default: :func:`limits_of` the number of measurements.

    Returns
    -------
    Optimum
        Never worse than ``values``.
    """
    limits, budget = limits or limits_of(problem.flat.measurements), max_iterations
    objective, used, attempts = problem.objective(values), 0, 0
    history = [objective]

    def end(decrement: float, status: Status) -> Optimum:
        return Optimum(values, history[0], objective, decrement, used, status)

    while used < budget:
        patience = limits.patience if attempts == 0 else min(2, limits.patience)
        found = _newton(problem, values, objective, min(budget - used, 40), patience, predict, limits)
        used, attempts = used + found.iterations, attempts + 1
        if found.objective < objective:
            values, objective = found.values, found.objective
            history.append(objective)
        if found.converged:
            return end(found.decrement, "converged")
        if _hopeless(history, best_known, used):
            return end(found.decrement, "rejected")
        # damped steps: the objective always decreases; then Gauss-Newton again
        before = objective
        values, costs, steps = problem.damped(values, objective, budget - used)
        history += costs
        objective = history[-1]
        used += max(steps, 1)
        if _hopeless(history, best_known, used):
            return end(float("inf"), "rejected")
        if not objective < before:
            decrement = problem.decrement(values)
            return end(decrement, "converged" if limits.reached(objective, decrement) else "stalled")
    decrement = problem.decrement(values)
    return end(decrement, "converged" if limits.reached(objective, decrement) else "out of iterations")


def _newton(
    problem: SparseProblem,
    values: Values,
    objective: float,
    budget: int,
    patience: int,
    predict: bool,
    limits: DescentLimits,
) -> Optimum:
    """Full Gauss-Newton steps; the objective may increase for some steps.

    After an initialisation by rotations, the first step often increases the objective, and the next ones decrease it
    far below the start; a monotone method is slow there. The attempt ends after ``patience`` steps without a new best.
    """
    best, lowest, steps, since, before = values, objective, 0, 0, float("inf")
    while steps < budget and since < patience:
        try:
            moved, fall, now = problem.newton_step(values)
        except FAILED:
            break
        steps += 1
        # at a minimum the change can have either sign by rounding; a clearly negative fall is a failed solve
        if values is best and limits.reached(lowest, abs(fall)):
            if now < lowest:
                best, lowest = moved, now
            return Optimum(best, objective, lowest, max(fall, 0.0), steps, "converged")
        if not np.isfinite(now) or fall < 0.0 or now > CLIMB * lowest:
            break
        held = values is best and abs(lowest - now - fall) <= AS_PREDICTED * fall
        left, before = fall * fall / before if np.isfinite(before) else float("inf"), fall
        values, since = moved, since + 1
        if now < lowest:
            best, lowest, since = moved, now, 0
            if predict and held and left <= FAST * fall and limits.reached(lowest, 3.0 * left):
                return Optimum(best, objective, lowest, left, steps, "converged")
    return Optimum(best, objective, lowest, float("inf"), steps, "stalled")


def _hopeless(history: list[float], best_known: float, used: int) -> bool:
    """Whether a descent is above the best known objective and too slow to get below it."""
    if not history[-1] > best_known * (1.0 + 1e-6):
        return False
    if used > CHALLENGE and history[-1] > 1.001 * best_known:
        return True
    recent = history[-5:]
    return len(history) > 8 and recent[-1] - 20.0 * (recent[0] - recent[-1]) > best_known
