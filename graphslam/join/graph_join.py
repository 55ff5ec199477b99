"""All methods for a graph of submaps: information filters by tree or in sequence, EKF, batch, iSAM2.

All use all factors of the graph, so their maps differ only by linearisation (:mod:`graphslam.join.graph_problem`
defines when a factor is added).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from graphslam.core.errors import DataError, IndeterminateError
from graphslam.core.geometry import Array
from graphslam.core.markup import html_element, join_parts
from graphslam.core.poses import group_of
from graphslam.core.progress import Bar
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.variables import Values
from graphslam.join.frames import lever_matrix, rotation_of
from graphslam.join.gaussian_map import GaussianMap, add_maps, join_gaussian_maps
from graphslam.join.graph_problem import Index, JoinProblem
from graphslam.linear.symmetric_factor import SymmetricFactor
from graphslam.solve.batch import LevenbergConfig, optimise_problem
from graphslam.solve.sparse import SparseProblem

POLISH = LevenbergConfig(max_iterations=200, tolerance=1e-12)
MOST_STATES = 8000
"""Most states for the dense filter: its covariance then takes half a gigabyte."""


@dataclass(frozen=True, eq=False)
class GraphEstimate:
    """Result of one method: values of all variables and their joint information.

    The state vector holds the free columns of the graph in their order
    (:class:`~graphslam.graph.variables.VariableLayout`): right tangents of poses, then landmarks, then the rest.

    Parameters
    ----------
    problem : JoinProblem
    values : Values
        In the frame of the first base.
    information : (n, n) csc_matrix or None
        None if the method has a dense covariance instead (the EKF).
    covariance : (n, n) or None
        Exactly one of the two is given.
    objective : float
        ``Σ rᵀ Λ r`` (``2 ρ`` for robust kernels) of this map, before a relinearisation.
    objective_polished : float or None
        The same at the least-squares optimum, if computed.
    converged : bool
        Whether the map is at its least-squares optimum.
    seconds : float
        Wall time, relinearisation included.
    """

    problem: JoinProblem
    values: Values
    information: sp.csc_matrix | None
    objective: float
    method: str
    seconds: float
    covariance: Array | None = None
    objective_polished: float | None = None
    iterations: int = 0
    converged: bool = False
    times: Mapping[str, float] = field(default_factory=dict)

    @property
    def poses(self) -> Array:
        """Nodes ``(n, 3|7)`` in the frame of the first, which is fixed."""
        return self.values.poses

    @property
    def exits(self) -> Index:
        """Row of :attr:`poses` at the end of each submap ``(m,)``."""
        return self.problem.bases[1:]

    @property
    def landmark_ids(self) -> Index:
        """``(L,)``."""
        return self.values.landmark_ids

    @property
    def landmarks(self) -> Array:
        """``(L, dim)``."""
        return self.values.landmarks

    @property
    def states(self) -> int:
        """Free scalars."""
        return self.problem.states

    @property
    def nnz(self) -> int:
        """Stored entries of the information or covariance matrix, both triangles."""
        return self.states**2 if self.information is None else int(self.information.nnz)

    @cached_property
    def _factor(self) -> SymmetricFactor:
        assert self.information is not None
        return SymmetricFactor(self.information)

    def covariance_block(self, indices: npt.ArrayLike) -> Array:
        """Joint covariance of the scalars ``indices`` of the state vector."""
        at = np.asarray(indices)
        return self.covariance[np.ix_(at, at)] if self.covariance is not None else self._factor.inverse_block(at)

    def anchored_errors(self, rows: Index, true: Array, known: Mapping[int, Array]) -> Array:
        """Errors ``(n, dim)`` of landmarks ``rows`` in the parametrisation of the maps.

        A landmark is expressed in the frame of its anchor, ``m = X_a⁻¹ l``, and its error is ``δl = R (δm + D ξ_a)``,
        as in :mod:`graphslam.join.gaussian_map`.

        Parameters
        ----------
        true : (n, dim)
            True positions.
        known : mapping of int to (3|7,)
            True poses of nodes; a landmark without a true anchor pose gets its plain position error.
        """
        g, error = group_of(self.poses), true - self.landmarks[rows]
        for k, anchor in enumerate(self.problem.landmark_anchors[rows].tolist()):
            if anchor not in known:
                continue
            here, there = self.poses[anchor], known[anchor]
            m = g.transform(g.inverse(here), self.landmarks[rows[k]])
            moved = g.transform(g.inverse(there), true[k]) - m
            turn = lever_matrix(g, m[None])[0] @ g.log(g.between(here, there))
            error[k] = rotation_of(g, here) @ (moved + turn)
        return error

    def map_information(self) -> sp.csc_matrix | None:
        """Information of poses and landmarks; all other variables are marginalised out."""
        if self.information is None:
            return None
        layout = self.problem.graph.flat().layout
        k = layout.stop("l")
        A = self.information
        if k == layout.size:
            return A
        B = sp.csc_matrix(A[:k, k:])
        touched = np.flatnonzero(np.diff(sp.csr_matrix(B).indptr))
        dense = B[touched].toarray()
        update = dense @ SymmetricFactor(sp.csc_matrix(A[k:, k:])).solve(dense.T)
        rows, columns = np.meshgrid(touched, touched, indexing="ij")
        fill = sp.csc_matrix((update.ravel(), (rows.ravel(), columns.ravel())), shape=(k, k))
        return sp.csc_matrix(A[:k, :k] - fill)

    def map_covariance(self) -> Array | None:
        """Covariance of poses and landmarks, for methods in covariance form."""
        k = self.problem.graph.flat().layout.stop("l")
        return None if self.covariance is None else self.covariance[:k, :k]

    def pose_covariance(self, node: int) -> Array:
        """Covariance ``(d, d)`` of a node in its right tangent."""
        return self.covariance_block(self.problem.graph.flat().layout.columns(f"x{node}"))

    def landmark_covariance(self, landmark_id: int) -> Array:
        """Covariance ``(dim, dim)`` of a landmark."""
        return self.covariance_block(self.problem.graph.flat().layout.columns(f"l{landmark_id}"))

    def _repr_html_(self) -> str:
        polished = "" if self.objective_polished is None else f", at the optimum {self.objective_polished:.4f}"
        text = (
            f" by {self.method}: {len(self.poses)} nodes, {len(self.landmark_ids)} landmarks, {self.states} scalars, "
            f"objective {self.objective:.4f}{polished}, {self.seconds:.3f} s"
        )
        return join_parts([html_element("b", "Joined map"), text])


def _estimate(
    problem: JoinProblem,
    values: Values,
    method: str,
    seconds: float,
    *,
    information: sp.csc_matrix | None = None,
    covariance: Array | None = None,
    iterations: int = 0,
) -> GraphEstimate:
    objective = problem.objective(values)
    return GraphEstimate(
        problem, values, information, objective, method, seconds, covariance=covariance, iterations=iterations
    )


# ---------------------------------------------------------------- information filters


class JoinSchedule:
    """When each factor is added: inside one submap, or when two submaps are joined."""

    def __init__(self, problem: JoinProblem) -> None:
        low, high = problem.spans
        self.low, self.high = low, high
        m = len(problem.keys)
        inside = np.flatnonzero(low == high)
        self.inside = _by_step(inside, high[inside], m)
        self.across = np.flatnonzero(low < high)
        self.at_last = _by_step(self.across, high[self.across], m)


def _by_step(factors: Index, step: Index, m: int) -> list[Index]:
    order = np.argsort(step, kind="stable")
    return np.split(factors[order], np.searchsorted(step[order], np.arange(1, m)))


def _finished(joined: GaussianMap) -> GaussianMap:
    """The result of the last join; all waiting factors are added."""
    return joined.updated(np.zeros(0, dtype=np.int64), force=True)


def _of_root(problem: JoinProblem, root: GaussianMap, method: str, start: float) -> GraphEstimate:
    d, seconds = problem.group.dof, time.perf_counter() - start
    C, A = root.anchor_matrix(inverse=True), root.information
    A = A if C is None else C.T @ A @ C
    return _estimate(problem, root.values, method, seconds, information=sp.csc_matrix(A[d:, d:]))


def join_graph_sequential(problem: JoinProblem, *, passes: int | None = None, progress: bool = False) -> GraphEstimate:
    """Extended information filter, submap by submap (Combined SLAM eq. 13-16).

    Parameters
    ----------
    passes : int, optional
        Number of linearisations per join (:func:`~graphslam.join.gaussian_map.join_gaussian_maps`).
    progress : bool
        Show a progress bar.
    """
    start, plan = time.perf_counter(), JoinSchedule(problem)
    joined = GaussianMap.leaf(problem, 0, plan.inside[0])
    for k in Bar(range(1, len(problem.keys)), name="join", unit="submap", shown=progress):
        joined = join_gaussian_maps(
            joined, GaussianMap.leaf(problem, k, plan.inside[k]), plan.at_last[k], passes=passes
        )
    return _of_root(problem, _finished(joined), "eif-sequential", start)


def join_graph_tree(problem: JoinProblem, *, passes: int | None = None, progress: bool = False) -> GraphEstimate:
    """Extended information filter by binary tree: submaps are joined pairwise, then the pairs, and so on.

    Parameters
    ----------
    problem, passes, progress
        As in :func:`join_graph_sequential`.
    """
    start, plan = time.perf_counter(), JoinSchedule(problem)
    with Bar(total=len(problem.keys) - 1, name="join", unit="join", shown=progress) as bar:

        def joined(a: int, b: int, factors: Index) -> GaussianMap:
            """Submaps a … b - 1, with the factors between them."""
            if b == a + 1:
                return GaussianMap.leaf(problem, a, plan.inside[a])
            middle = a + (1 << (b - a - 1).bit_length() - 1)
            left, right = plan.high[factors] < middle, plan.low[factors] >= middle
            A, B = joined(a, middle, factors[left]), joined(middle, b, factors[right])
            bar.update()
            return join_gaussian_maps(A, B, factors[~left & ~right], passes=passes)

        root = joined(0, len(problem.keys), plan.across)
    return _of_root(problem, _finished(root), "eif-tree", start)


# ---------------------------------------------------------------- the dense filter


def join_graph_ekf(problem: JoinProblem, *, progress: bool = False) -> GraphEstimate:
    """Extended Kalman filter, submap by submap, in covariance form; the counterpart of :func:`join_graph_sequential`.

    A submap and its factors measure old and new variables. Their marginal on the old ones is a measurement update; the
    new ones are then appended with their correlations.
    """
    if problem.states > MOST_STATES:
        raise DataError("the dense filter has no room for so many states", got=problem.states, wanted=MOST_STATES)
    start, plan, d = time.perf_counter(), JoinSchedule(problem), problem.group.dof
    size, m = int(problem.first[-1]), len(problem.keys)
    P = np.zeros((size, size))
    state: GaussianMap | None = None
    for k in Bar(range(m), name="join", unit="submap", shown=progress):
        leaf = GaussianMap.leaf(problem, k, plan.inside[k])
        old = np.arange(d) if state is None else state.columns
        joined = leaf if state is None else add_maps(state, leaf)[0]
        joined, enter = joined.admitted(plan.at_last[k], force=k == m - 1)
        S, G = joined.information, joined.gradient
        if len(enter):
            A, b = joined.measured(enter)
            S, G = sp.csc_matrix(S + A), G + b
        columns = joined.columns
        step = _update_covariance(P, S, G, columns, old, d)
        inverse = joined.tangents(step, inverse=True)
        if inverse is not None:
            P[np.ix_(columns, columns)] = inverse @ (inverse @ P[np.ix_(columns, columns)]).T
        n = len(columns)
        nothing = sp.csc_matrix((n, n))
        state = replace(joined, values=joined.moved_by(step), information=nothing, gradient=np.zeros(n))
    assert state is not None
    if len(state.variables) < len(problem.names):
        lost = [n for k, n in enumerate(problem.names) if k not in set(state.variables.tolist())]
        raise IndeterminateError(f"no factor is on {', '.join(lost[:5])}")
    C = state.anchor_matrix()
    if C is not None:
        P = C @ (C @ P).T
    return _estimate(problem, state.values, "ekf", time.perf_counter() - start, covariance=P[d:, d:].copy())


def _update_covariance(P: Array, S: sp.csc_matrix, G: Array, columns: Index, old: Index, d: int) -> Array:
    """One filter step, in place; returns the step ``(k,)`` of ``columns``.

    Parameters
    ----------
    P : (n, n)
        Covariance of all columns; those of new variables are zero.
    S, G
        Information and gradient of the current measurements, over ``columns``.
    old : (o,)
        Columns that had values before; the first ``d`` are those of the first base, which is fixed.
    """
    touched = np.asarray(np.abs(S).sum(axis=0)).ravel() > 0
    is_old = np.isin(columns, old)
    o = np.flatnonzero(touched & is_old & (columns >= d))
    v = np.flatnonzero(~is_old)
    A, K, new = S[:, o][o].toarray(), S[:, o][v].toarray(), S[:, v][v].toarray()
    try:
        factor = la.cho_factor(new, lower=True) if len(v) else None
    except la.LinAlgError:
        raise IndeterminateError("new variables of the filter are not determined") from None
    solved = la.cho_solve(factor, np.column_stack([K, G[v]])) if factor is not None else np.zeros((0, len(o) + 1))
    gain, shift = solved[:, :-1], solved[:, -1]
    A = A - K.T @ gain
    g = G[o] - K.T @ shift
    step = np.zeros(len(columns))
    oc, all_old = columns[o], old[old >= d]
    if len(o):
        value, vector = la.eigh(0.5 * (A + A.T))
        keep = value > 1e-13 * max(value[-1], 1e-300)
        root = vector[:, keep] * np.sqrt(value[keep])
        cross = P[np.ix_(all_old, oc)]
        M = np.eye(root.shape[1]) + root.T @ P[np.ix_(oc, oc)] @ root
        W = la.solve_triangular(la.cholesky(M, lower=True), (cross @ root).T, lower=True)
        P[np.ix_(all_old, all_old)] -= W.T @ W
        moved = -P[np.ix_(all_old, oc)] @ g
        step[np.searchsorted(columns, all_old)] = moved
    if factor is not None:
        step[v] = -shift - gain @ step[o]
        vc = columns[v]
        cross = -gain @ P[np.ix_(oc, all_old)]
        P[np.ix_(vc, all_old)] = cross
        P[np.ix_(all_old, vc)] = cross.T
        P[np.ix_(vc, vc)] = la.cho_solve(factor, np.eye(len(v))) + gain @ P[np.ix_(oc, oc)] @ gain.T
    return step


# ---------------------------------------------------------------- solvers


def _start_values(problem: JoinProblem) -> Values:
    """Initial values from the chain of submaps: nodes end to end, landmarks at their first observation."""
    plan = JoinSchedule(problem)
    values = problem.graph.structure.copy()
    known = np.zeros(len(problem.names), dtype=bool)
    for k in range(len(problem.keys)):
        _place_submap(problem, values, known, k, plan.inside[k])
    problem.admit(values, known, np.arange(len(problem.factors)), force=True)
    return values


def _place_submap(problem: JoinProblem, values: Values, known: npt.NDArray[np.bool_], k: int, factors: Index) -> None:
    """Write the new variables of submap k, whose base has a value, into ``values``."""
    base = values["x"][problem.bases[k]].copy()
    own = GaussianMap.start(problem, k, factors).moved(base)
    for word in problem.words:
        a, b = problem.range_of[word]
        rows = own.variables[(own.variables >= a) & (own.variables < b)] - a
        rows = rows[~known[a:b][rows]]
        values[word][rows] = own.values[word][rows]
    known[own.variables] = True


def optimise_estimate(problem: JoinProblem, joined: GraphEstimate) -> GraphEstimate:
    """Relinearise all factors, starting at the joined map, until the objective is at its minimum.

    Returns
    -------
    GraphEstimate
        Values and information of the optimum; ``objective`` stays that of the joined map.
    """
    start = time.perf_counter()
    flat = problem.graph.flat()
    best = optimise_problem(SparseProblem(flat), joined.values, POLISH)
    system = flat.evaluate(best.values, dense=False)
    return replace(
        joined, values=best.values, information=sp.csc_matrix(system.A), covariance=None,
        objective_polished=best.objective + problem.offset, iterations=best.iterations, converged=best.converged,
        seconds=joined.seconds + time.perf_counter() - start,
    )  # fmt: skip


def solve_graph_batch(problem: JoinProblem, *, polish: bool = True, progress: bool = False) -> GraphEstimate:
    """Least squares over all factors, starting from the chain; always at the optimum, whatever ``polish`` is."""
    start = time.perf_counter()
    begun = _estimate(problem, _start_values(problem), "batch", 0.0)
    begun = replace(begun, seconds=time.perf_counter() - start)
    best = optimise_estimate(problem, begun)
    assert best.objective_polished is not None
    return replace(best, objective=best.objective_polished)


def solve_graph_isam2(problem: JoinProblem, *, polish: bool = True, progress: bool = False) -> GraphEstimate:
    """Add the submaps with their factors one by one, update iSAM2 after each, then solve to the optimum.

    Returns
    -------
    GraphEstimate
        ``objective`` is that of iSAM2 before this last step; ``iterations`` are its updates.
    """
    from graphslam.solve.isam2 import Isam2Solver

    start, plan = time.perf_counter(), JoinSchedule(problem)
    graph = FactorGraph.with_values(problem.graph.values.copy())
    solver = Isam2Solver(graph)
    known = np.zeros(len(problem.names), dtype=bool)
    waiting = np.zeros(0, dtype=np.int64)
    m = len(problem.keys)
    for k in Bar(range(m), name="iSAM2", unit="submap", shown=progress):
        values = graph.values
        _place_submap(problem, values, known, k, plan.inside[k])
        enter, waiting = problem.admit(
            values, known, np.concatenate([waiting, plan.inside[k], plan.at_last[k]]), force=k == m - 1
        )
        for f in enter.tolist():
            graph.insert(problem.factors[f])
        solver.update()
    values = graph.values
    system = problem.graph.flat().evaluate(values, dense=False)
    found = _estimate(
        problem, values, "isam2", time.perf_counter() - start, information=sp.csc_matrix(system.A),
        iterations=solver.updates,
    )  # fmt: skip
    return optimise_estimate(problem, found) if polish else found


GRAPH_JOINERS: dict[str, Callable[..., GraphEstimate]] = {
    "eif-tree": join_graph_tree,
    "eif-sequential": join_graph_sequential,
    "ekf": join_graph_ekf,
}

GRAPH_SOLVERS: dict[str, Callable[..., GraphEstimate]] = {"batch": solve_graph_batch, "isam2": solve_graph_isam2}
