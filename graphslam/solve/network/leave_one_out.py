"""Final outlier decision: every loop and every group of loops is tested against the posterior of all others.

The cost of a loop at the solution is a bad criterion: a false loop that distorts the map has a low cost. With the
whitened residual r, the whitened Jacobian A, the information H of the accepted measurements and ``B = A H⁻¹ Aᵀ``, the
decrease of the objective if an accepted loop is removed, and its increase if a rejected one is added, are to first
order

    ``D² = rᵀ (I - B)⁻¹ r`` and ``D² = rᵀ (I + B)⁻¹ r``,

the same number for the same loop: χ² of the loop against the posterior of all others (Cook 1979).

False loops from one wrong place recognition agree with each other, so ten of them are not independent. A group of
neighbouring loops is therefore tested by their common rigid motion of one path section relative to the other. With
``G_k``, the whitened derivative of loop k with respect to that motion, the χ² of the motion against all measurements
outside the group is

    ``D² = gᵀ (Gᵀ (I - B) G)⁻¹ g``, ``g = Gᵀ r`` (accepted), and the same with ``r → (I + B)⁻¹ r`` and
    ``I - B → (I + B)⁻¹`` (refused).

The limit is estimated per file: recorded loops have heavy tails, which do not follow from the bulk. The tail of the
accepted D² is estimated as far as it is populated (Hill 1975).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of
from graphslam.core.position_priors import keep_datum
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.between import BetweenBatch
from graphslam.graph.variables import Values
from graphslam.solve.descent import Optimum, descend_to_minimum
from graphslam.solve.network.start import network_arrays
from graphslam.solve.sparse import SparseProblem, factorise_sparse

Mask = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
# Loops are neighbours if their ends are at most this number of nodes apart (sum of both); largest tested group.
NEAR, LARGEST = 4, 40
# Rejected loops that are tested in every round (least cost first); columns per linear solve.
TESTED, COLUMNS = 300, 400
# Rounds of accepting and rejecting; steps of a solve between two of them.
ROUNDS, STEPS = 15, 20
# In a round only loops within this factor of the worst are removed: a false loop increases D² of its neighbours.
WORST = 0.25
# The tail is estimated from this share of the accepted loops, with a prior of this weight (in loops) on a tail index
# between Gaussian and Cauchy; beyond the limit this number of true loops is expected.
TAIL, PRIOR, INDEX, BEYOND = 0.05, 5.0, 0.5, 0.5
# … found by iteration from the bulk's quantile, with this number of steps.
FOLLOWED, QUANTILE = 50, 0.9999
# With fewer loops neither tail nor scale is estimated: the noise of the file is used.
FEW = 30
# The probability of rejecting any true loop does not increase beyond this number of loops.
FAMILY = 100
# After the first round, loops and groups below this quantile, in the scale of the bulk, are not tested again.
DULL = 0.95
# Tolerance of eigenvalues of B near 1, i.e. of directions that only the loop itself determines.
HELD = 1e-9


@dataclass(frozen=True, slots=True)
class RobustResult:
    """Inliers and the solution of their least-squares problem.

    Parameters
    ----------
    inliers : (m + k,) bool
        Edges, then observations.
    problem : SparseProblem
        Of the inliers only.
    end : Optimum
        Its objective is that of the inliers.
    limit : (m + k,)
        Largest cost of a measurement, for edges from the tail of the accepted ones; infinite for trusted ones.
    truncated : float
        Truncated cost of the solution.
    scale : float
        True variance of the edges over that in the file: from the median D² of the accepted loops, or given.
    rounds : int
        Rounds until nothing changed; ``ROUNDS`` if the limit was reached.
    start : str
        Start that led to this solution.
    reached : dict of str to float
        Truncated cost by start.
    """

    inliers: Mask
    problem: SparseProblem
    end: Optimum
    limit: Array
    truncated: float = float("nan")
    scale: float = 1.0
    rounds: int = 0
    start: str = ""
    reached: dict[str, float] = field(default_factory=dict)


def weighted_problem(network: PoseNetwork, weights: npt.NDArray[Any]) -> SparseProblem:
    """Least squares of edges and observations with these weights ``(m + k,)``, bool or float."""
    used = weights > 0
    return SparseProblem(network_arrays(network, used), weights[used].astype(np.float64), thorough=True)


def family_quantile(probability: float, count: int) -> float:
    """Probability of keeping one of ``count`` true loops; all are kept as likely as ``FAMILY`` loops with
    ``probability``."""
    return 1.0 - (1.0 - probability) * min(1.0, FAMILY / max(count, 1))


def tail_limit(D2: Array, dof: int, quantile: float = QUANTILE) -> tuple[float, float]:
    """Limit of the tail of true loops, and noise scale of their bulk.

    Parameters
    ----------
    D2 : (l,)
        Of accepted loops, possibly with false ones.
    dof : int
        Degrees of freedom of one loop.
    quantile : float
        Lower bound of the limit: this quantile of χ², in the scale of the bulk.

    Returns
    -------
    limit : float
        Point of the tail ``P(D² > x) ~ x^(-1/ξ)`` with half a loop expected beyond it. ξ is Hill's estimate from the
        largest twentieth of the loops within the limit, so loops beyond a gap in the tail do not affect it.
    scale : float
        Median D² over that of χ².
    """
    x = np.sort(D2[np.isfinite(D2) & (D2 >= 0.0)])
    if not len(x):
        return float("inf"), 1.0
    scale = max(float(np.median(x)) / chi2_quantile(0.5, dof), np.finfo(float).tiny)
    least = limit = scale * chi2_quantile(quantile, dof)
    for _ in range(FOLLOWED):
        n = int(np.searchsorted(x, limit, side="right"))
        k = max(int(TAIL * n), 1)
        if n <= k:
            break
        begin = x[n - k - 1]
        if not begin > 0.0:
            break
        index = (float(np.log(x[n - k : n] / begin).sum()) + PRIOR * INDEX) / (k + PRIOR)
        fresh = max(least, begin * (k / BEYOND) ** index)
        if fresh <= limit * (1.0 + 1e-6) or np.searchsorted(x, fresh, side="right") == n:
            limit = max(fresh, limit)
            break
        limit = fresh
    return limit, scale


def groups_of(ends: npt.ArrayLike) -> Ints:
    """Group index of every loop ``(l,)``: connected neighbours, by the nodes of the loops ``(l, 2)``."""
    e = np.sort(np.asarray(ends, dtype=np.float64).reshape(-1, 2), axis=1)
    if not len(e):
        return np.zeros(0, dtype=np.int64)
    pairs = cKDTree(e).query_pairs(NEAR, p=1, output_type="ndarray")
    links = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(e), len(e)))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def loop_evidence(
    flat: FactorArrays, inliers: Mask, rows: npt.ArrayLike, values: Values, *, accepted: bool
) -> tuple[Array, Array, Ints]:
    """``D²`` of loops and of their groups against the posterior of the accepted measurements without themselves.

    Parameters
    ----------
    flat : FactorArrays
        Edges first.
    inliers : (m + k,) bool
        Accepted measurements.
    rows : (l,) int
        Edges, all accepted or all rejected.
    values : Values
        Minimum of the objective of the accepted measurements.
    accepted : bool
        Whether ``rows`` are among the inliers.

    Returns
    -------
    single : (l,)
    group : (l,)
        Of the group's common motion; that of the loop if it is alone or its group is too large.
    label : (l,) int64
        Group index.
    """
    at = np.asarray(rows, dtype=np.intp)
    edges = flat.batches[0]
    assert isinstance(edges, BetweenBatch)
    d, layout = flat.layout.pose_dof, flat.layout
    label = groups_of(edges.ends[at])
    order = np.argsort(label, kind="stable")
    H = sp.csc_matrix(flat.evaluate(values, dense=False, weights=inliers.astype(np.float64)).A)
    H.eliminate_zeros()  # rejected loops would fill the factor
    lu = factorise_sparse(H)
    ordered = BetweenBatch.of_arrays(
        edges.ends[at[order]], edges.measured[at[order]], edges.whiteners[at[order]], layout
    )
    whole, J = ordered.whitened(values)
    columns = np.broadcast_to(ordered.columns.reshape(len(at), 1, 2 * d), J.shape)
    row = np.broadcast_to(np.arange(len(at) * d).reshape(-1, d, 1), J.shape)
    free = columns >= 0
    A = sp.csr_matrix((J[free], (row[free], columns[free])), shape=(len(at) * d, layout.size))
    r = whole.ravel()
    G = _common_motion(ordered, J, values.poses)
    single, group = np.empty(len(at)), np.empty(len(at))
    sign = -1.0 if accepted else 1.0
    for first, last in _chunks(label[order], max(COLUMNS // d, 1)):
        part = A[first * d : last * d]
        S = np.eye((last - first) * d) + sign * np.asarray(part @ lu.solve(part.T.toarray()))
        e = r[first * d : last * d]
        n = last - first
        own = S.reshape(n, d, n, d)[np.arange(n), :, np.arange(n)] + HELD * np.eye(d)
        x = e.reshape(n, d)
        single[first:last] = np.einsum("ki,ki->k", x, np.linalg.solve(own, x[..., None])[..., 0])
        names = label[order][first:last]
        starts = np.flatnonzero(np.diff(names, prepend=-1))
        for a, b in zip(starts, [*starts[1:], n], strict=True):
            if b - a == 1 or b - a > LARGEST:
                group[first + a : first + b] = single[first + a : first + b]
                continue
            W: Array = S[a * d : b * d, a * d : b * d]
            g = G[(first + a) * d : (first + b) * d]
            own_r = e[a * d : b * d]
            if not accepted:
                W = np.asarray(np.linalg.inv(W))
                own_r = W @ own_r
            u = g.T @ own_r
            M = g.T @ W @ g
            unit = np.sqrt(np.maximum(np.diag(g.T @ g), np.finfo(float).tiny))
            M = M / np.outer(unit, unit) + HELD * np.eye(d)
            group[first + a : first + b] = (u / unit) @ np.linalg.solve(M, u / unit)
    back = np.argsort(order, kind="stable")
    return single[back], group[back], label


def _common_motion(loops: BetweenBatch, J: Array, poses: Array) -> Array:
    """Whitened derivative ``(l d, d)`` of the loops' residuals with respect to a motion of all later ends, a left
    tangent about the mean of their positions (better conditioned than about the origin)."""
    g, ends = group_of(poses), loops.ends
    # always move the later end, also for loops with reversed direction
    moved = poses[np.max(ends, axis=1)].copy()
    moved[:, : g.dim] -= moved[:, : g.dim].mean(axis=0) if len(moved) else 0.0
    blocks = np.where((ends[:, 0] > ends[:, 1])[:, None, None], J[:, :, : g.dof], J[:, :, g.dof :])
    return np.asarray((blocks @ g.adjoint(g.inverse(moved))).reshape(len(ends) * g.dof, g.dof))


def _chunks(label: Ints, most: int) -> list[tuple[int, int]]:
    """Chunks of a sorted label array that do not split groups of at most ``LARGEST``."""
    starts = np.flatnonzero(np.diff(label, prepend=-1))
    ends = np.append(starts[1:], len(label))
    out: list[tuple[int, int]] = []
    begin = 0
    for a, b in zip(starts.tolist(), ends.tolist(), strict=True):
        if b - begin <= most:
            continue
        if a > begin:
            out.append((begin, a))
            begin = a
        if b - a > LARGEST:
            while b - begin > most:
                out.append((begin, begin + most))
                begin += most
    if begin < len(label):
        out.append((begin, len(label)))
    return out


def leave_one_out_test(
    network: PoseNetwork,
    flat: FactorArrays,
    values: Values,
    inliers: Mask,
    limit: Array,
    *,
    probability: float = QUANTILE,
    own_tail: bool = True,
) -> RobustResult:
    """Rounds of accepting and rejecting by ``D²`` until nothing changes.

    Parameters
    ----------
    flat : FactorArrays
        All measurements of the network.
    values : Values
        Near a minimum of the inliers' objective.
    inliers : (m + k,) bool
        Current inliers.
    limit : (m + k,)
        Cost limits; infinite for trusted edges.
    probability : float
        Probability of keeping a true loop (:func:`family_quantile`) with the noise of the file; upper bound of the
        limit.
    own_tail : bool
        The limit of edges is estimated (:func:`tail_limit`); otherwise it is ``limit``.
    """
    m, d = len(network.edges), network.tangent_dim
    w = np.linalg.eigvalsh(network.information)
    judged = ~np.isinf(limit[:m]) & (w[:, 0] > 1e-12 * w[:, -1]) & ~network.position_priors
    limit, scale, rounds = limit.copy(), 0.0, 0
    dull = chi2_quantile(DULL, d)
    seen: set[bytes] = set()
    back = False
    single, worst = np.full(m, np.nan), np.full(m, np.nan)
    for rounds in range(1, ROUNDS + 1):
        problem = weighted_problem(network, inliers)
        end = descend_to_minimum(problem, values, max_iterations=STEPS)
        values = here = end.values
        if back:
            break
        seen.add(inliers.tobytes())
        fresh = inliers.copy()
        every = flat.squared(here)
        fresh[m:] = every[m:] <= limit[m:]
        inside = np.flatnonzero(judged & inliers[:m])
        asked = inside[~(worst[inside] <= scale * dull)]
        if len(asked):
            single[asked], group, _ = loop_evidence(flat, inliers, asked, here, accepted=True)
            worst[asked] = np.maximum(single[asked], group)
        if len(inside):
            quantile = family_quantile(probability, len(inside))
            most, scale = tail_limit(single[inside], d, quantile)
            if own_tail:
                stated = chi2_quantile(quantile, d)
                most = min(most, stated) if len(inside) >= FEW else stated
                limit[:m] = np.where(np.isinf(limit[:m]) | network.position_priors, limit[:m], most)
            bad = worst[inside] > np.maximum(limit[inside], WORST * worst[inside].max())
            fresh[inside[bad]] = False
            worst[inside[bad]] = np.nan
        costs = every[:m]
        partial = ~judged & np.isfinite(limit[:m])
        fresh[:m][partial] = costs[partial] <= limit[:m][partial]
        outside = np.flatnonzero(judged & ~inliers[:m])
        outside = outside[np.argsort(costs[outside], kind="stable")]
        against = np.full(m, np.inf)
        for first, last in ((0, TESTED), (TESTED, len(outside))):
            # expensive ones only if nothing else changes: parts without accepted loops can be far off
            some = outside[first:last]
            if len(some) and (first == 0 or (fresh == inliers).all()):
                against[some] = loop_evidence(flat, inliers, some, here, accepted=False)[0]
        # groups are formed from possible inliers only: false loops can be near true ones
        good = outside[against[outside] <= limit[outside]]
        if len(good):
            alone, group, _ = loop_evidence(flat, inliers, good, here, accepted=False)
            fresh[good[np.maximum(alone, group) <= limit[good]]] = True
        fresh = keep_datum(network, fresh)
        if (fresh == inliers).all() or rounds == ROUNDS:
            break
        back = fresh.tobytes() in seen
        inliers = fresh
    return RobustResult(inliers, problem, end, limit, scale=scale, rounds=rounds)
