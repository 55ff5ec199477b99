"""A factor graph divided into steps, one per submap: when a map-joining method adds which variables and factors.

A factor belongs to the submaps of its nodes. It is added at the lowest node of the join tree that contains all of them
and can linearise it. Three groups of variables need special treatment (:data:`~graphslam.join.frames.RULES`):

* A *small constant* (scale of wheels, bias of an IMU or of GPS fixes) is near zero. Its factors are added at once. A
  map without its prior (or random walk) is linearised with the prior of this variable type, which is not kept as
  information.
* The datum, gravity, velocities, beacons and the zero of a compass can be anywhere. Their factors wait until they
  determine the variable, given the nodes. It then starts at the least-squares optimum of these factors alone.
* Variable types without a transformation rule wait for the frame of the first base.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from graphslam.core.atomic import write_npz
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import Group, compose_increments
from graphslam.core.submap import Submap
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factor_graph_state import LANDMARK_SUBMAPS
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.factors.function import FunctionRecord
from graphslam.graph.factors.landmark_submap import PathRecord
from graphslam.graph.gtsam_values import value_of
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.variables import KINDS, Values, VariableLayout, split_name
from graphslam.join.frames import Rule, rows_in_frame, rule_of
from graphslam.join.graph_file import PARTS, graph_arrays, read_graph_arrays
from graphslam.join.kernel_weights import without_kernels
from graphslam.join.submap_blocks import check_identified

Index = npt.NDArray[np.int64]
VAGUE_ANGLE = 0.3
"""A direction with a larger standard deviation [rad] is not determined: its factors cannot be linearised yet."""
UNDETERMINED = 1e-9
"""Smallest eigenvalue of a scaled information matrix for determined variables."""
_STARTS = 20
"""Most Gauss-Newton steps for the initial values of variables, given the nodes."""


@dataclass(frozen=True, eq=False)
class JoinProblem:
    """A factor graph of submaps in one chain, the input of the map-joining methods.

    Parameters
    ----------
    graph : FactorGraph
        It is not changed. Its values are the initial values of variables other than poses.
    keys : (m,) int64
        Keys of the submaps.
    bases : (m + 1,) int64
        Node at the base of each submap, then the exit of the last: submap k has the nodes ``bases[k] … bases[k + 1]``.
    times : (n,)
        Times of the nodes [s]; their indices if there is no clock.
    chains : (n + m - 1, 3|7)
        Nodes of every submap in the frame of its base, from base to exit, as measured by the submap.
    offset : float
        Added to the sum of squares to get the robust objective (:meth:`of_graph`).
    """

    graph: FactorGraph
    keys: Index
    bases: Index
    times: Array
    chains: Array
    offset: float = 0.0

    # ---------------------------------------------------------------- where it comes from

    @classmethod
    def of_graph(cls, graph: FactorGraph) -> JoinProblem:
        """All factors of a graph of submaps.

        Filters need Gaussians, so a factor with a robust kernel is replaced by a weighted one, with the kernel's weight
        at the values of the graph. There, the weighted sum plus a constant (:attr:`offset`) has the value and the
        gradient of the robust sum, so both have the same optimum.
        """
        chain = graph.submaps
        if not chain:
            raise DataError("there are no submaps", got=0, wanted="at least one")
        if any(a.nodes[-1] != b.node for a, b in pairwise(chain)) or chain[0].node:
            raise DataError("submaps do not follow each other in one chain", wanted="one session")
        weighted, offset = without_kernels(graph)
        return cls(
            weighted,
            np.array([s.key for s in chain], dtype=np.int64),
            np.array([*(s.node for s in chain), chain[-1].nodes[-1]], dtype=np.int64),
            np.concatenate([*(s.times[:-1] for s in chain), chain[-1].times[-1:]]),
            np.concatenate([s.T_base_node for s in chain]),
            offset,
        )

    @classmethod
    def of_submaps(
        cls, submaps: Sequence[Submap], *, covariance_scale: float = 1.0, match_support: float = 0.5
    ) -> JoinProblem:
        """A graph of submaps (landmark and dense ones) and their matches.

        Parameters
        ----------
        match_support : float
            Least share of the particles that must support a match.
        """
        check_identified(submaps)
        chain = [replace(s, matches=tuple(m for m in s.matches if m.support >= match_support)) for s in submaps]
        return cls.of_graph(FactorGraph.from_submaps(chain, covariance_scale=covariance_scale))

    @classmethod
    def of_network(cls, network: PoseNetwork, poses: int) -> JoinProblem:
        """A pose-graph file, divided into submaps of ``poses`` steps along its vertex numbers."""
        name, n = network.source, len(network)
        if poses < 1:
            raise DataError("a submap has no step", where=name, got=poses, wanted="at least 1 pose")
        if len(network.landmark_ids) or network.position_priors.any():
            raise DataError("landmarks and position priors cannot be cut", where=name, wanted="poses alone")
        if n < 2 or network.anchors.tolist() != [0]:
            raise DataError("one vertex is held, the first", where=name, got=network.anchors.tolist()[:5])
        graph = FactorGraph(network.dim)
        P = np.linalg.inv(network.information)
        group, x = graph.structure.group, network.poses
        graph.add_betweens(
            network.edges, network.measurements, 0.5 * (P + np.swapaxes(P, 1, 2)),
            poses=group.between(np.broadcast_to(x[0], x[1:].shape), x[1:]), evidence=EvidenceUse(["file"], (0.0, 0.0)),
        )  # fmt: skip
        bases = np.append(np.arange(0, n - 1, poses), n - 1)
        steps = network.steps_along_numbers(group)
        chains = np.concatenate([compose_increments(steps[a:b]) for a, b in pairwise(bases.tolist())])
        return cls(graph, np.arange(len(bases) - 1), bases, np.arange(n, dtype=np.float64), chains)

    def first_submaps(self, count: int) -> JoinProblem:
        """The problem of the first ``count`` submaps, for compiling kernels."""
        m = min(count, len(self.keys))
        if m == len(self.keys):
            return self
        inside = [f for f, high in enumerate(self.spans[1].tolist()) if high < m]
        names = {n for f in inside for n in self.factors[f].variables()}
        graph = FactorGraph.with_values(self.graph.values.copy())
        graph.values.poses = graph.values.poses[: self.bases[m] + 1]
        graph.drop_landmarks([i for i in graph.values.landmark_ids.tolist() if f"l{i}" not in names])
        for word in KINDS:
            if word not in ("x", "l"):
                used = [split_name(n)[1] for n in names if split_name(n)[0].word == word]
                graph.values[word] = graph.values[word][: max(used, default=-1) + 1]
        for f in inside:
            graph.insert(self.factors[f])
        stop = int(self.bases[m]) + 1
        return JoinProblem(graph, self.keys[:m], self.bases[: m + 1], self.times[:stop], self.chains[: stop + m - 1])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the graph with all values and factors as an archive of arrays."""
        write_npz(path, graph_arrays(self.graph, {name: getattr(self, name) for name in PARTS}))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> JoinProblem:
        """Inverse of :meth:`save`."""
        values, records, parts = read_graph_arrays(path)
        graph = FactorGraph.with_values(values)
        for r in records:
            graph.insert(r)
        return cls(graph, **parts)

    def objective(self, values: Values) -> float:
        """``Σ rᵀ Λ r`` of all factors (``2 ρ`` for those with robust kernels, at the values of the graph)."""
        return self.graph.flat().objective(values) + self.offset

    # ---------------------------------------------------------------- what it is

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.graph.dim

    @property
    def group(self) -> Group:
        """SE(2) or SE(3)."""
        return self.graph.structure.group

    @property
    def states(self) -> int:
        """Number of free scalars."""
        return self.graph.flat().layout.size

    @property
    def dof(self) -> int:
        """Number of measured scalars minus free ones."""
        return self.graph.flat().measurements - self.states

    @cached_property
    def factors(self) -> list[FactorRecord]:
        """All factors."""
        return list(self.graph.records.values())

    def factor_counts(self) -> dict[str, int]:
        """Number of factors by class, sorted by class."""
        return dict(sorted(Counter(r.group for r in self.factors).items()))

    @cached_property
    def layout(self) -> VariableLayout:
        """Columns of all variables, including the first base."""
        free = self.graph.structure.layout()
        return VariableLayout(free.dim, free.counts, free.landmark_ids, fixed=())

    @cached_property
    def names(self) -> list[str]:
        """Names of the variables, in the order of their numbers and columns."""
        return self.layout.names()

    @cached_property
    def number(self) -> dict[str, int]:
        """Number of each variable."""
        return {n: k for k, n in enumerate(self.names)}

    @cached_property
    def first(self) -> Index:
        """First column of each variable, then the number of columns ``(v + 1,)``."""
        return np.concatenate([[0], np.cumsum(self.width)]).astype(np.int64)

    @cached_property
    def width(self) -> Index:
        """Degrees of freedom of each variable ``(v,)``."""
        return np.array([split_name(n)[0].dof(self.dim) for n in self.names], dtype=np.int64)

    @cached_property
    def words(self) -> list[str]:
        """Variable types of the graph, in the order of their numbers."""
        return [w for w, n in zip(KINDS, self.layout.counts) if n]

    @cached_property
    def range_of(self) -> dict[str, tuple[int, int]]:
        """First number of the variables of each type, and one after the last."""
        out, n = {}, 0
        for word, count in zip(KINDS, self.layout.counts):
            out[word] = (n, n + count)
            n += count
        return out

    @cached_property
    def rules(self) -> list[Rule]:
        """Transformation rule of each variable."""
        rules: list[Rule] = []
        for word in self.words:
            a, b = self.range_of[word]
            rules += [rule_of(word, self.dim)] * (b - a)
        return rules

    @cached_property
    def needs_first_base(self) -> npt.NDArray[np.bool_]:
        """Factors that hold in the frame of the first base only ``(f,)``: by the rule of a variable, or, of a user's
        function, because its residual changes with the frame."""
        fixed = [any(self.rules[v] == "first-base" for v in at.tolist()) for at in self.variables]
        T = self.group.exp(np.linspace(0.5, -0.7, self.group.dof))  # any frame
        for f, r in enumerate(self.factors):
            if isinstance(r, FunctionRecord) and not fixed[f]:
                rows = [value_of(self.graph.values, n, self.graph.landmark_rows) for n in r.names]
                rules = [rule_of(split_name(n)[0].word, self.dim) for n in r.names]
                moved = [rows_in_frame(rule, self.group, T, x[None])[0][0] for rule, x in zip(rules, rows)]
                fixed[f] = not np.allclose(r.error(moved), r.error(rows), rtol=1e-7, atol=1e-7)
        return np.array(fixed, dtype=bool)

    @cached_property
    def variables(self) -> list[Index]:
        """Numbers of the variables of each factor."""
        number = self.number
        return [np.array([number[n] for n in r.variables()], dtype=np.int64) for r in self.factors]

    @cached_property
    def spans(self) -> tuple[Index, Index]:
        """First and last submap of each factor; it is added when both have been joined."""
        n, (x0, x1) = len(self.factors), self.range_of["x"]
        local = np.zeros(len(self.names), dtype=bool)
        local[x0:x1] = True
        low, high = np.full(n, -1), np.full(n, -1)
        home = np.full(len(self.names), -1)
        for f, v in enumerate(self.variables):
            nodes = v[local[v]]
            if len(nodes):
                high[f] = np.searchsorted(self.bases[1:], nodes.max(), side="left")
                low[f] = min(np.searchsorted(self.bases, nodes.min(), side="right") - 1, high[f])
                for other in v[~local[v]]:
                    if home[other] < 0 or high[f] < home[other]:
                        home[other] = high[f]
        p0, p1 = self.range_of["point"]
        for f in np.flatnonzero(high < 0).tolist():  # points of a path take the place of nodes
            v = self.variables[f]
            points = v[(v >= p0) & (v < p1)]
            if len(points):
                low[f], high[f] = home[points].min(), home[points].max()
                unknown = v[home[v] < 0]
                home[unknown] = high[f]
        for f in np.flatnonzero(high < 0).tolist():
            at = home[self.variables[f]]
            at = at[at >= 0] if np.any(at >= 0) else np.array([len(self.keys) - 1])
            low[f], high[f] = at.min(), at.max()
        return low, high

    @cached_property
    def priors(self) -> dict[int, list[tuple[int, int]]]:
        """First and last submap of the factors that determine a small constant from previous ones, or alone."""
        low, high = self.spans
        out: dict[int, list[tuple[int, int]]] = {}
        for f, v in enumerate(self.variables):
            if all(self.rules[k] == "constant" for k in v.tolist()):
                out.setdefault(int(v.max()), []).append((int(low[f]), int(high[f])))
        return out

    def has_prior(self, variable: int, first: int, stop: int) -> bool:
        """Whether a small constant has a prior among the factors of submaps ``first … stop - 1``."""
        return any(first <= low and high < stop for low, high in self.priors.get(variable, ()))

    @cached_property
    def constant_priors(self) -> dict[str, Array]:
        """Prior information ``(dof, dof)`` of the first constant of each type of small constants."""
        out: dict[str, Array] = {}
        for f, v in enumerate(self.variables):
            if not all(self.rules[k] == "constant" for k in v.tolist()):
                continue
            words = [split_name(self.names[k])[0].word for k in v.tolist()]
            alone = [k for k, w in zip(v.tolist(), words) if words.count(w) == 1 and w not in out]
            if alone:
                A = sp.csc_matrix(self.arrays([f]).evaluate(self.graph.values, dense=False).A)
                for k in alone:
                    c = self.columns(np.array([k]))
                    out[split_name(self.names[k])[0].word] = A[c][:, c].toarray()
        return out

    @cached_property
    def landmark_anchors(self) -> Index:
        """Exit node of the submap that observed each landmark first ``(L,)``; -1 if no submap did."""
        first, count = self.range_of["l"][0], self.layout.count("l")
        anchors = np.full(count, -1, dtype=np.int64)
        high = self.spans[1]
        for f in np.argsort(high, kind="stable")[::-1].tolist():
            if isinstance(self.factors[f], LANDMARK_SUBMAPS):
                rows = self.variables[f] - first
                anchors[rows[(rows >= 0) & (rows < count)]] = self.bases[high[f] + 1]
        return anchors

    def chain(self, k: int) -> Array:
        """Nodes of submap k in the frame of its base ``(n, 3|7)``, as measured by the submap."""
        return self.chains[self.bases[k] + k : self.bases[k + 1] + k + 1]

    def submap_values(self, k: int, factors: npt.ArrayLike, values: Values) -> Index:
        """Write the initial values of submap k, in the frame of its base, into ``values``; returns its variables.

        Parameters
        ----------
        factors : (f,)
            Numbers of the internal factors of submap k.
        """
        a, b = int(self.bases[k]), int(self.bases[k + 1])
        values["x"][a : b + 1] = self.chain(k)
        found = set(range(a, b + 1))
        row_of, (l0, _), (p0, _) = self.layout.row_of, self.range_of["l"], self.range_of["point"]
        for f in np.asarray(factors).tolist():
            r = self.factors[f]
            if isinstance(r, LANDMARK_SUBMAPS):
                rows = [row_of[i] for i in r.landmark_ids.tolist()]
                values["l"][rows[::-1]] = r.landmark_positions()[::-1]  # keep the first observation
                found |= {l0 + i for i in rows}
            elif isinstance(r, PathRecord):
                first = 3 + 2 * len(r.landmark_ids)
                values["point"][r.points] = r.z[first : first + 2 * len(r.points)].reshape(-1, 2)
                found |= {p0 + i for i in r.points.tolist()}
        return np.array(sorted(found), dtype=np.int64)

    # ---------------------------------------------------------------- factors that enter

    def arrays(self, factors: npt.ArrayLike) -> FactorArrays:
        """Given factors as a least-squares problem over :attr:`layout`."""
        return FactorArrays([self.factors[f] for f in np.asarray(factors).tolist()], self.layout)

    def columns(self, variables: Index) -> Index:
        """Columns of variables."""
        within = np.arange(self.width[variables].sum())
        starts = np.cumsum(self.width[variables]) - self.width[variables]
        return np.repeat(self.first[variables] - starts, self.width[variables]) + within

    def admit(
        self, values: Values, known: npt.NDArray[np.bool_], waiting: Index, *, base: int = 0, force: bool = False
    ) -> tuple[Index, Index]:
        """Select the waiting factors that can be linearised at ``values``; their new variables get initial values.

        Parameters
        ----------
        values : Values
            In the frame of node ``base``; rows of new variables are written.
        known : (v,) bool
            Variables with values; updated in place.
        waiting : (f,)
            Numbers of factors.
        force : bool
            Last call: all factors are added.

        Returns
        -------
        entered, waiting : (…,)
        """
        waiting = np.asarray(waiting, dtype=np.int64)
        if not len(waiting):
            return waiting, waiting
        rules = self.rules
        enter, later, groups = [], [], []
        new: dict[int, int] = {}
        for f in waiting.tolist():
            unknown = [int(v) for v in self.variables[f] if not known[v]]
            if base > 0 and not force and self.needs_first_base[f]:
                later.append(f)
                continue
            open_ = [v for v in unknown if rules[v] != "constant"]
            if open_:
                groups.append((f, open_))
                for v in open_:
                    new.setdefault(v, len(new))
            else:
                enter.append(f)
        if groups:
            pairs = [(new[o[0]], new[v]) for _, o in groups for v in o]
            links = sp.csr_matrix((np.ones(len(pairs)), tuple(np.array(pairs).T)), shape=(len(new), len(new)))
            count, label = connected_components(links, directed=False)
            members = list(new)
            for c in range(count):
                of = np.array(sorted(members[i] for i in np.flatnonzero(label == c)), dtype=np.int64)
                mine = [f for f, o in groups if label[new[o[0]]] == c]
                if self._start(values, of, np.array(mine), known, base) or force:
                    enter += mine
                    known[of] = True
                else:
                    later += mine
        for f in enter:
            for v in self.variables[f].tolist():
                if not known[v]:  # a constant
                    known[v] = True
                    self._row(values, v)[:] = 0.0
        return np.array(sorted(enter), dtype=np.int64), np.array(sorted(later), dtype=np.int64)

    def _row(self, values: Values, variable: int) -> Array:
        word = split_name(self.names[variable])[0].word
        return values[word][variable - self.range_of[word][0]]

    def _start(self, values: Values, new: Index, factors: Index, known: npt.NDArray[np.bool_], base: int) -> bool:
        """Set new variables to the optimum of given factors, all others fixed; returns whether these factors determine
        them."""
        given, T = self.graph.values, self.group.inverse(self.graph.values.poses[base])
        for v in new.tolist():
            word = split_name(self.names[v])[0].word
            row = given[word][v - self.range_of[word][0]]
            self._row(values, v)[:] = rows_in_frame(self.rules[v], self.group, T, row[None])[0][0]
        for f in factors.tolist():
            for v in self.variables[f].tolist():
                if not known[v] and self.rules[v] == "constant":
                    self._row(values, v)[:] = 0.0
        problem, at = self.arrays(factors), self.columns(new)
        angle = np.concatenate([[u == "r" for u in split_name(self.names[v])[0].units[self.dim]] for v in new.tolist()])
        A = np.zeros((len(at), len(at)))
        for _ in range(_STARTS):
            system = problem.evaluate(values, dense=False)
            A, g = sp.csc_matrix(system.A)[at][:, at].toarray(), system.g[at]
            size = np.sqrt(np.maximum(np.diag(A), 1e-300))
            scaled = A / np.outer(size, size)
            if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < UNDETERMINED:
                return False
            step = -np.linalg.solve(A, g)
            move_rows(self, values, new, step)
            if -(g @ step) < 1e-9 * (1.0 + system.objective):
                break
        sigma = np.sqrt(np.diag(np.linalg.inv(A)))
        return not np.any(sigma[angle] > VAGUE_ANGLE)


def move_rows(problem: JoinProblem, values: Values, variables: Index, step: Array) -> None:
    """Move some variables of ``values`` by a step ``(k,)`` along their columns, in place."""
    at = np.cumsum(problem.width[variables]) - problem.width[variables]
    for word in problem.words:
        a, b = problem.range_of[word]
        mine = np.flatnonzero((variables >= a) & (variables < b))
        if not len(mine):
            continue
        kind, rows = KINDS[word], variables[mine] - a
        part = step[at[mine, None] + np.arange(kind.dof(problem.dim))]
        g = kind.pose_group(problem.dim)
        block = values[word]
        block[rows] = block[rows] + part if g is None else g.compose(block[rows], g.exp(part))
