"""Certificate of global optimality of a solved pose network by duality, as in SE-Sync.

With isotropic noise and chordal distances,

    ``F(X) = Σ κ ‖R_j - R_i Z_ij‖² + τ ‖t_j - t_i - R_i z_ij‖² = tr(X Q Xᵀ)``,  ``X = [t_1 R_1 … t_n R_n]``,

pose-graph optimisation is a quadratic program whose Lagrangian dual shows when a stationary point is a global minimum
(Rosen, Carlone, Bandeira & Leonard 2019, theorem 7 and eq. 107-110; here with the positions, which keeps the matrix
sparse): with ``Λ_i = sym(R_iᵀ [X Q]_i)``, the multipliers of ``R_iᵀ R_i = I``, the point is a global minimum if
``S = Q - BlkDiag(0, Λ_i)`` has no negative eigenvalue.

The objective of this package (full logarithm, any information) is not F. So a solution is called *certified* if

1. descent of F from it ends at a stationary point Y with ``S ⪰ 0``: Y is F's global minimum, and
2. descent of the real objective from Y ends at the solution again.

That certifies the basin, by the global minimum of a similar problem for which a proof exists. If the real objective and
F have different best basins, the answer is "not known".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core import se3
from graphslam.core.geometry import Array, rotation2
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import rotation_matrices
from graphslam.graph.network import network_values
from graphslam.solve.descent import SAME, descend_to_minimum
from graphslam.solve.network.start import network_arrays
from graphslam.solve.sparse import MANY, BlockElimination, SparseProblem, factorise_sparse

Verdict = Literal["certified", "not certified", "not known"]
# S counts as positive semi-definite if S + TOLERANCE · (median diagonal of Q) has no negative pivot.
TOLERANCE = 1e-7
# Descent of F stops when the predicted decrease is below this share of F, or after this number of steps.
FALL, STEPS = 1e-12, 200


@dataclass(frozen=True, slots=True)
class Certificate:
    """Result of the test for global optimality.

    Parameters
    ----------
    verdict : {"certified", "not certified", "not known"}
    reason : str
        Reason if it is not certified.
    smallest_eigenvalue : float
        Of ``S``, in units of the median diagonal of Q; ``nan`` if not computed. At a global minimum of F it is zero
        (the gauge) up to rounding.
    relaxed_objective : float
        F at its stationary point.
    objective_from_relaxation : float
        The real objective after descent from there; ``nan`` if not tried.
    """

    verdict: Verdict
    reason: str = ""
    smallest_eigenvalue: float = float("nan")
    relaxed_objective: float = float("nan")
    objective_from_relaxation: float = float("nan")

    def __str__(self) -> str:
        if self.verdict == "not certified":
            return f"not certified (λ_min = {self.smallest_eigenvalue:.3g})"
        return self.verdict if self.verdict == "certified" else f"not known ({self.reason})"


def certify(network: PoseNetwork, poses: Array, objective: float, *, eigenvalue: bool = True) -> Certificate:
    """Test whether a solution is the global optimum.

    Parameters
    ----------
    network : PoseNetwork
        The measurements that were minimised: for gnc only the inliers.
    poses : (n, 3) or (n, 7)
        A stationary point of the objective.
    objective : float
        ``Σ rᵀ Ω r`` there.
    eigenvalue : bool
        Also compute its value; the verdict needs only its sign.

    Returns
    -------
    Certificate
        "not known", with the reason, if the test does not apply; no exception.
    """
    if len(network.observations):
        return Certificate("not known", "landmark observations are not part of the relaxation")
    if network.position_priors.any():
        return Certificate("not known", "position priors are not part of the relaxation")
    if len(network.anchors) > 1:
        return Certificate("not known", "several vertices are held in place")
    try:
        weights = isotropic(network)
    except np.linalg.LinAlgError:
        return Certificate("not known", "a measurement has singular information")
    A = residual_matrix(network, *weights)
    Q = sp.csr_matrix(A.T @ A)
    X, value, stationary = _descend(network, A, poses)
    if not stationary:
        return Certificate("not known", "descent of the relaxed objective did not end", relaxed_objective=value)
    scale = float(np.median(Q.diagonal()))
    S = sp.csc_matrix(dual_matrix(A, X) / scale)
    negative = _negative_pivots(S + TOLERANCE * sp.identity(S.shape[0], format="csc"), network.dim)
    lowest = float("nan")
    if eigenvalue:
        lowest = smallest_eigenvalue(S) if negative else _least_bound(S)
    if negative:
        return Certificate("not certified", f"{negative} negative directions", lowest, value)
    problem = SparseProblem(network_arrays(network))
    back = descend_to_minimum(problem, network_values(network, _poses_of(X, network)), predict=True).objective
    if abs(back - objective) <= SAME * abs(objective) + 1e-12 * network.residuals:
        return Certificate("certified", "", lowest, value, back)
    word = "lower" if back < objective else "higher"
    return Certificate(
        "not known",
        f"the relaxation's global minimum leads to another minimum, {back:.8g}, which is {word}",
        lowest,
        value,
        back,
    )


def isotropic(network: PoseNetwork) -> tuple[Array, Array]:
    """κ and τ of every edge ``(m,)`` each: the isotropic noise with the same total variance.

    ``‖R_j - R_i Z‖² = 2 θ²`` to second order, so ``κ = 1/(2 σ²)``.
    """
    w = np.linalg.eigvalsh(network.information)
    if (w[:, 0] <= 1e-12 * w[:, -1]).any():
        raise np.linalg.LinAlgError("singular information")
    P = np.linalg.inv(network.information)
    turn, shift = (slice(2, 3), slice(0, 2)) if network.dim == 2 else (slice(0, 3), slice(3, 6))

    def mean(block: slice) -> Array:
        return np.diagonal(P[:, block, block], axis1=1, axis2=2).mean(axis=1)

    return 0.5 / mean(turn), 1.0 / mean(shift)


def _matrices(network: PoseNetwork, poses: Array) -> tuple[Array, Array]:
    p = network.dim
    return poses[:, :p], rotation_matrices(poses)


def residual_matrix(network: PoseNetwork, kappa: Array, tau: Array) -> sp.csr_matrix:
    """``A`` with ``F = ‖A Xᵀ‖²`` and ``Q = AᵀA``; columns by pose: t_i, then R_i.

    A keeps the precision of objective and gradient with large positions and extreme weights.
    """
    p, n, m = network.dim, len(network), len(network.edges)
    z, Z = _matrices(network, network.measurements)
    i, j = network.edges.T * (p + 1)
    # rows of A: X Aᵀ stacks the residuals R_j - R_i Z (p columns an edge) and t_j - t_i - R_i z (one)
    turn = np.arange(p)
    row = np.arange(m)[:, None] * (p + 1) + turn
    k, t = np.sqrt(kappa), np.sqrt(tau)
    last = np.arange(m) * (p + 1) + p
    rows = [row, np.broadcast_to(row[:, None, :], (m, p, p)), last, last, np.broadcast_to(last[:, None], (m, p))]
    columns = [
        j[:, None] + 1 + turn,
        np.broadcast_to((i[:, None] + 1 + turn)[:, :, None], (m, p, p)),
        j,
        i,
        i[:, None] + 1 + turn,
    ]
    values = [np.broadcast_to(k[:, None], (m, p)), -k[:, None, None] * Z, t, -t, -t[:, None] * z]
    return sp.csr_matrix(
        (
            np.concatenate([v.ravel() for v in values]),
            (np.concatenate([r.ravel() for r in rows]), np.concatenate([c.ravel() for c in columns])),
        ),
        shape=(m * (p + 1), n * (p + 1)),
    )


def _stack(t: Array, R: Array) -> Array:
    """``Xᵀ`` ``(n(p+1), p)``."""
    return np.concatenate([t[:, None, :], np.swapaxes(R, 1, 2)], axis=1).reshape(-1, t.shape[1])


def _descend(network: PoseNetwork, A: sp.csr_matrix, poses: Array) -> tuple[Array, float, bool]:
    """Stationary point of F, from given poses, by Newton's method on the manifold with a damped Hessian.

    The Riemannian Hessian is ``2 (Q - BlkDiag(0, Λ))`` between tangents ``R_i [ω_i]×`` and ``t_i``: it is exact, so
    convergence is quadratic. Damping keeps it positive definite.
    """
    p, n = network.dim, len(network)
    basis = np.array([[[0.0, -1.0], [1.0, 0.0]]]) if p == 2 else se3.skew(np.eye(3))
    d = p + len(basis)
    t, R = (a.copy() for a in _matrices(network, poses))
    value = float(np.sum((A @ _stack(t, R)) ** 2))
    damping, eye = 0.0, sp.identity(n * d - d, format="csc")
    blocks: BlockElimination | None = None
    before = 0.0
    for _ in range(STEPS):
        Y = _stack(t, R)
        S = dual_matrix(A, Y)
        # tangent directions of Xᵀ: each column of D is a direction, vectorised over the p columns of Xᵀ
        D = _directions(R, basis)[:, d:]
        gradient = D.T @ np.asarray(A.T @ (A @ Y)).T.reshape(-1)
        H = sp.csc_matrix(D.T @ (sp.block_diag([S] * p, format="csr") @ D))
        if n > MANY[p] and blocks is None:
            blocks = BlockElimination(H, d)
        factorise = factorise_sparse if blocks is None else blocks.factor
        while True:
            try:
                step = factorise(sp.csc_matrix(H + damping * eye)).solve(-gradient)
            except RuntimeError:
                step = np.full(len(gradient), np.nan)
            fall = -float(gradient @ step)
            if np.isfinite(fall) and fall >= 0.0 and np.abs(step).max(initial=0.0) < 1e6:
                moved_t, moved_R = _move(t, R, step, basis)
                Y = _stack(moved_t, moved_R)
                fresh = float(np.sum((A @ Y) ** 2))
                if fall <= FALL * max(value, 1e-300) or fresh < value:
                    break
            damping = max(10.0 * damping, 1e-6 * float(np.median(np.abs(H.diagonal()))))
            if damping > 1e12 * float(np.abs(H.diagonal()).max()):
                return _stack(t, R), value, False
        if fresh <= value:
            t, R, value = moved_t, moved_R, fresh
        # convergence is at least as fast as before, so the next decrease is below fall² / before
        rate = min(fall / before, 1.0) if before else 1.0
        if damping == 0.0 and fall * rate <= FALL * max(value, 1e-300):
            return _stack(t, R), value, True
        before = fall if damping == 0.0 else 0.0
        damping = 0.0 if damping < 1e-5 * float(np.median(np.abs(H.diagonal()))) else 0.1 * damping
    return _stack(t, R), value, False


def _directions(R: Array, basis: Array) -> sp.csr_matrix:
    """Tangent directions ``(p n(p+1), n d)``: position along every axis, rotation ``R_i [e_k]×``; the caller removes
    the columns of the fixed first pose."""
    n, p = R.shape[:2]
    q, d = len(basis), p + len(basis)
    size = n * (p + 1)
    at = np.arange(n)
    axis = np.arange(p)
    rows = [(axis[None, :] * size + (at * (p + 1))[:, None]).ravel()]
    columns = [(at[:, None] * d + axis).ravel()]
    values = [np.ones(n * p)]
    moved = np.einsum("nab,kbc->nkac", R, basis)  # (n, q, row of X, column of the block)
    a, c = np.meshgrid(axis, axis, indexing="ij")
    rows.append((a * size + c + 1 + (at * (p + 1))[:, None, None, None] + np.zeros((1, q, 1, 1), int)).ravel())
    columns.append(np.broadcast_to((at[:, None] * d + p + np.arange(q))[:, :, None, None], moved.shape).ravel())
    values.append(moved.ravel())
    return sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(p * size, n * d)
    ).tocsc()


def _move(t: Array, R: Array, step: Array, basis: Array) -> tuple[Array, Array]:
    p, q = t.shape[1], len(basis)
    x = np.concatenate([np.zeros(p + q), step]).reshape(-1, p + q)
    turn = rotation2(x[:, p]) if p == 2 else se3.quat_to_matrix(se3.so3_exp(x[:, p:]))
    return t + x[:, :p], R @ turn


def dual_matrix(A: sp.csr_matrix, X: Array) -> sp.csr_matrix:
    """``S = AᵀA - BlkDiag(0, Λ_i)`` at ``Xᵀ`` ``(n(p+1), p)``, ``Λ_i = sym(R_iᵀ [X Q]_i)``."""
    p = X.shape[1]
    blocks = X.reshape(-1, p + 1, p)[:, 1:]
    forces = np.asarray(A.T @ (A @ X)).reshape(-1, p + 1, p)[:, 1:]
    L = forces @ np.swapaxes(blocks, 1, 2)
    L = 0.5 * (L + np.swapaxes(L, 1, 2))
    n, size = len(L), A.shape[1]
    at = np.arange(n)[:, None, None] * (p + 1) + 1
    rows = np.broadcast_to(at + np.arange(p)[:, None], L.shape)
    columns = np.broadcast_to(at + np.arange(p)[None, :], L.shape)
    return sp.csr_matrix(A.T @ A - sp.csr_matrix((L.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)))


def _negative_pivots(S: sp.csc_matrix, p: int) -> int:
    """Negative eigenvalues, by the signs of the pivots of ``L D Lᵀ`` (Sylvester's law of inertia).

    SuperLU's symmetric mode without pivoting is that factorisation; if it pivoted, the matrix is not positive definite.
    Of many poses it is only needed if there is no Cholesky factor.
    """
    try:
        if S.shape[0] > MANY[p] * (p + 1):
            BlockElimination(S, p + 1).factor(S)
            return 0
    except RuntimeError:
        pass
    try:
        lu = factorise_sparse(S)
    except RuntimeError:
        return 1
    swapped = int((lu.perm_r != lu.perm_c).sum())
    return int((lu.U.diagonal() < 0.0).sum()) or swapped


def smallest_eigenvalue(S: sp.spmatrix) -> float:
    """Smallest eigenvalue by Lanczos; ``nan`` if it did not converge."""
    try:
        return float(spla.eigsh(S, k=1, which="SA", tol=1e-3, maxiter=3000, return_eigenvectors=False)[0])
    except spla.ArpackError:
        return float("nan")


def _least_bound(S: sp.csc_matrix) -> float:
    """Smallest eigenvalue of a positive semi-definite S (up to the tolerance), by inverse Lanczos."""
    try:
        shift = -10.0 * TOLERANCE
        return float(spla.eigsh(S, k=1, sigma=shift, which="LM", tol=1e-6, return_eigenvectors=False)[0])
    except (spla.ArpackError, RuntimeError):
        return float("nan")


def _poses_of(X: Array, network: PoseNetwork) -> Array:
    p = network.dim
    blocks = X.reshape(-1, p + 1, p)
    t, R = blocks[:, 0], np.swapaxes(blocks[:, 1:], 1, 2)
    if p == 2:
        return np.concatenate([t, np.arctan2(R[:, 1, 0], R[:, 0, 0])[:, None]], axis=1)
    return np.concatenate([t, se3.matrix_to_quat(R)], axis=1)
