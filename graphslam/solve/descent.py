"""Descent to a minimum of a least-squares problem: Gauss-Newton while it helps, damped steps where it does not.

Stopping rules that look at the fall of the objective say nothing where progress is merely slow. So an answer counts as
converged only if the *predicted* remaining fall of a full Gauss-Newton step (the decrement
``‖r‖² - min_δ ‖J δ + r‖²``, by exact sparse elimination) is negligible; or, after full steps that did what was
predicted of them, if it will be by the rate at which the decrement falls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.graph.variables import Values
from graphslam.solve.sparse import FAILED, RELATIVE, SparseProblem

Status = Literal["converged", "rejected", "stalled", "out of iterations"]
# Converged: the next step would lower the objective by less than RELATIVE of it, or by less than this per residual (a
# network without noise has objective zero).
ABSOLUTE = 1e-14
# Two starts agree, and one beats another, at this relative difference of the objective.
SAME = 1e-6
# Gauss-Newton may climb to this multiple of the best objective, and for this many steps.
CLIMB, PATIENCE = 1e4, 8
# The decrement may be foretold if the last step changed the objective by what it predicted to this share of it, and if
# each decrement is at most this share of the one before (a third of the limit is asked for then).
TRUE_TO_WORD, FAST = 0.1, 0.02
# A start that after so many steps is still above the best of the others is given up.
CHALLENGE = 10


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where a local solver ended.

    Parameters
    ----------
    values : Values
    objective_initial, objective : float
        ``Σ rᵀ Ω r`` before and after.
    decrement : float
        Predicted further fall of the objective; infinite if the linear system could not be solved.
    iterations : int
        Steps taken, Gauss-Newton and damped.
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
        """At a stationary point."""
        return self.status == "converged"


@dataclass(frozen=True, slots=True)
class DescentLimits:
    """When a descent has converged, and how long Gauss-Newton may climb.

    Parameters
    ----------
    relative, absolute : float
        Converged: the next step would lower the objective by less than this share of it plus this.
    patience : int
        Gauss-Newton steps in a row without a new best.
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
    foretell: bool = False,
    limits: DescentLimits | None = None,
) -> Optimum:
    """Descend from ``values`` to the local minimum, or give up early if it cannot compete.

    Parameters
    ----------
    best_known : float
        Objective that another start has reached. The descent is rejected once it cannot get below it in reasonable
        time: after 10 steps, or when its recent rate kept up for twenty times as long would not do.
    max_iterations : int
        Gauss-Newton and damped steps together.
    foretell : bool
        Save the last step where the rate of convergence foretells that it changes nothing that counts.
    limits : DescentLimits, optional
        By default :func:`limits_of` the measurements.

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
        found = _newton(problem, values, objective, min(budget - used, 40), patience, foretell, limits)
        used, attempts = used + found.iterations, attempts + 1
        if found.objective < objective:
            values, objective = found.values, found.objective
            history.append(objective)
        if found.converged:
            return end(found.decrement, "converged")
        if _hopeless(history, best_known, used):
            return end(found.decrement, "rejected")
        # damped: always downhill, until Gauss-Newton is worth another try
        before = objective
        values, taken, steps = problem.damped(values, objective, budget - used)
        history += taken
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
    foretell: bool,
    limits: DescentLimits,
) -> Optimum:
    """Full Gauss-Newton steps, allowed to climb for a while.

    After rotations-first the first step often trades a higher objective for the right shape, and the next ones fall
    far below the start; a monotone method creeps instead. ``patience`` steps without a new best end the attempt.
    """
    best, lowest, steps, since, before = values, objective, 0, 0, float("inf")
    while steps < budget and since < patience:
        try:
            moved, fall, now = problem.newton_step(values)
        except FAILED:
            break
        steps += 1
        # at a minimum to rounding the step may go either way by a trifle; a clearly negative fall is a failed solve
        if values is best and limits.reached(lowest, abs(fall)):
            if now < lowest:
                best, lowest = moved, now
            return Optimum(best, objective, lowest, max(fall, 0.0), steps, "converged")
        if not np.isfinite(now) or fall < 0.0 or now > CLIMB * lowest:
            break
        held = values is best and abs(lowest - now - fall) <= TRUE_TO_WORD * fall
        left, before = fall * fall / before if np.isfinite(before) else float("inf"), fall
        values, since = moved, since + 1
        if now < lowest:
            best, lowest, since = moved, now, 0
            if foretell and held and left <= FAST * fall and limits.reached(lowest, 3.0 * left):
                return Optimum(best, objective, lowest, left, steps, "converged")
    return Optimum(best, objective, lowest, float("inf"), steps, "stalled")


def _hopeless(history: list[float], best_known: float, used: int) -> bool:
    """Whether a descent is above the best known objective and will not get below it in reasonable time."""
    if not history[-1] > best_known * (1.0 + 1e-6):
        return False
    if used > CHALLENGE and history[-1] > 1.001 * best_known:
        return True
    recent = history[-5:]
    return len(history) > 8 and recent[-1] - 20.0 * (recent[0] - recent[-1]) > best_known
