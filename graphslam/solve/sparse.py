"""Linear steps of a descent: vectorised assembly, with direct or conjugate-gradient solvers.

Conjugate gradients stop on an estimate of the error in the *energy* norm, which is the remaining decrease of the
objective, not on the residual: on long chains a solution with a residual of 1e-6 can be wrong by 100 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg import lapack

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.core.se3 import skew
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.variables import Values

if TYPE_CHECKING:
    from graphslam.linear.block_cholesky import BlockFactor

# The remaining decrease is estimated from this number of last iterations (Strakoš & Tichý 2002).
DELAY = 10
# Panel size of SuperLU: its default of 20 is for larger fronts than those of pose networks.
PANEL = 10
# Number of poses (2-D, 3-D) above which blocks are eliminated in an order by nested dissection.
MANY = {2: 5_000, 3: 1_000}
# First and smallest radius of the trust region [m, rad]; shrinking it costs evaluations of the objective only.
FIRST_RADIUS, LEAST_RADIUS = 10.0, 1e-5
# Damped steps end when one decreases the objective by less than this share.
LITTLE = 1e-3
# Columns up to which dense Cholesky is faster than a sparse one without an order (measured).
DENSE_SOLVE_LIMIT = 600
# A smaller relative decrease of the objective is negligible.
RELATIVE = 1e-9
FAILED = (RuntimeError, IndeterminateError)
"""Exceptions of a singular linear system: from SuperLU or from this package."""
SINGULAR = "the Gauss-Newton matrix is singular to working precision"


def factorise_sparse(H: sp.csc_matrix, *, ordered: bool = False) -> spla.SuperLU:
    """Sparse symmetric factorisation; ``ordered``: the given order is a good elimination order."""
    return spla.splu(
        sp.csc_matrix(H),
        permc_spec="NATURAL" if ordered else "MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        relax=PANEL,
        panel_size=PANEL,
        options={"SymmetricMode": True},
    )


class BlockElimination:
    """Cholesky factorisations of symmetric matrices with one pattern; nodes have ``width`` scalars.

    The order is METIS (from GTSAM): for a drive of 10⁵ poses in a city the factor has 60 % of the entries, and takes a
    fifth of the time, compared with minimum degree.
    """

    def __init__(self, H: sp.csc_matrix, width: int) -> None:
        import gtsam  # both are not needed for smaller networks

        from graphslam.linear.block_cholesky import BlockSymbolic

        self.width = width
        ptr, nodes, _ = self._parts(H)
        self._nodes = nodes
        row = np.repeat(np.arange(len(ptr) - 1), np.diff(ptr))
        upper = row < nodes
        pattern = gtsam.SymbolicFactorGraph()
        for i, j in zip(row[upper].tolist(), nodes[upper].tolist(), strict=True):
            pattern.push_factor(i, j)
        dissected = gtsam.Ordering.MetisSymbolicFactorGraph(pattern)
        order = np.array([dissected.at(k) for k in range(dissected.size())], dtype=np.int64)
        alone = np.setdiff1d(np.arange(len(ptr) - 1), order)  # connected to fixed nodes only
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
        """Factorisation of a matrix with the pattern; RuntimeError if it is not positive definite."""
        _, nodes, data = self._parts(H)
        if not np.array_equal(nodes, self._nodes):  # a block became zero
            return BlockElimination(H, self.width).factor(H)
        try:
            return self._symbolic.factor(np.arange(len(nodes)) * self.width**2, data)
        except IndeterminateError as error:
            raise RuntimeError(str(error)) from None


class SparseProblem:
    """A least-squares problem with direct linear solvers.

    Parameters
    ----------
    weights : (f,), optional
        Weight on the information of every factor.
    thorough : bool
        If the usual steps fail, try a trust region, and QR, which does not square the condition number.
    """

    def __init__(self, flat: FactorArrays, weights: Array | None = None, *, thorough: bool = False) -> None:
        self.flat, self.weights, self.thorough = flat, weights, thorough
        layout = flat.layout
        # many poses and no other variables: compiled block elimination, which takes half a second to load
        self._by_block = layout.size > MANY[layout.dim] * layout.pose_dof and layout.stop("x") == layout.size
        self._dense = not layout.ordered and layout.size <= DENSE_SOLVE_LIMIT
        self._elimination: BlockElimination | None = None

    def objective(self, values: Values) -> float:
        """``Σ rᵀ Ω r``."""
        return self.flat.evaluate(values, hessian=False, weights=self.weights).objective

    def _system(self, values: Values) -> tuple[sp.csc_matrix, Array]:
        """Gauss-Newton matrix and right-hand side."""
        system = self.flat.evaluate(values, dense=self._dense, weights=self.weights)
        d = np.asarray(system.A.diagonal())
        if not np.all(d > 0) or not np.all(np.isfinite(d)):
            raise IndeterminateError("a variable has no information at all")
        return system.A, -system.g

    def solve_linear(self, values: Values, H: sp.csc_matrix, b: Array) -> Array:
        """``H⁻¹ b`` at ``values``, with one step of iterative refinement."""
        if self._dense:
            return _dense_solve(H, b)
        try:
            lu = self._blocks(H) if self._by_block else factorise_sparse(H, ordered=self.flat.layout.ordered)
        except RuntimeError:
            raise IndeterminateError(SINGULAR) from None
        x = lu.solve(b)
        left = b - H @ x
        more = lu.solve(left)
        if not abs(more @ left) <= 0.01 * abs(x @ b):
            raise IndeterminateError(SINGULAR)
        return np.asarray(x + more)

    def _blocks(self, H: sp.csc_matrix) -> BlockFactor:
        if self._elimination is None:
            self._elimination = BlockElimination(H, self.flat.layout.pose_dof)
        return self._elimination.factor(H)

    def newton_step(self, values: Values) -> tuple[Values, float, float]:
        """One Gauss-Newton step, its predicted decrease of the objective, and the objective after it."""
        H, b, step = self._full_step(values)
        moved = self.flat.layout.retract(values, step)
        return moved, float(2.0 * (b @ step) - step @ (H @ step)), self.objective(moved)

    def _full_step(self, values: Values) -> tuple[sp.csc_matrix, Array, Array]:
        """The system at ``values`` and its solution."""
        H, b = self._system(values)
        try:
            return H, b, self.solve_linear(values, H, b)
        except IndeterminateError:
            if not self.thorough:
                raise
            return H, b, self._solve_by_qr(values)

    def _solve_by_qr(self, values: Values) -> Array:
        """The Gauss-Newton step from the whitened Jacobians, by QR elimination in GTSAM."""
        import gtsam

        graph, first = gtsam.GaussianFactorGraph(), 0
        for f in self.flat.batches:
            if not isinstance(f, UniformBatch):
                raise IndeterminateError(SINGULAR)
            r, J = f.whitened(values)
            root = np.ones(len(f)) if self.weights is None else np.sqrt(self.weights[first : first + len(f)])
            r, J, first = root[:, None] * r, root[:, None, None] * J, first + len(f)
            unit, make = gtsam.noiseModel.Unit.Create(r.shape[1]), cast(Any, gtsam.JacobianFactor)
            places = f.first.reshape(len(f), -1).tolist()
            for k, (at, widths) in enumerate(zip(places, f.width.reshape(len(f), -1))):
                parts = zip(at, np.split(J[k], np.cumsum(widths)[:-1], axis=1))
                terms = [x for v, A in parts if v >= 0 for x in (v, np.asfortranarray(A))]
                graph.add(make(*terms, -r[k], unit))
        out = np.zeros(self.flat.layout.size)
        try:
            solved = graph.optimize(gtsam.EliminateQR)
        except RuntimeError:
            raise IndeterminateError(SINGULAR) from None
        for v in graph.keyVector():
            out[v : v + len(solved.at(v))] = solved.at(v)
        return out

    def decrement(self, values: Values) -> float:
        """Predicted remaining decrease of the objective, always by a direct solve; infinite if that fails."""
        try:
            H, b, step = SparseProblem._full_step(self, values)
            fall = float(2.0 * (b @ step) - step @ (H @ step))
        except FAILED:
            return float("inf")
        return abs(fall) if np.isfinite(fall) else float("inf")

    def damped(self, values: Values, objective: float, budget: int) -> tuple[Values, list[float], int]:
        """Up to ten LM steps damped by the diagonal (Marquardt), all decreasing, then a trust region if ``thorough``.

        LM converges from far away. In a curved valley (large heading errors) it is slow, because one damping applies to
        all directions; trust-region steps keep their full length along the valley.
        """
        costs: list[float] = []
        damping, steps = 1e-6, 0
        for _ in range(min(10, budget)):
            H, b = self._system(values)
            D = np.diag(H.diagonal()) if self._dense else sp.diags(H.diagonal(), format="csc")
            while damping < 1e12:
                try:
                    moved = self.flat.layout.retract(values, self.solve_linear(values, H + damping * D, b))
                    now = self.objective(moved)
                except FAILED:
                    now = np.inf
                if now < objective:
                    break
                damping *= 10.0
            else:
                break
            steps += 1
            small = objective - now < LITTLE * objective
            values, objective, damping = moved, now, damping / 10.0
            costs.append(now)
            if small:
                break
        if self.thorough and steps < budget:
            values, more = self._in_trust_region(values, objective, min(20, budget - steps))
            costs, steps = costs + more, steps + len(more)
        return values, costs, steps

    def _in_trust_region(self, values: Values, objective: float, budget: int) -> tuple[Values, list[float]]:
        """Powell's dog leg: the full step, bent towards steepest descent at the radius."""
        costs: list[float] = []
        radius = FIRST_RADIUS
        for _ in range(budget):
            try:
                H, b, full = self._full_step(values)
            except FAILED:
                break
            steepest = float(b @ b) / float(b @ (H @ b)) * b
            while radius > LEAST_RADIUS:
                step = _dog_leg(steepest, full, radius)
                moved = self.flat.layout.retract(values, step)
                now = self.objective(moved)
                agreed = (objective - now) / float(2.0 * (b @ step) - step @ (H @ step))
                if agreed > 0.75:
                    radius = max(radius, 3.0 * float(np.linalg.norm(step)))
                elif not agreed > 0.25:
                    radius *= 0.5
                if now < objective:
                    break
            else:
                break
            small = objective - now < RELATIVE * objective
            values, objective = moved, now
            costs.append(now)
            if small:
                break
        return values, costs


def _dog_leg(steepest: Array, full: Array, radius: float) -> Array:
    """Point where the path from the steepest-descent step to the full step leaves the trust region."""
    if np.linalg.norm(full) <= radius:
        return full
    length = float(np.linalg.norm(steepest))
    if length >= radius:
        return steepest * (radius / length)
    leg = full - steepest
    a, half, c = float(leg @ leg), float(steepest @ leg), length**2 - radius**2
    return np.asarray(steepest + (np.sqrt(half**2 - a * c) - half) / a * leg)


def _dense_solve(H: Array, b: Array) -> Array:
    """Solve by Cholesky, scaled to a unit diagonal."""
    if not len(b):
        return b
    s = 1.0 / np.sqrt(H.diagonal())
    M = H * s[:, None]
    M *= s
    L, info = lapack.dpotrf(M.T, lower=1, overwrite_a=1)  # .T: LAPACK's order, no copy
    x = lapack.dpotrs(L, b * s, lower=1)[0] * s if info == 0 else b
    if info != 0 or not np.all(np.isfinite(x)):
        raise IndeterminateError(SINGULAR)
    return np.asarray(x)


@dataclass
class PcgReport:
    """Statistics of conjugate gradients over all linear solves."""

    solves: int = 0
    iterations: int = 0
    unconverged: int = 0
    residuals: list[float] = field(default_factory=list)


class PcgProblem(SparseProblem):
    """A least-squares problem with two-level preconditioned conjugate gradients.

    Groups are ten poses with consecutive numbers; other variables belong to the first pose that they share a factor
    with. The fine level solves every group separately; the coarse level solves for one rigid motion per group, the slow
    modes of long chains and loops. Both are combined as a balancing preconditioner (Mandel 1993). It needs 6 to 60
    times fewer iterations than a spanning-tree preconditioner on the recorded networks.

    Parameters
    ----------
    tolerance : float
        Relative error of a linear solution in the energy norm. Its square is the share of the decrease that a step
        misses.
    max_iterations : int
        Per linear solve. At the limit it is counted in ``report.unconverged``, and its step is used.
    group : int
        Poses per group.
    """

    def __init__(
        self, flat: FactorArrays, *, tolerance: float = 1e-4, max_iterations: int = 2000, group: int = 10
    ) -> None:
        super().__init__(flat)
        self._dense = False
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.report = PcgReport()
        layout, (factors, variable) = flat.layout, flat.links
        n, far = layout.count("x"), np.iinfo(np.int64).max
        poses = layout.first("x", np.arange(n))
        number = np.full(layout.size + 2, far)  # by first column: the pose whose group a variable belongs to
        number[poses] = np.arange(n)
        number[-1] = 0  # fixed
        lowest = np.full(len(flat), far)
        np.minimum.at(lowest, factors, number[variable])
        other = (variable >= 0) & (number[variable] == far)
        np.minimum.at(number, variable[other], lowest[factors[other]])
        widths = np.zeros(layout.size + 1, dtype=np.int64)
        widths[variable[variable >= 0]] = np.concatenate([f.width for f in flat.batches])[variable >= 0]
        first = np.flatnonzero(widths)
        # group of every free scalar; variables without a factor to a pose are in the first group
        self._owner = np.repeat(np.where(number[first] == far, 0, number[first]), widths[first]) // group

    def solve_linear(self, values: Values, H: sp.csc_matrix, b: Array) -> Array:
        """``H⁻¹ b`` by preconditioned conjugate gradients."""
        entries = H.tocoo()
        inside = self._owner[entries.row] == self._owner[entries.col]
        fine = factorise_sparse(
            sp.csc_matrix((entries.data[inside], (entries.row[inside], entries.col[inside])), shape=H.shape)
        )
        Z = self._rigid_motions(values)
        HZ = sp.csc_matrix(H @ Z)
        E = sp.csc_matrix(Z.T @ HZ)
        # a group with a fixed node only has a zero diagonal: set it to 1
        diagonal = E.diagonal()
        coarse = factorise_sparse(E + sp.diags(np.where(diagonal > 0.0, 1e-13 * diagonal, 1.0), format="csc"))

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
        """Columns: a rigid motion of the world per group, ``Exp(ξ) x = x Exp(Ad(x⁻¹) ξ)``, for points ``ξ × l``."""
        layout, g = self.flat.layout, values.group
        first = layout.first("x", np.arange(layout.count("x")))
        free = np.flatnonzero(first >= 0)
        d, at = g.dof, first[free]
        parts = [_block_triplets(g.adjoint(g.inverse(values.poses[free])), at, d * self._owner[at])]
        marks = values.landmarks
        if len(marks):
            turn = np.zeros((len(marks), g.dim, d))
            turn[:, :, g.position] = np.eye(g.dim)
            if g.dim == 2:
                turn[:, 0, 2], turn[:, 1, 2] = -marks[:, 1], marks[:, 0]
            else:
                turn[:, :, :3] = -skew(marks)
            at = layout.first("l", np.arange(len(marks)))
            parts.append(_block_triplets(turn, at, d * self._owner[at]))
        data, rows, columns = (np.concatenate(p) for p in zip(*parts, strict=True))
        return sp.csc_matrix((data, (rows, columns)), shape=(layout.size, d * (int(self._owner.max(initial=0)) + 1)))


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

    ``‖x - x_k‖²_H`` is bounded from below by ``Σ_{j=k}^{k+d-1} α_j r_jᵀ z_j`` (Hestenes & Stiefel 1952; Strakoš & Tichý
    2002); with d = 10 it is a good estimate of the error ten iterations ago. The sum over all iterations is
    ``‖x_k‖²_H``, so their ratio is the squared relative error.

    Returns
    -------
    x : (n,)
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
