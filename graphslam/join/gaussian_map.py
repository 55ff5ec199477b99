"""Gaussian maps over the variables of a graph, in information form, joined by adding their matrices.

A pose is perturbed on the right, ``X Exp(ξ)``, and a landmark in the frame of its *anchor*, the end ``X_a`` of the
submap that observed it first: ``l = X_a m``, ``m + δ``. A heading error then rotates a submap with its landmarks. A
factor between poses and landmarks is linear in relative quantities, so the matrix of a map is the same in every frame.
Therefore the base of a map is *in* its matrix, which is singular because of the gauge.

To join B, whose base is the end of A, B is transformed to the frame of A, and the two matrices are added. The factors
between both enter by a Gauss-Newton step with the base fixed,

    ξ = -(I + Jᵀ J)⁻¹ (g + Jᵀ r),   X ← X ⊕ ξ,   I ← Tᵀ (I + Jᵀ J) T,   T = blkdiag(J_r⁻¹(ξ_i)).

The gradient g is stored, too: it is zero except in maps with constants whose prior is in another map. Nothing is
marginalised out, so the matrix is exactly sparse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.graph.variables import KINDS, Values, VariableKind, split_name
from graphslam.join.frames import lever_matrix, rotation_of, rows_in_frame, rule_of
from graphslam.join.graph_problem import Index, JoinProblem
from graphslam.linear.symmetric_factor import SymmetricFactor

DENSE = 200
"""Scalars up to which a dense Cholesky factorisation is faster than a sparse one (measured)."""
LARGEST_NAMED = 3000
"""Scalars of a singular map up to which its undetermined variables are searched."""
PASSES = 3
"""Most linearisations in a join of maps with common variables …"""
_STEP = 1e-6
"""… which also ends when a step is below a thousandth of a standard deviation, on average over the map."""
ANCHORED = ("l", "point")
"""Variable types that are expressed in the frame of the end of the submap that observed them first."""


@dataclass(frozen=True, eq=False)
class GaussianMap:
    """A map of submaps ``first … stop - 1`` in the frame of the base of the first.

    Parameters
    ----------
    values : Values
        Of all variables of the graph; only those of the map are valid.
    variables : (v,)
        Numbers of the variables of the map, ascending, including its base.
    anchors : (v,)
        Anchor node of each variable; -1: none, it is perturbed directly.
    information : (n, n) csc_matrix
        Over the columns of ``variables``.
    gradient : (n,)
        Half the gradient of the map's objective at ``values``.
    waiting : (w,)
        Factors of these submaps that cannot be linearised yet.
    """

    problem: JoinProblem
    first: int
    stop: int
    values: Values
    variables: Index
    anchors: Index
    information: sp.csc_matrix
    gradient: Array
    waiting: Index

    @classmethod
    def start(cls, problem: JoinProblem, k: int, factors: Index) -> GaussianMap:
        """The start values of submap k, without information."""
        values = problem.graph.structure.copy()
        variables = problem.submap_values(k, factors, values)
        anchors = np.full(len(variables), -1, dtype=np.int64)
        for word in ANCHORED:
            a, b = problem.range_of[word]
            anchors[(variables >= a) & (variables < b)] = problem.bases[k + 1]
        n = int(problem.width[variables].sum())
        none = np.zeros(0, dtype=np.int64)
        return cls(problem, k, k + 1, values, variables, anchors, sp.csc_matrix((n, n)), np.zeros(n), none)

    @classmethod
    def leaf(cls, problem: JoinProblem, k: int, factors: Index) -> GaussianMap:
        """Submap k with all its internal factors, near its optimum if there are several."""
        return cls.start(problem, k, factors).updated(factors, passes=PASSES)

    @property
    def base(self) -> int:
        """Variable of the base, which is fixed."""
        return int(self.problem.bases[self.first])

    @property
    def end(self) -> Array:
        """End pose ``(3|7,)`` of the map in the frame of its base."""
        return self.values["x"][self.problem.bases[self.stop]].copy()

    @property
    def columns(self) -> Index:
        """Columns of the map's variables in the graph."""
        return self.problem.columns(self.variables)

    @property
    def free(self) -> npt.NDArray[np.bool_]:
        """Mask of the columns that move: not the base, not constants without prior information."""
        problem, known = self.problem, self.problem.constant_priors
        held = [
            v == self.base or (v in self.without_prior and split_name(problem.names[v])[0].word not in known)
            for v in self.variables.tolist()
        ]
        return np.repeat(~np.array(held), problem.width[self.variables])

    @cached_property
    def without_prior(self) -> frozenset[int]:
        """Small constants whose prior is in another map."""
        problem = self.problem
        if self.first == 0:
            return frozenset()
        constants = [v for v in self.variables.tolist() if problem.rules[v] == "constant"]
        return frozenset(v for v in constants if not problem.has_prior(v, self.first, self.stop))

    def _guided(self, H: sp.csc_matrix, g: Array) -> tuple[sp.csc_matrix, Array]:
        """Information and gradient with priors of constants that have theirs in another map; for a step only."""
        problem, blocks, slope = self.problem, [], g.copy()
        for word, _, places, rows, columns in self.kinds():
            prior = problem.constant_priors.get(word)
            if prior is None:
                continue
            mine = np.isin(self.variables[places], list(self.without_prior))
            if np.any(mine):
                c = columns[mine]
                blocks.append(self._entries(c, c, np.broadcast_to(prior, (len(c), *prior.shape))))
                slope[c] += self.values[word][rows[mine]] @ prior.T
        return (sp.csc_matrix(H + sum(blocks)), slope) if blocks else (H, g)

    @property
    def _at(self) -> Index:
        """First local column of each variable."""
        width = self.problem.width[self.variables]
        return np.cumsum(width) - width

    def kinds(self) -> Iterator[tuple[str, VariableKind, Index, Index, Index]]:
        """Name, type, indices in :attr:`variables`, rows of values, local columns ``(n, dof)`` by variable type."""
        at, dim = self._at, self.problem.dim
        for word in self.problem.words:
            a, b = self.problem.range_of[word]
            places = np.flatnonzero((self.variables >= a) & (self.variables < b))
            if len(places):
                kind = KINDS[word]
                yield word, kind, places, self.variables[places] - a, at[places, None] + np.arange(kind.dof(dim))

    # ---------------------------------------------------------------- values

    def moved_by(self, step: Array) -> Values:
        """Values after a step ``(n,)``."""
        g, old, new = self.problem.group, self.values, self.values.copy()
        for word, kind, places, rows, columns in self.kinds():
            part, group = step[columns], kind.pose_group(self.problem.dim)
            if group is not None:
                new[word][rows] = group.compose(old[word][rows], group.exp(part))
                continue
            anchor = self.anchors[places]
            free, anchored = anchor < 0, anchor >= 0
            new[word][rows[free]] = old[word][rows[free]] + part[free]
            if np.any(anchored):
                m = g.transform(g.inverse(old["x"][anchor[anchored]]), old[word][rows[anchored]]) + part[anchored]
                new[word][rows[anchored]] = g.transform(new["x"][anchor[anchored]], m)
        return new

    def step_to(self, values: Values) -> Array:
        """The step ``(n,)`` from the values here to others."""
        g, step = self.problem.group, np.zeros(len(self.gradient))
        for word, kind, places, rows, columns in self.kinds():
            x, y, group = self.values[word][rows], values[word][rows], kind.pose_group(self.problem.dim)
            if group is not None:
                step[columns] = group.log(group.between(x, y))
                continue
            part, anchor = y - x, self.anchors[places]
            anchored = anchor >= 0
            if np.any(anchored):
                before = g.transform(g.inverse(self.values["x"][anchor[anchored]]), x[anchored])
                part[anchored] = g.transform(g.inverse(values["x"][anchor[anchored]]), y[anchored]) - before
            step[columns] = wrap_angle(part) if word == "compass" else part
        return step

    def tangents(self, step: Array, *, inverse: bool = False) -> sp.csc_matrix | None:
        """``T``, the derivative of the total step by a small additional step, or its inverse; None: identity."""
        blocks: list[tuple[Index, Array]] = []
        for _, kind, _, _, columns in self.kinds():
            g = kind.pose_group(self.problem.dim)
            if g is not None and np.any(step[columns]):
                J = g.right_jacobian(step[columns])
                blocks.append((columns, np.asarray(J if inverse else np.linalg.inv(J), dtype=np.float64)))
        return self._identity_but(blocks) if blocks else None

    def _identity_but(self, blocks: list[tuple[Index, Array]], more: sp.csc_matrix | None = None) -> sp.csc_matrix:
        """The identity with given diagonal blocks ``(n, d, d)`` at columns ``(n, d)``, plus the entries ``more``."""
        n = len(self.gradient)
        diagonal = np.ones(n)
        rows, columns, data = [], [], []
        for at, B in blocks:
            diagonal[at] = 0.0
            rows.append(np.repeat(at, at.shape[1], axis=1).ravel())
            columns.append(np.tile(at, (1, at.shape[1])).ravel())
            data.append(B.ravel())
        everywhere = np.arange(n)
        places = np.concatenate([everywhere, *rows]), np.concatenate([everywhere, *columns])
        T = sp.csc_matrix((np.concatenate([diagonal, *data]), places), shape=(n, n))
        return T if more is None else sp.csc_matrix(T + more)

    # ---------------------------------------------------------------- frames

    def moved(self, T: Array) -> GaussianMap:
        """The map in another frame, in which its base is ``T``."""
        problem, values = self.problem, self.values.copy()
        blocks: list[tuple[Index, Array]] = []
        for word, kind, places, rows, columns in self.kinds():
            new, J = rows_in_frame(rule_of(word, problem.dim), problem.group, T, values[word][rows])
            values[word][rows] = new
            free = self.anchors[places] < 0
            if J is not None and np.any(free):
                d = kind.dof(problem.dim)
                blocks.append((columns[free], np.broadcast_to(np.linalg.inv(J), (len(free), d, d))[free]))
        return self._changed(values, self._identity_but(blocks) if blocks else None, None)

    def carried(self, step: Array) -> GaussianMap:
        """The Gaussian relinearised at values a step away: its matrix and gradient there."""
        return self._changed(self.moved_by(step), self.tangents(step), step)

    def _changed(self, values: Values, T: sp.csc_matrix | None, step: Array | None) -> GaussianMap:
        """``Tᵀ I T`` and ``Tᵀ (g + I ξ)`` at other values."""
        information, gradient = self.information, self.gradient
        if step is not None:
            gradient = gradient + information @ step
        if T is not None:
            information, gradient = sp.csc_matrix(T.T @ information @ T), np.asarray(T.T @ gradient)
        return replace(self, values=values, information=information, gradient=gradient)

    def _arms(self, places: Index, rows: Index, word: str) -> tuple[Array, Array]:
        """Rotation ``(n, d, d)`` of anchors, and Jacobian ``(n, d, dof)`` of positions with respect to them.

        The Jacobian is in the frame of the anchor, with lever arm ``m``.
        """
        g, anchor = self.problem.group, self.anchors[places]
        X = self.values["x"][anchor]
        m = g.transform(g.inverse(X), self.values[word][rows])
        R = np.array([rotation_of(g, x) for x in X])
        return R, lever_matrix(g, m)

    def anchor_matrix(self, *, inverse: bool = False) -> sp.csc_matrix | None:
        """Steps of positions from steps in the frames of their anchors, ``δl = R (δm + D ξ_a)``, or the inverse."""
        at, d = self._at, self.problem.group.dof
        blocks, entries = [], []
        for word, _, places, rows, columns in self.kinds():
            anchored = self.anchors[places] >= 0
            if not np.any(anchored):
                continue
            R, D = self._arms(places[anchored], rows[anchored], word)
            pose = at[np.searchsorted(self.variables, self.anchors[places[anchored]])][:, None] + np.arange(d)
            blocks.append((columns[anchored], np.swapaxes(R, 1, 2) if inverse else R))
            entries.append(self._entries(columns[anchored], pose, -D if inverse else R @ D))
        return self._identity_but(blocks, sp.csc_matrix(sum(entries))) if blocks else None

    def _entries(self, rows: Index, columns: Index, blocks: Array) -> sp.csc_matrix:
        """A matrix of blocks ``(n, r, c)`` at rows ``(n, r)`` and columns ``(n, c)``."""
        n = len(self.gradient)
        at = np.repeat(rows, columns.shape[1], axis=1).ravel(), np.tile(columns, (1, rows.shape[1])).ravel()
        return sp.csc_matrix((blocks.ravel(), at), shape=(n, n))

    def anchored_as(self, other: GaussianMap) -> GaussianMap:
        """The Gaussian with the anchors of another map over the same variables, at the values of both."""
        at, d = self._at, self.problem.group.dof
        T = None
        for word, _, places, rows, columns in self.kinds():
            differ = (self.anchors[places] != other.anchors[places]) & (self.anchors[places] >= 0)
            if not np.any(differ):
                continue
            p, r, c = places[differ], rows[differ], columns[differ]
            (R, D), (S, E) = self._arms(p, r, word), other._arms(p, r, word)
            turn = np.swapaxes(R, 1, 2) @ S  # δm = Rᵀ S (δm' + E ξ') - D ξ
            mine, theirs = (
                at[np.searchsorted(self.variables, m.anchors[p])][:, None] + np.arange(d) for m in (self, other)
            )
            T = self._identity_but([(c, turn)], self._entries(c, theirs, turn @ E) - self._entries(c, mine, D))
        return replace(self._changed(self.values, T, None), anchors=other.anchors)

    # ---------------------------------------------------------------- joining

    def measured(self, factors: Index) -> tuple[sp.csc_matrix, Array]:
        """Information and gradient of factors at the current values, over the columns of the map."""
        system = self.problem.arrays(factors).evaluate(self.values, dense=False)
        columns = self.columns
        A, g = sp.csc_matrix(sp.csc_matrix(system.A)[:, columns][columns]), system.g[columns]
        C = self.anchor_matrix()
        return (A, g) if C is None else (sp.csc_matrix(C.T @ A @ C), np.asarray(C.T @ g))

    def admitted(self, factors: Index, *, force: bool = False) -> tuple[GaussianMap, Index]:
        """The map with the new variables of given factors, and the factors that can be linearised now."""
        values = self.values.copy()
        known = np.zeros(len(self.problem.names), dtype=bool)
        known[self.variables] = True
        waiting = np.concatenate([self.waiting, factors])
        enter, later = self.problem.admit(values, known, waiting, base=self.base, force=force)
        return replace(self.widened(np.flatnonzero(known), values), waiting=later), enter

    def updated(self, factors: Index, *, passes: int = 1, force: bool = False) -> GaussianMap:
        """The map after adding factors between its variables, and the waiting ones.

        Parameters
        ----------
        passes : int
            Number of linearisations.
        force : bool
            Last call: no factor may wait.
        """
        begin, enter = self.admitted(factors, force=force)
        return begin.solved(enter, lambda values: self.carried(self.step_to(values)), passes) if len(enter) else begin

    def solved(self, factors: Index, prior: Callable[[Values], GaussianMap], passes: int) -> GaussianMap:
        """Gauss-Newton steps on the map and factors, from the current values.

        Parameters
        ----------
        prior : callable
            The map without the factors, relinearised at given values.
        """
        at, done, free = self, self, self.free
        for k in range(passes):
            if k:
                here = prior(done.values)
                at = replace(here.widened(self.variables, done.values, self.anchors), waiting=self.waiting)
            H, g = at.information, at.gradient
            if len(factors):
                A, b = at.measured(factors)
                H, g = sp.csc_matrix(H + A), g + b
            step, (A, slope) = np.zeros(len(g)), at._guided(H, g)
            step[free] = -self._solve(A, slope, free)
            done = replace(at, information=H, gradient=g).carried(step)
            if -(slope @ step) < _STEP * len(g):
                break
        gradient = np.where(free & (not self.without_prior), 0.0, done.gradient)
        gradient[np.repeat(self.variables == self.base, self.problem.width[self.variables])] = 0.0
        return replace(done, gradient=gradient)

    def _solve(self, H: sp.csc_matrix, g: Array, free: npt.NDArray[np.bool_]) -> Array:
        """``H⁻¹ g`` over the free columns."""
        at = np.flatnonzero(free)
        A = sp.csc_matrix(H[:, at][at])
        try:
            if len(at) > DENSE:
                found = SymmetricFactor(A).solve(g[at])
            else:
                found = np.asarray(la.cho_solve(la.cho_factor(A.toarray(), lower=True), g[at]))
        except (la.LinAlgError, IndeterminateError):
            found = np.full(len(at), np.nan)
        if not np.all(np.isfinite(found)):
            raise self._indeterminate(A, at)
        return found

    def _indeterminate(self, A: sp.csc_matrix, at: Index) -> IndeterminateError:
        """Error with the names of the undetermined variables of a singular matrix, and what would determine them."""
        problem, keys = self.problem, self.problem.keys
        where = f"submaps {keys[self.first]} to {keys[self.stop - 1]}"
        if A.shape[0] > LARGEST_NAMED or not np.all(np.isfinite(A.data)):
            return IndeterminateError(f"the joined map of {where} is not determined")
        size = np.sqrt(np.maximum(A.diagonal(), 1e-300))
        _, vector = la.eigh(A.toarray() / np.outer(size, size), subset_by_index=[0, 0])
        share, owner = np.abs(vector[:, 0] / size), np.repeat(self.variables, problem.width[self.variables])[at]
        names = list(dict.fromkeys(problem.names[owner[k]] for k in np.argsort(-share) if share[k] > 0.1 * share.max()))
        advice = {KINDS[split_name(n)[0].word].remedy for n in names} - {""}
        text = f"the factors of {where} do not determine {', '.join(names[:5])}"
        return IndeterminateError(": ".join([text, *sorted(advice)]), tuple(names))

    def widened(self, variables: Index, values: Values, anchors: Index | None = None) -> GaussianMap:
        """The map with additional variables without information, at given values."""
        where = np.searchsorted(variables, self.variables)
        anchor = np.full(len(variables), -1, dtype=np.int64) if anchors is None else anchors.copy()
        anchor[where] = self.anchors  # existing anchors are unchanged
        if len(variables) == len(self.variables):
            return replace(self, values=values, anchors=anchor)
        width, own = self.problem.width[variables], self.problem.width[self.variables]
        starts = np.cumsum(width) - width
        at = np.repeat(starts[where] - (np.cumsum(own) - own), own) + np.arange(own.sum())
        n = int(width.sum())
        gradient = np.zeros(n)
        gradient[at] = self.gradient
        A = self.information.tocoo()
        A = sp.csc_matrix((A.data, (at[A.row], at[A.col])), shape=(n, n))
        return replace(self, values=values, variables=variables, anchors=anchor, information=A, gradient=gradient)


def add_maps(a: GaussianMap, b: GaussianMap, values: Values | None = None) -> tuple[GaussianMap, bool]:
    """Sum of A and B, whose base is the end of A; and whether B has information on variables of A.

    Parameters
    ----------
    values : Values, optional
        Linearisation point; by default the values of A, and those of B for new variables.
    """
    seen = b.moved(a.end if values is None else values["x"][a.problem.bases[a.stop]])
    common = np.intersect1d(a.variables, b.variables, assume_unique=True)
    news = len(common) > 1
    if values is None:
        values = a.values.copy()
        for word, _, places, rows, _ in seen.kinds():
            new = ~np.isin(seen.variables[places], common, assume_unique=True)
            values[word][rows[new]] = seen.values[word][rows[new]]
        seen = seen.carried(seen.step_to(values)) if len(common) > 1 else seen
    else:
        a, seen = a.carried(a.step_to(values)), seen.carried(seen.step_to(values))
    variables = np.union1d(a.variables, b.variables)
    anchors = np.full(len(variables), -1, dtype=np.int64)
    anchors[np.searchsorted(variables, b.variables)] = b.anchors
    anchors[np.searchsorted(variables, a.variables)] = a.anchors
    wide_a = a.widened(variables, values, anchors)
    wide_b = seen.widened(variables, values, anchors).anchored_as(wide_a)
    joined = replace(
        wide_a, stop=b.stop, information=sp.csc_matrix(wide_a.information + wide_b.information),
        gradient=wide_a.gradient + wide_b.gradient, waiting=np.concatenate([a.waiting, b.waiting]),
    )  # fmt: skip
    return joined, news or bool(np.any(joined.gradient[joined.free]))


def join_gaussian_maps(a: GaussianMap, b: GaussianMap, factors: Index, *, passes: int | None = None) -> GaussianMap:
    """Join B, whose base is the end of A, and the factors between both.

    Parameters
    ----------
    factors : (f,)
        Numbers of the factors to add.
    passes : int, optional
        Number of linearisations. By default up to :data:`PASSES` if the maps have common variables, otherwise one.
    """
    joined, news = add_maps(a, b)
    begin, enter = joined.admitted(factors)
    if not len(enter) and not news:
        return begin
    return begin.solved(enter, lambda values: add_maps(a, b, values)[0], passes or (PASSES if news else 1))
