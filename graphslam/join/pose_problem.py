"""Submaps without landmarks and what ties them: the least-squares problem that every joiner of poses is given.

A dense submap is a chain of nodes from its base to its exit; matches and loops tie nodes of different submaps; in space
levelled bases know which way is down. All of these are relative: no factor changes when everything moves as one, the
direction of gravity included.

Joiners carry Gaussians, so a tie with a robust kernel counts with the weight that the kernel gives it where the graph
stands: the optimum of the weighted sum is then that of the graph itself.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import read_npz, write_npz
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.npz import floats, ints
from graphslam.core.poses import SE2, SE3, Group, compose_increments
from graphslam.core.submap import Submap
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import LEVELLED, AttitudeRecord, attitude_terms
from graphslam.graph.factors.between import BetweenBatch, BetweenRecord, between_terms
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.noise import robust_terms, whiteners
from graphslam.graph.variables import KINDS, Values, VariableLayout

Index = npt.NDArray[np.int64]

SINGULAR = 1e-12
"""Share of the largest singular value of a whitener below which a direction is not measured."""
PROBLEM_FORMAT = "graphslam.pose-problem/1"
PROBLEM = {
    "keys": ints("m"),
    "bases": ints("m+1"),
    "times": floats("n"),
    "ends": ints("e", 2),
    "measured": floats("e", "p"),
    "whiteners": floats("e", "d", "d"),
    "level_nodes": ints("k"),
    "directions": floats("k", 3),
    "level_whiteners": floats("k", 2, 2),
}


@dataclass(frozen=True, eq=False)
class RelativePoseFactors:
    """Measurements between nodes, and of gravity at nodes.

    Parameters
    ----------
    ends : (e, 2)
        Nodes i and j.
    measured : (e, 3|7)
        ``T_ij``.
    whiteners : (e, d, d)
        ``W`` with ``Wᵀ W`` = information in the right tangent.
    level_nodes : (k,)
    directions : (k, 3)
        Of gravity in the frame of each of these nodes.
    level_whiteners : (k, 2, 2)
        Of the two components across it [1/rad].
    """

    ends: Index
    measured: Array
    whiteners: Array
    level_nodes: Index
    directions: Array
    level_whiteners: Array

    def __len__(self) -> int:
        return len(self.ends) + len(self.level_nodes)

    def take(self, edges: npt.ArrayLike, levels: npt.ArrayLike, first: int = 0) -> RelativePoseFactors:
        """Some of them, with nodes counted from ``first``."""
        e, k = np.asarray(edges), np.asarray(levels)
        return RelativePoseFactors(
            self.ends[e] - first, self.measured[e], self.whiteners[e],
            self.level_nodes[k] - first, self.directions[k], self.level_whiteners[k],
        )  # fmt: skip

    def whitened(self, poses: Array, up: Array | None) -> tuple[Array, Array, Array, Array]:
        """Whitened residuals and Jacobians of the relative poses, then those of gravity.

        Parameters
        ----------
        poses : (n, 3|7)
        up : (7,) or None
            A frame whose z axis points up; its tangent are turns about its own x and y.

        Returns
        -------
        (e, d), (e, d, 2 d), (k, 2), (k, 2, 8)
            Jacobians on right tangents: of i and j; of the node (6) and of ``up`` (2).
        """
        i, j = self.ends.T
        r, J = between_terms(self.measured, poses[i], poses[j])
        W = self.whiteners
        r, J = np.einsum("mij,mj->mi", W, r), W @ J
        if up is None or not len(self.level_nodes):
            return r, J, np.zeros((0, 2)), np.zeros((0, 2, 8))
        # seen from the level frame itself the tilt is zero, and a step of it is a right tangent
        s, K = attitude_terms(SE3.between(up, poses[self.level_nodes]), np.zeros(2), self.directions)
        V = self.level_whiteners
        return r, J, np.einsum("mij,mj->mi", V, s), V @ K


@dataclass(frozen=True, eq=False)
class PoseProblem(RelativePoseFactors):
    """Submaps in a chain, as nodes and ties between them; node 0 is the base of the first and is held.

    Parameters
    ----------
    keys : (m,) int64
        Of the submaps.
    bases : (m + 1,) int64
        Node at the base of each, then the exit of the last: submap k holds the nodes ``bases[k] … bases[k + 1]``.
    times : (n,)
        Of the nodes [s]; their numbers where there is no clock.
    left_out : tuple of str
        What the graph holds besides and the joiners do not take, in words.
    """

    keys: Index
    bases: Index
    times: Array
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.keys):
            raise DataError("there are no submaps", got=0, wanted="at least one")
        last = len(self.times) - 1
        rising = len(self.bases) == len(self.keys) + 1 and bool(np.all(np.diff(self.bases) > 0))
        if not rising or self.bases[0] != 0 or self.bases[-1] != last:
            raise DataError("bases of the submaps do not rise from node 0 to the last", got=self.bases[:9], wanted=last)
        if len(self.ends) and (self.ends.min() < 0 or self.ends.max() > last):
            raise DataError("a relative pose joins nodes that are not there", wanted=f"two of 0 … {last}")
        bare = np.setdiff1d(np.arange(last), self._steps[0])
        if len(bare):
            raise DataError(
                f"nodes {bare[0]} and {bare[0] + 1} are not tied to each other, and submaps are chains",
                got=f"{len(bare)} gaps",
                wanted="a relative pose between any two neighbours",
            )
        lengths = np.linalg.svd(self.whiteners[self._steps[1]], compute_uv=False)
        weak = np.flatnonzero(lengths[:, -1] <= SINGULAR * lengths[:, 0])
        if len(weak):
            raise DataError(
                f"the relative pose between nodes {weak[0]} and {weak[0] + 1} says nothing of a direction",
                wanted="information on all of it, because submaps are chains",
            )

    # ---------------------------------------------------------------- what it is

    @property
    def group(self) -> Group:
        """SE(2) or SE(3)."""
        return SE2 if self.measured.shape[1] == SE2.size else SE3

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.group.dim

    @property
    def levelled(self) -> bool:
        """Whether the direction of gravity is a variable."""
        return len(self.level_nodes) > 0

    @property
    def states(self) -> int:
        """Free scalars."""
        return self.group.dof * (len(self.times) - 1) + 2 * self.levelled

    @property
    def dof(self) -> int:
        """Scalars measured, less free ones."""
        return self.group.dof * len(self.ends) + 2 * len(self.level_nodes) - self.states

    @cached_property
    def _steps(self) -> tuple[Index, Index]:
        """Nodes from which an edge leads to the next, and the first such edge."""
        lo, hi = self.ends.min(axis=1, initial=self.bases[-1]), self.ends.max(axis=1, initial=0)
        step = np.flatnonzero(hi - lo == 1)
        node, at = np.unique(lo[step], return_index=True)
        return node, step[at]

    @cached_property
    def start(self) -> Array:
        """The chain alone ``(n, 3|7)``: every node by its first edge to the one before."""
        g, edge = self.group, self._steps[1]
        back = (self.ends[edge, 0] > self.ends[edge, 1])[:, None]
        return compose_increments(np.where(back, g.inverse(self.measured[edge]), self.measured[edge]))

    def submap_of(self, nodes: npt.ArrayLike) -> Index:
        """The first submap that holds each node: an exit belongs to the submap that ends there."""
        return np.searchsorted(self.bases[1:], nodes, side="left").astype(np.int64)

    # ---------------------------------------------------------------- as a least-squares problem

    @cached_property
    def flat(self) -> FactorArrays:
        """Of all measurements; columns are the poses 1 … n - 1, then the tilt."""
        counts = {"x": len(self.times), "tilt": int(self.levelled)}
        layout = VariableLayout(self.dim, tuple(counts.get(word, 0) for word in KINDS), np.zeros(0, dtype=np.int64))
        level = self.attitudes(np.arange(len(self.level_nodes)))
        between = BetweenBatch.of_arrays(self.ends, self.measured, self.whiteners, layout)
        return FactorArrays(level, layout, [between])

    def attitudes(self, rows: npt.ArrayLike, first_id: int = 0) -> list[AttitudeRecord]:
        """Factors of gravity ``rows``."""
        return [
            AttitudeRecord(
                first_id + k, int(self.level_nodes[r]), self.directions[r], self.level_whiteners[r], group=LEVELLED
            )
            for k, r in enumerate(np.asarray(rows).tolist())
        ]

    def values(self, poses: Array, tilt: Array | None = None) -> Values:
        """Values of the variables of :attr:`flat`."""
        blocks = {"x": poses}
        if self.levelled:
            blocks["tilt"] = (np.zeros(2) if tilt is None else np.asarray(tilt))[None]
        return Values(self.dim, blocks)

    # ---------------------------------------------------------------- parts, files

    def part(self, first: int, stop: int, edges: Index | None = None, levels: Index | None = None) -> PoseProblem:
        """Submaps ``first … stop - 1`` with all ties between their own nodes.

        Parameters
        ----------
        edges, levels : (…,), optional
            Those ties, where they are known.
        """
        a, b = int(self.bases[first]), int(self.bases[stop])
        if edges is None:
            edges = np.flatnonzero(np.all((self.ends >= a) & (self.ends <= b), axis=1))
        if levels is None:
            owner = self.submap_of(self.level_nodes)
            levels = np.flatnonzero((owner >= first) & (owner < stop))
        t = self.take(edges, levels, a)
        return PoseProblem(
            t.ends, t.measured, t.whiteners, t.level_nodes, t.directions, t.level_whiteners,
            keys=self.keys[first:stop], bases=self.bases[first : stop + 1] - a, times=self.times[a : b + 1],
        )  # fmt: skip

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as an archive of arrays."""
        write_npz(path, {"format": PROBLEM_FORMAT, **{name: getattr(self, name) for name in PROBLEM}})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> PoseProblem:
        """Inverse of :meth:`save`."""
        arrays: dict[str, Any] = read_npz(path, fmt=PROBLEM_FORMAT, fields=PROBLEM)
        return cls(**arrays)

    # ---------------------------------------------------------------- where it comes from

    @classmethod
    def of_network(cls, network: PoseNetwork, poses: int) -> PoseProblem:
        """A pose-graph file, cut into submaps of so many steps along the numbers of its vertices."""
        name, n = network.source, len(network)
        if poses < 1:
            raise DataError("a submap has no step", where=name, got=poses, wanted="at least 1 pose")
        if len(network.landmark_ids):
            raise DataError("a pose graph with landmarks cannot be cut", where=name, wanted="poses alone")
        if n < 2 or network.anchors.tolist() != [0]:
            raise DataError("one vertex is held, the first", where=name, got=network.anchors.tolist()[:5])
        none = np.zeros(0, dtype=np.int64)
        return cls(
            network.edges.astype(np.int64), network.measurements, whiteners(network.information),
            none, np.zeros((0, 3)), np.zeros((0, 2, 2)),
            keys=np.arange(-(-(n - 1) // poses)), bases=np.append(np.arange(0, n - 1, poses), n - 1),
            times=np.arange(n, dtype=np.float64),
        )  # fmt: skip

    @classmethod
    def of_graph(cls, graph: FactorGraph) -> PoseProblem:
        """The relative poses and levelled bases of a graph of dense submaps, with the weights of their kernels."""
        chain = graph.submaps
        if not chain:
            raise DataError("there are no submaps", got=0, wanted="at least one")
        if any(a.nodes[-1] != b.node for a, b in pairwise(chain)) or chain[0].node:
            raise DataError("submaps do not follow each other in one chain", wanted="one session")
        records = list(graph.records.values())
        if any(isinstance(r, SubmapRecord) for r in records):
            raise DataError("submaps with and without landmarks cannot be joined together", wanted="all of one kind")
        ties = [r for r in records if isinstance(r, BetweenRecord)]
        levels = [r for r in records if isinstance(r, AttitudeRecord)]
        others = Counter(r.group for r in records if not isinstance(r, (BetweenRecord, AttitudeRecord)))
        ends = np.array([(r.i, r.j) for r in ties], dtype=np.int64).reshape(-1, 2)
        W = np.array([r.whitener for r in ties])
        T = np.array([r.T_ij for r in ties])
        x = graph.values.poses
        r = np.einsum("mij,mj->mi", W, between_terms(T, x[ends[:, 0]], x[ends[:, 1]])[0])
        weight = robust_terms(
            np.sum(r**2, axis=1), np.array([t.robust.code for t in ties]), np.array([t.robust.k for t in ties])
        )[1]
        return cls(
            ends, T, np.sqrt(weight)[:, None, None] * W,
            np.array([r.node for r in levels], dtype=np.int64),
            np.array([r.direction for r in levels]).reshape(-1, 3),
            np.array([r.whitener for r in levels]).reshape(-1, 2, 2),
            keys=np.array([s.key for s in chain], dtype=np.int64),
            bases=np.array([*(s.node for s in chain), chain[-1].nodes[-1]], dtype=np.int64),
            times=np.concatenate([*(s.times[:-1] for s in chain), chain[-1].times[-1:]]),
            left_out=tuple(f"{count} × {name}" for name, count in sorted(others.items())),
        )  # fmt: skip

    @classmethod
    def of_submaps(
        cls, submaps: Sequence[Submap], *, covariance_scale: float = 1.0, match_support: float = 0.5
    ) -> PoseProblem:
        """Dense submaps by themselves: their exits, and the matches that so large a share of the particles took."""
        if not submaps:
            raise DataError("there are no submaps", got=0, wanted="at least one")
        check_dense(submaps)
        graph = FactorGraph(submaps[0].dim)
        for s in submaps:
            graph.add_submap(s, covariance_scale=covariance_scale)
            for m in s.matches:
                if m.support >= match_support:
                    graph.add_match(s.key, m)
        return cls.of_graph(graph)


def check_dense(submaps: Sequence[Submap]) -> None:
    """Refuse landmarks in space."""
    bad = next((s for s in submaps if s.landmarks is not None), None)
    if bad is not None:
        raise GeometryError(f"submap {bad.key} has landmarks in space", wanted="landmark submaps in the plane")
