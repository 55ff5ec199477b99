"""Joins of a factor graph written down plainly: dense matrices, finite differences, no frames of tree nodes.

A map is a list of variables with a mean each and a dense matrix: a Gaussian in the coordinates in which joiners state
it (right tangents of poses; landmarks in the frame of their anchor, the end of the submap that saw them first; all else
plainly). Everything is expressed in one vector of local coordinates and differentiated numerically.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.variables import Values, split_name
from graphslam.join.frames import rows_in_frame, rule_of
from graphslam.join.gaussian_map import GaussianMap
from graphslam.join.graph_problem import JoinProblem

STEP = 1e-6


@dataclass
class SlowMap:
    """Means in the frame of the first base, and the information of the coordinates."""

    names: list[str]
    values: Values
    anchors: dict[str, int]
    information: Array
    gradient: Array | None = None
    frame: Array | None = None
    """Where the base of the map is in the frame of the values that it is compared with."""


class SlowJoin:
    """One graph, and how its variables are written as coordinates."""

    def __init__(self, problem: JoinProblem) -> None:
        self.problem, self.g = problem, problem.group
        self.layout = problem.layout

    def row(self, values: Values, name: str) -> Array:
        kind, number = split_name(name)
        return values[kind.word][self.layout.row_of[number] if kind.word == "l" else number]

    def widths(self, names: Sequence[str]) -> list[int]:
        return [split_name(n)[0].dof(self.problem.dim) for n in names]

    def coordinates(self, m: SlowMap, values: Values, names: Sequence[str]) -> Array:
        """What ``values`` are in the coordinates of a map about its mean."""
        out = []
        if m.frame is not None:
            values = self.seen_from(m.frame, values, names)
        for name in names:
            x, y = self.row(m.values, name), self.row(values, name)
            group = split_name(name)[0].pose_group(self.problem.dim)
            if group is not None:
                out.append(group.log(group.between(x, y)))
            elif name in m.anchors:
                a = m.anchors[name]
                there = self.g.transform(self.g.inverse(values["x"][a]), y)
                out.append(there - self.g.transform(self.g.inverse(m.values["x"][a]), x))
            else:
                out.append(y - x)
        return np.concatenate([np.zeros(0), *out])

    def seen_from(self, T: Array, values: Values, names: Sequence[str]) -> Values:
        """Values in the frame that stands at ``T``."""
        out, back = values.copy(), self.g.inverse(T)
        for name in names:
            rule, row = rule_of(split_name(name)[0].word, self.problem.dim), self.row(values, name)
            self.row(out, name)[:] = rows_in_frame(rule, self.g, back, row[None])[0][0]
        return out

    def moved(self, values: Values, anchors: dict[str, int], names: Sequence[str], step: Array) -> Values:
        """Values after a step in these coordinates."""
        new = values.copy()
        poses_first = sorted(names, key=lambda n: split_name(n)[0].word != "x")
        parts = dict(zip(names, np.split(step, np.cumsum(self.widths(names))[:-1])))
        for name in poses_first:
            group, d = split_name(name)[0].pose_group(self.problem.dim), parts[name]
            if group is not None:
                self.row(new, name)[:] = group.compose(self.row(values, name), group.exp(d))
            elif name in anchors:
                a = anchors[name]
                m = self.g.transform(self.g.inverse(values["x"][a]), self.row(values, name)) + d
                self.row(new, name)[:] = self.g.transform(new["x"][a], m)
            else:
                self.row(new, name)[:] = self.row(values, name) + d
        return new

    def factor_information(self, factors: Sequence[int], m: SlowMap) -> tuple[Array, Array]:
        """``Jᵀ Λ J`` and ``Jᵀ Λ r`` of the graph's own factors, taken to the coordinates of the map numerically."""
        names, n = m.names, sum(self.widths(m.names))
        H, g = np.zeros((n, n)), np.zeros(n)
        for f in factors:
            own = FactorArrays([self.problem.factors[f]], self.layout)
            A = own.evaluate(m.values, dense=True)
            columns = np.concatenate([self.problem.columns(np.array([self.problem.number[k]])) for k in names])
            C = np.zeros((len(columns), n))  # plain steps by steps in coordinates, numerically
            for i in range(n):
                e = np.zeros(n)
                e[i] = STEP
                plus, minus = (self.moved(m.values, m.anchors, names, s * e) for s in (1, -1))
                C[:, i] = (self.plain(m.values, plus, names) - self.plain(m.values, minus, names)) / (2 * STEP)
            H += C.T @ np.asarray(A.A)[np.ix_(columns, columns)] @ C
            g += C.T @ A.g[columns]
        return H, g

    def plain(self, begin: Values, end: Values, names: Sequence[str]) -> Array:
        """The plain step of the graph between two values."""
        return self.coordinates(SlowMap(list(names), begin, {}, np.zeros((0, 0))), end, names)

    def prior(self, m: SlowMap, values: Values, anchors: dict[str, int], names: list[str]) -> tuple[Array, Array]:
        """Information and gradient of a map at other values, over coordinates with other anchors."""
        n = sum(self.widths(names))
        r = self.coordinates(m, values, m.names)
        J = np.zeros((len(r), n))
        for i in range(n):
            e = np.zeros(n)
            e[i] = STEP
            ends = [self.coordinates(m, self.moved(values, anchors, names, s * e), m.names) for s in (1, -1)]
            J[:, i] = (ends[0] - ends[1]) / (2 * STEP)
        slope = m.information @ r + (0.0 if m.gradient is None else m.gradient)
        return J.T @ m.information @ J, J.T @ slope

    def has_prior(self, name: str, submaps: range) -> bool:
        """Is there a factor of these submaps on constants alone, of which this is the last?"""
        low, high = self.problem.spans
        for f, r in enumerate(self.problem.factors):
            rules = [rule_of(split_name(n)[0].word, self.problem.dim) for n in r.variables()]
            last = max(r.variables(), key=self.problem.number.__getitem__)
            if set(rules) == {"constant"} and last == name and low[f] in submaps and high[f] in submaps:
                return True
        return False

    def plain_map(self, m: GaussianMap) -> SlowMap:
        """A map as it is carried, as names and a dense matrix."""
        names = [self.problem.names[v] for v in m.variables.tolist()]
        anchors = {n: int(a) for n, a in zip(names, m.anchors.tolist()) if a >= 0}
        return SlowMap(names, m.values, anchors, m.information.toarray(), m.gradient)

    def solved(
        self, at: SlowMap, maps: Sequence[SlowMap], factors: Sequence[int], base: str, submaps: range
    ) -> SlowMap:
        """One Gauss-Newton step on maps and factors; the base is held, and constants where it is not the first."""
        values, first = at.values, np.concatenate([[0], np.cumsum(self.widths(at.names))])
        free = np.ones(first[-1], dtype=bool)
        for k, name in enumerate(at.names):
            free[first[k] : first[k + 1]] = name != base
        here = SlowMap(at.names, values, at.anchors, at.information)
        H, g = self.factor_information(factors, here)
        for m in maps:
            A, b = self.prior(m, values, at.anchors, at.names)
            H, g = H + A, g + b
        A, slope = H.copy(), g.copy()
        for k, name in enumerate(at.names):  # constants whose prior is elsewhere: it leads the step and is not kept
            word = split_name(name)[0].word
            if base != "x0" and rule_of(word, self.problem.dim) == "constant" and not self.has_prior(name, submaps):
                c, prior = slice(first[k], first[k + 1]), self.problem.constant_priors[word]
                A[c, c] += prior
                slope[c] += prior @ self.row(values, name)
        step = np.zeros(len(g))
        step[free] = -np.linalg.solve(A[np.ix_(free, free)], slope[free])
        end = self.moved(values, at.anchors, at.names, step)
        # the Gaussian about the new mean: how coordinates about it change those about the old one
        T = np.zeros((len(step), len(step)))
        for i in range(len(step)):
            e = np.zeros(len(step))
            e[i] = STEP
            ends = [self.coordinates(here, self.moved(end, at.anchors, at.names, s * e), at.names) for s in (1, -1)]
            T[:, i] = (ends[0] - ends[1]) / (2 * STEP)
        return SlowMap(at.names, end, at.anchors, T.T @ H @ T)

    def joined(self, a: GaussianMap, b: GaussianMap, begin: GaussianMap, factors: Sequence[int]) -> SlowMap:
        """B, whose base is the end of A, joined to A, with factors that enter; variables start as in ``begin``."""
        base, T, submaps = self.problem.names[a.base], a.end, range(a.first, b.stop)
        a, b = self.plain_map(a), self.plain_map(b)
        seen = SlowMap(b.names, b.values, b.anchors, b.information, b.gradient, frame=T)
        names = [self.problem.names[v] for v in begin.variables.tolist()]
        anchors = {n: int(a) for n, a in zip(names, begin.anchors.tolist()) if a >= 0}
        n = sum(self.widths(names))
        at = SlowMap(names, begin.values, anchors, np.zeros((n, n)))
        return self.solved(at, [a, seen], factors, base, submaps)
