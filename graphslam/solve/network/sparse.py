"""Pose networks without GTSAM: vectorised numpy blocks, and a choice of direct or conjugate-gradient linear solves.

Serves networks that GTSAM has no native factor for (Cartesian landmark observations) and the ``pcg`` solver.

Conjugate gradients stop on an estimate of the error in the *energy* norm, which is the fall of the objective that is
still missing, not on the residual: on long chains a residual of 1e-6 goes with solutions that are wrong by 100 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array, se2_adjoint
from graphslam.core.network import PoseNetwork
from graphslam.core.se3 import se3_adjoint
from graphslam.solve.network.model import Layout, inverse, linearise, objective

if TYPE_CHECKING:
    from graphslam.linear.block_cholesky import BlockFactor

Values = tuple[Array, Array]
# The missing fall of the objective is estimated from the falls of this many last iterations (Strakoš & Tichý 2002).
DELAY = 10
# Columns that SuperLU takes together: its default of 20 suits larger fronts than those of pose networks.
PANEL = 10
# Beyond so many poses they are eliminated as blocks, in an order by nested dissection.
MANY = 5_000


def factor(H: sp.csc_matrix, *, ordered: bool = False) -> spla.SuperLU:
    """Sparse symmetric factorisation; ``ordered``: rows and columns are in a good order of elimination already.

    Raises
    ------
    RuntimeError
        Singular.
    """
    return spla.splu(
        sp.csc_matrix(H),
        permc_spec="NATURAL" if ordered else "MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        relax=PANEL,
        panel_size=PANEL,
        options={"SymmetricMode": True},
    )


class BlockElimination:
    """Cholesky factorisations of symmetric matrices of one pattern, whose nodes have ``width`` scalars each.

    The order is GTSAM's METIS: on a drive of 10⁵ poses through a city it leaves 60 % of the entries that minimum degree
    leaves in the factor, and a fifth of the time.
    """

    def __init__(self, H: sp.csc_matrix, width: int) -> None:
        import gtsam  # both of which smaller networks do not need

        from graphslam.linear.block_cholesky import BlockSymbolic

        self.width = width
        ptr, nodes, _ = self._parts(H)
        row = np.repeat(np.arange(len(ptr) - 1), np.diff(ptr))
        upper = row < nodes
        pattern = gtsam.SymbolicFactorGraph()
        for i, j in zip(row[upper].tolist(), nodes[upper].tolist(), strict=True):
            pattern.push_factor(i, j)
        dissected = gtsam.Ordering.MetisSymbolicFactorGraph(pattern)
        order = np.array([dissected.at(k) for k in range(dissected.size())], dtype=np.int64)
        alone = np.setdiff1d(np.arange(len(ptr) - 1), order)  # tied to anchors only
        order = np.concatenate([alone, order])
        self._symbolic = BlockSymbolic(order, np.full(len(order), width), ptr, nodes)

    def _parts(self, H: sp.csc_matrix) -> tuple[np.ndarray, np.ndarray, Array]:
        if np.iscomplexobj(H.data):  # a complex number is a block of two by two
            C = sp.csr_matrix(H)
            data = np.stack([C.data.real, -C.data.imag, C.data.imag, C.data.real], axis=1)
            return C.indptr.astype(np.int64), C.indices.astype(np.int64), data.ravel()
        B = sp.csr_matrix(H).tobsr((self.width, self.width))
        return B.indptr.astype(np.int64), B.indices.astype(np.int64), B.data.ravel()

    def factor(self, H: sp.csc_matrix) -> BlockFactor:
        """Factorisation of a matrix of the pattern.

        Raises
        ------
        RuntimeError
            Not positive definite.
        """
        _, nodes, data = self._parts(H)
        try:
            return self._symbolic.factor(np.arange(len(nodes)) * self.width**2, data)
        except IndeterminateError as error:
            raise RuntimeError(str(error)) from None


class SparseProblem:
    """A network in numpy, with direct sparse solves.

    Parameters
    ----------
    network : PoseNetwork
    """

    factorization = "LU"

    def __init__(self, network: PoseNetwork) -> None:
        self.network = network
        # many poses: compiled block elimination, which begins with half a second of loading
        self._by_block = len(network) > MANY and len(network.landmark_ids) == 0
        self.layout = Layout.of(network) if self._by_block else Layout.for_elimination(network)
        self._elimination: BlockElimination | None = None

    def values(self, poses: Array, landmarks: Array) -> Values:
        """Arrays are the values."""
        return poses, landmarks

    def arrays(self, values: Values) -> Values:
        """Values are the arrays."""
        return values

    def objective(self, values: Values) -> float:
        """``Σ rᵀ Ω r``."""
        return objective(self.network, *values)

    def solve_linear(self, values: Values, H: sp.csc_matrix, b: Array) -> Array:
        """``H⁻¹ b`` at ``values``, with one step of iterative refinement.

        Raises
        ------
        RuntimeError
            Singular, or refinement corrects more than a hundredth of the energy: too few digits are left.
        """
        lu = self._blocks(H) if self._by_block else factor(H, ordered=True)
        x = lu.solve(b)
        left = b - H @ x
        more = lu.solve(left)
        if not abs(more @ left) <= 0.01 * abs(x @ b):
            raise RuntimeError("the linear system is singular to working precision")
        return np.asarray(x + more)

    def _blocks(self, H: sp.csc_matrix) -> BlockFactor:
        if self._elimination is None:
            self._elimination = BlockElimination(H, self.network.tangent_dim)
        return self._elimination.factor(H)

    def newton_step(self, values: Values) -> tuple[Values, float, float]:
        """One Gauss-Newton step, the fall of the objective that it predicts, and the objective after it.

        Raises
        ------
        RuntimeError
            Singular linear system.
        """
        J, r = linearise(self.network, *values, self.layout)
        step = self.solve_linear(values, sp.csc_matrix(J.T @ J), -(J.T @ r))
        if not np.isfinite(step).all():
            raise RuntimeError("the linear system is singular")
        moved = self.layout.retract(*values, step)
        return moved, float(r @ r - np.sum((J @ step + r) ** 2)), self.objective(moved)

    def decrement(self, values: Values) -> float:
        """Predicted remaining fall of the objective, always by a direct solve; infinite if that fails."""
        try:
            J, r = linearise(self.network, *values, self.layout)
            step = SparseProblem.solve_linear(self, values, sp.csc_matrix(J.T @ J), -(J.T @ r))
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
                    moved = self.layout.retract(*values, self.solve_linear(values, H + damping * D, b))
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
    """A network in numpy, with two-level preconditioned conjugate gradients.

    Vertices are grouped, ten neighbours in id order to a group, landmarks with the group that first sees them. The
    fine level solves every group for itself; the coarse level solves for one rigid motion of the world for each
    group, which is what long chains and loops are slow in. The two are combined as a balancing preconditioner
    (Mandel 1993). Against a spanning-tree preconditioner it needs 6 to 60 times fewer iterations on the recorded
    networks.

    Parameters
    ----------
    network : PoseNetwork
    tolerance : float
        Relative error of a linear solution in the energy norm. Its square is the share of the fall of the objective
        that a step misses.
    max_iterations : int
        Per linear solve. One that runs out is counted in ``report.unconverged`` and its step is used as it is.
    group : int
        Vertices a group.
    """

    factorization = "PCG"

    def __init__(
        self, network: PoseNetwork, *, tolerance: float = 1e-4, max_iterations: int = 2000, group: int = 10
    ) -> None:
        super().__init__(network)
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.report = PcgReport()
        groups = np.arange(len(network)) // group
        marks = np.full(len(network.landmark_ids), len(network) - 1)
        np.minimum.at(marks, network.observations[:, 1], network.observations[:, 0])
        self._groups = np.concatenate([groups, groups[marks]])
        # the owner of every free scalar
        self._owner = np.empty(self.layout.size, dtype=np.intp)
        free = np.flatnonzero(self.layout.pose_at >= 0)
        self._owner[self.layout.pose_at[free, None] + np.arange(network.tangent_dim)] = groups[free, None]
        self._owner[self.layout.mark_at[:, None] + np.arange(2)] = self._groups[len(network) :, None]

    def solve_linear(self, values: Values, H: sp.csc_matrix, b: Array) -> Array:
        """``H⁻¹ b`` by preconditioned conjugate gradients."""
        entries = H.tocoo()
        inside = self._owner[entries.row] == self._owner[entries.col]
        fine = factor(sp.csc_matrix((entries.data[inside], (entries.row[inside], entries.col[inside])), shape=H.shape))
        Z = self._rigid_motions(values)
        HZ = sp.csc_matrix(H @ Z)
        E = sp.csc_matrix(Z.T @ HZ)
        # a group that holds only an anchor moves nothing: give it a unit of its own
        diagonal = E.diagonal()
        coarse = factor(E + sp.diags(np.where(diagonal > 0.0, 1e-13 * diagonal, 1.0), format="csc"))

        def precondition(r: Array) -> Array:
            z = Z @ coarse.solve(Z.T @ r)
            w = fine.solve(r - H @ z)
            return np.asarray(z + w - Z @ coarse.solve(HZ.T @ w))

        x, iterations, converged = pcg(H, b, precondition, self.tolerance, self.max_iterations)
        self.report.solves += 1
        self.report.iterations += iterations
        self.report.unconverged += not converged
        residual = float(np.linalg.norm(b - H @ x)) / max(float(np.linalg.norm(b)), 1e-300)
        self.report.residuals.append(residual)
        return x

    def _rigid_motions(self, values: Values) -> sp.csc_matrix:
        """Columns: a twist of the world for every group, ``Exp(ξ) x = x Exp(Ad(x⁻¹) ξ)``, for landmarks ``ξ × l``."""
        poses, marks = values
        network, d = self.network, self.network.tangent_dim
        free = np.flatnonzero(self.layout.pose_at >= 0)
        back = inverse(poses[free])
        blocks = se2_adjoint(back) if network.dim == 2 else se3_adjoint(back)
        parts = [_block_triplets(blocks, self.layout.pose_at[free], d * self._groups[free])]
        if len(marks):
            turn = np.zeros((len(marks), 2, 3))
            turn[:, 0, 0] = turn[:, 1, 1] = 1.0
            turn[:, 0, 2], turn[:, 1, 2] = -marks[:, 1], marks[:, 0]
            parts.append(_block_triplets(turn, self.layout.mark_at, d * self._groups[len(network) :]))
        data, rows, columns = (np.concatenate(p) for p in zip(*parts, strict=True))
        return sp.csc_matrix((data, (rows, columns)), shape=(self.layout.size, d * (int(self._groups.max()) + 1)))


def _block_triplets(blocks: Array, row: np.ndarray, column: np.ndarray) -> tuple[Array, np.ndarray, np.ndarray]:
    height, width = blocks.shape[1:]
    rows = row[:, None, None] + np.arange(height)[:, None] + np.zeros(width, dtype=np.intp)
    columns = column[:, None, None] + np.zeros((height, 1), dtype=np.intp) + np.arange(width)
    return blocks.ravel(), rows.ravel(), columns.ravel()


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
