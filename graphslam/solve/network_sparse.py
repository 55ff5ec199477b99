"""Pose networks without GTSAM: vectorised numpy blocks, and a choice of direct or conjugate-gradient linear solves.

Serves networks that GTSAM has no native factor for (Cartesian landmark observations) and the ``pcg`` solver.

Conjugate gradients stop on an estimate of the error in the *energy* norm, which is the fall of the objective that is
still missing, not on the residual: on long chains a residual of 1e-6 goes with solutions that are wrong by 100 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.sparse.csgraph import minimum_spanning_tree

from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.solve.network_model import Layout, linearise, objective

Values = tuple[Array, Array]
# The missing fall of the objective is estimated from the falls of this many last iterations (Strakoš & Tichý 2002).
DELAY = 10


def factor(H: sp.csc_matrix) -> spla.SuperLU:
    """Sparse symmetric factorisation.

    Raises
    ------
    RuntimeError
        Singular.
    """
    return spla.splu(
        sp.csc_matrix(H), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


class SparseProblem:
    """A network in numpy, with direct sparse solves.

    Parameters
    ----------
    network : PoseNetwork
    """

    factorization = "LU"

    def __init__(self, network: PoseNetwork) -> None:
        self.network = network
        self.layout = Layout.of(network)

    def values(self, poses: Array, landmarks: Array) -> Values:
        """Arrays are the values."""
        return poses, landmarks

    def arrays(self, values: Values) -> Values:
        """Values are the arrays."""
        return values

    def objective(self, values: Values) -> float:
        """``Σ rᵀ Ω r``."""
        return objective(self.network, *values)

    def solve_linear(self, J: sp.csr_matrix, H: sp.csc_matrix, b: Array) -> Array:
        """``H⁻¹ b`` with one step of iterative refinement."""
        lu = factor(H)
        x = lu.solve(b)
        return np.asarray(x + lu.solve(b - H @ x))

    def newton_step(self, values: Values) -> tuple[Values, float]:
        """One Gauss-Newton step and the fall of the objective it predicts.

        Raises
        ------
        RuntimeError
            Singular linear system.
        """
        J, r = linearise(self.network, *values, self.layout)
        step = self.solve_linear(J, sp.csc_matrix(J.T @ J), -(J.T @ r))
        if not np.isfinite(step).all():
            raise RuntimeError("the linear system is singular")
        return self.layout.retract(*values, step), float(r @ r - np.sum((J @ step + r) ** 2))

    def decrement(self, values: Values) -> float:
        """Predicted remaining fall of the objective, always by a direct solve; infinite if that fails."""
        try:
            J, r = linearise(self.network, *values, self.layout)
            step = SparseProblem.solve_linear(self, J, sp.csc_matrix(J.T @ J), -(J.T @ r))
            fall = float(r @ r - np.sum((J @ step + r) ** 2))
        except RuntimeError:
            return float("inf")
        return abs(fall) if np.isfinite(fall) else float("inf")

    def damped(self, values: Values, objective: float, budget: int) -> tuple[Values, list[float], int]:
        """Up to ten LM steps, all downhill, damped by the diagonal (Marquardt)."""
        taken: list[float] = []
        damping, steps = 1e-6, 0
        for _ in range(min(10, budget)):
            J, r = linearise(self.network, *values, self.layout)
            H, b = sp.csc_matrix(J.T @ J), -(J.T @ r)
            D = sp.diags(H.diagonal(), format="csc")
            while damping < 1e12:
                try:
                    moved = self.layout.retract(*values, self.solve_linear(J, H + damping * D, b))
                    now = self.objective(moved)
                except RuntimeError:
                    now = np.inf
                if now < objective:
                    break
                damping *= 10.0
            else:
                break
            steps += 1
            small = objective - now < 1e-3 * objective
            values, objective, damping = moved, now, damping / 10.0
            taken.append(now)
            if small:
                break
        return values, taken, steps


@dataclass
class PcgReport:
    """What conjugate gradients did over a whole solve."""

    solves: int = 0
    iterations: int = 0
    unconverged: int = 0
    residuals: list[float] = field(default_factory=list)


class PcgProblem(SparseProblem):
    """A network in numpy, with preconditioned conjugate gradients.

    The preconditioner is exact on a spanning tree of the network (subgraph preconditioning, Dellaert et al. 2010):
    the tree with the largest information is factorised, without fill, and the other measurements enter by their
    diagonal blocks.

    Parameters
    ----------
    network : PoseNetwork
    tolerance : float
        Relative error of a linear solution in the energy norm.
    max_iterations : int
        Per linear solve. One that runs out is counted in ``report.unconverged`` and its step is used as it is.
    """

    factorization = "PCG"

    def __init__(self, network: PoseNetwork, *, tolerance: float = 1e-6, max_iterations: int = 2000) -> None:
        super().__init__(network)
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.report = PcgReport()
        self._tree_rows = _tree_rows(network)

    def solve_linear(self, J: sp.csr_matrix, H: sp.csc_matrix, b: Array) -> Array:
        """``H⁻¹ b`` by preconditioned conjugate gradients."""
        keep = self._tree_rows
        tree, rest = J[keep], J[~keep]
        d = np.asarray(rest.power(2).sum(axis=0)).ravel()
        M = sp.csc_matrix(tree.T @ tree)
        # damping, if any, is on the diagonal of H and must be in the preconditioner too
        extra = np.maximum(H.diagonal() - M.diagonal() - d, 0.0)
        lu = factor(M + sp.diags(d + extra + 1e-12 * H.diagonal().max(), format="csc"))
        x, iterations, converged = pcg(H, b, lu.solve, self.tolerance, self.max_iterations)
        self.report.solves += 1
        self.report.iterations += iterations
        self.report.unconverged += not converged
        self.report.residuals.append(float(np.linalg.norm(b - H @ x)) / max(float(np.linalg.norm(b)), 1e-300))
        return x


def _tree_rows(network: PoseNetwork) -> np.ndarray:
    """Mask of residual rows that belong to a spanning tree of poses and landmarks with the largest information."""
    n = len(network) + len(network.landmark_ids)
    pairs = np.concatenate([network.edges, network.observations + [0, len(network)]])
    weight = np.concatenate(
        [
            np.trace(network.information, axis1=1, axis2=2),
            np.trace(network.observation_information, axis1=1, axis2=2),
        ]
    )
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    # the heaviest of parallel measurements stands for them; minimum spanning tree of the inverse weights
    order = np.lexsort((-weight, high, low))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    unique = order[first]
    cost = 1.0 / np.maximum(weight[unique], 1e-300)
    tree = minimum_spanning_tree(sp.csr_matrix((cost, (low[unique], high[unique])), shape=(n, n))).tocoo()
    chosen = np.isin(low[unique] * n + high[unique], tree.row.astype(np.int64) * n + tree.col)
    in_tree = np.zeros(len(pairs), dtype=bool)
    in_tree[unique[chosen]] = True
    m = len(network.edges)
    return np.concatenate([np.repeat(in_tree[:m], network.tangent_dim), np.repeat(in_tree[m:], 2)])


def pcg(
    H: sp.csc_matrix,
    b: Array,
    precondition: Callable[[Array], Array],
    tolerance: float,
    max_iterations: int,
) -> tuple[Array, int, bool]:
    """Preconditioned conjugate gradients with an energy-norm stopping rule.

    ``‖x - x_k‖²_H`` is bounded from below by ``Σ_{j=k}^{k+d-1} α_j r_jᵀ z_j`` (Hestenes & Stiefel 1952; Strakoš &
    Tichý 2002); with d = 10 it is a sound estimate of the error ten iterations ago. The same sum from the beginning
    is ``‖x_k‖²_H``, so their ratio is the relative error.

    Returns
    -------
    x : (n,)
    iterations : int
    converged : bool
    """
    x = np.zeros_like(b)
    r = b.copy()
    z = precondition(r)
    p, rz = z.copy(), float(r @ z)
    falls: list[float] = []
    total = 0.0
    if rz == 0.0:
        return x, 0, True
    for k in range(1, max_iterations + 1):
        Hp = H @ p
        curvature = float(p @ Hp)
        if not curvature > 0.0:
            return x, k, False
        alpha = rz / curvature
        x += alpha * p
        r -= alpha * Hp
        falls.append(alpha * rz)
        total += falls[-1]
        if len(falls) >= DELAY and sum(falls[-DELAY:]) <= tolerance**2 * total:
            return x, k, True
        z = precondition(r)
        fresh = float(r @ z)
        if fresh <= 1e-32 * total:
            return x, k, True
        p = z + (fresh / rz) * p
        rz = fresh
    return x, max_iterations, False
