"""Levenberg–Marquardt on the flat arrays of a graph, independent of GTSAM.

Whitened residuals, right-tangent steps, robust kernels by reweighting: the same problem as GTSAM's, on vectorised
blocks. GTSAM calls a Python factor once per submap and iteration; here a whole iteration over two hundred published
local maps is one compiled loop and one factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import lapack

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.core.geometry import Array
from graphslam.graph.flat import FlatGraph, System
from graphslam.graph.variables import Values
from graphslam.linear.symmetric_factor import SymmetricFactor

# A dense Cholesky factorisation beats a sparse one below this many columns (measured).
DENSE_SOLVE_LIMIT = 600


@dataclass(frozen=True, slots=True)
class LevenbergConfig:
    """When to stop.

    Parameters
    ----------
    max_iterations : int
        Accepted and rejected steps together.
    tolerance : float
        Converged when the Newton decrement ``gᵀ A⁻¹ g``, the decrease that the quadratic model still promises, is at
        most ``tolerance · max(1, objective)``.
    """

    max_iterations: int = 100
    tolerance: float = 1e-12


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where the optimiser stopped.

    Parameters
    ----------
    values : Values
    objective_initial, objective : float
        ``Σ rᵀ P⁻¹ r`` (no ½) before and after.
    decrement : float
        Decrease of the objective that the quadratic model still promises.
    iterations : int
    converged : bool
    chi2 : (f,)
        Per factor.
    """

    values: Values
    objective_initial: float
    objective: float
    decrement: float
    iterations: int
    converged: bool
    chi2: Array


def newton_step(system: System, damping: float = 0.0) -> tuple[Array, float]:
    """``-(A + λ diag A)⁻¹ g`` and the decrement ``gᵀ (A + λ diag A)⁻¹ g``.

    Raises
    ------
    IndeterminateError
        The matrix is singular.
    """
    A, g = system.A, system.g
    if len(g) == 0:
        return g, 0.0
    d = np.asarray(A.diagonal())
    if np.any(~np.isfinite(d)) or np.any(d <= 0):
        raise IndeterminateError("a variable has no information at all")
    if sp.issparse(A):
        M = A + sp.diags(damping * d, format="csc") if damping else A
        step = SymmetricFactor(sp.csc_matrix(M)).solve(-g)
    else:
        s = 1.0 / np.sqrt(d)
        M = A * s[:, None]
        M *= s
        M[np.diag_indices_from(M)] += damping
        L, info = lapack.dpotrf(M.T, lower=1, overwrite_a=1)  # .T: LAPACK's order, no copy
        if info != 0:
            raise IndeterminateError("the Gauss-Newton matrix is singular")
        y, _ = lapack.dpotrs(L, -g * s, lower=1)
        step = y * s
    if not np.all(np.isfinite(step)):
        raise IndeterminateError("the Gauss-Newton matrix is singular to working precision")
    return step, float(-g @ step)


def optimise(
    flat: FlatGraph, values: Values, config: LevenbergConfig | None = None, *, weights: Array | None = None
) -> Optimum:
    """Minimise the objective of a graph from ``values``.

    Gauss–Newton steps while they help, damped ones when they do not. ``weights`` ``(f,)`` multiply the information of
    the factors.

    Raises
    ------
    IndeterminateError
        The graph does not determine its variables (:meth:`PoseGraph.diagnose` names them).
    SolverError
        The objective is not finite at the start.
    """
    cfg = config or LevenbergConfig()
    dense = flat.layout.size <= DENSE_SOLVE_LIMIT
    system = flat.evaluate(values, dense=dense, weights=weights)
    initial = system.objective
    if not np.isfinite(initial):
        raise SolverError(f"objective is {initial} at the initial values; a factor or a value is not finite")
    damping, decrement = 0.0, np.inf
    iterations = 0
    converged = flat.layout.size == 0
    while not converged and iterations < cfg.max_iterations:
        iterations += 1
        step, promised = newton_step(system, damping)
        if damping == 0.0 or not np.isfinite(decrement):
            decrement = promised
        if damping == 0.0 and promised <= cfg.tolerance * max(1.0, system.objective):
            decrement = max(promised, 0.0)
            converged = True
            # the step is there already and the last one squares the error, so take it
            trial = values.retract(step)
            last = flat.evaluate(trial, hessian=False, weights=weights)
            if last.objective <= system.objective * (1.0 + 1e-13):
                values, system = trial, last
            break
        trial = values.retract(step)
        after = flat.evaluate(trial, hessian=False, weights=weights).objective
        # rounding alone moves the objective by about this much: not a reason to damp
        noise = 1e-13 * system.objective
        if after <= system.objective + noise:
            values = trial
            system = flat.evaluate(values, dense=dense, weights=weights)
            damping = 0.0 if damping <= 1e-6 else damping / 10.0
        else:
            damping = 1e-4 if damping == 0.0 else damping * 10.0
            if damping > 1e12:
                break
    return Optimum(values, initial, system.objective, float(decrement), iterations, converged, system.chi2)
