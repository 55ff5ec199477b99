"""A pose graph of dense submaps as a graph with loops: its places, its chain, and the functions for loop decisions."""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.noise import RobustKernel
from graphslam.graph.relative import relative_poses
from graphslam.loops.candidates import OVERLAP
from graphslam.loops.measure import Loop
from graphslam.loops.places import Ints, Places, places_at_nodes
from graphslam.solve.registry import Solver

GROUP = "loop"
"""Factor class of loops in the graph's objective."""


def places_of_graph(graph: FactorGraph) -> Places:
    """Bases and inner nodes of all submaps of a graph of one chain; place k is node k."""
    if not graph.submaps:
        raise DataError("a graph without submaps has no places")
    for k, s in enumerate(graph.submaps):
        wanted = 0 if k == 0 else graph.submaps[k - 1].exit_node
        if not s.nodes or s.nodes != tuple(range(wanted, wanted + len(s.nodes))):
            raise DataError(
                f"submap {s.key} does not start where the previous one ended: loops need one chain of submaps",
                got=s.nodes[:1],
                wanted=wanted,
            )
    return places_at_nodes([s.T_base_node for s in graph.submaps], [s.times for s in graph.submaps])


def chain_of_graph(graph: FactorGraph) -> tuple[Array, Array]:
    """Increments ``(n, 7|3)`` between nodes and their covariances ``(n, d, d)``, as in the submaps.

    In the graph, the factor of a levelled end pose has no relative roll and pitch; here it has them. For a landmark
    submap it is the end pose only.
    """
    T: list[Array] = []
    P: list[Array] = []
    for s in graph.submaps:
        if isinstance(graph.records.get(s.factor_id), SubmapRecord):
            T.append(s.T_base_node[1])
            P.append(s.stated[0])
            continue
        for k, fid in enumerate(s.factor_ids[: len(s.nodes) - 1]):
            r = graph.records.get(fid)
            if not isinstance(r, BetweenRecord) or (r.i, r.j) != (s.nodes[k], s.nodes[k + 1]):
                raise DataError(f"the chain of submap {s.key} is not whole", got=f"factor {fid}")
            T.append(r.T_ij)
            P.append(s.stated[k])
    return np.stack(T), np.stack(P)


class GraphLoops:
    """A :class:`~graphslam.loops.loops.LoopGraph` of a pose graph.

    Parameters
    ----------
    graph : FactorGraph
        Of one chain of dense submaps; may also have GPS and attitude factors.
    solver : Solver
        Of that graph.
    """

    def __init__(self, graph: FactorGraph, solver: Solver) -> None:
        self.graph, self.solver = graph, solver
        self.places = places_of_graph(graph)

    def relative(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        nodes, at = np.unique(np.concatenate([i, j]), return_inverse=True)
        layout, d = self.graph.flat().layout, self.graph.values.group.dof
        columns = layout.pose_columns(nodes.astype(np.int64))
        free = np.flatnonzero(columns[:, 0] >= 0)
        S = np.zeros((len(nodes), d, len(nodes), d))
        if len(free):
            block = self.graph.covariance().columns(columns[free].ravel())
            S[free[:, None], :, free[None, :]] = block.reshape(len(free), d, len(free), d).transpose(0, 2, 1, 3)
        a, b = at[: len(i)], at[len(i) :]
        x = self.graph.values.poses
        return relative_poses(x[i], x[j], S[a, :, a], S[a, :, b], S[b, :, b])

    def add_loop(self, loop: Loop, robust: RobustKernel) -> int:
        """Add a between-factor as declared ``shared-scan`` evidence."""
        s = self.graph.submaps[int(self.places.submap[loop.j])]
        used = EvidenceUse(["match"], s.interval, "shared-scan")
        g = OVERLAP if loop.source == OVERLAP else GROUP
        return self.graph.add_between(loop.i, loop.j, loop.T_ij, loop.covariance, evidence=used, robust=robust, group=g)

    def remove_loop(self, factor_id: int) -> None:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        self.graph.remove(factor_id, reason="loop switched off")

    def solve(self) -> None:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        self.solver.solve_to_optimum()

    def chi2(self) -> dict[int, float]:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        blocks = self.graph.flat().factor_blocks(self.graph.values)
        return {r.factor_id: float(v) for r, v in zip(blocks.records, blocks.d2)}


class GraphRelativePoses:
    """A :class:`~graphslam.loops.places.RelativePoses` of a graph at its values, which must be its optimum."""

    def __init__(self, graph: FactorGraphState) -> None:
        self.graph = graph

    def __call__(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        nodes, at = np.unique(np.concatenate([i, j]), return_inverse=True)
        a, b = at[: len(i)], at[len(i) :]
        poses, d = self.graph.values.poses, self.graph.values.group.dof
        free = np.flatnonzero(nodes > 0)  # x0 is fixed
        P = self.graph.covariance().joint([f"x{n}" for n in nodes[free]]).reshape(len(free), d, len(free), d)
        S = np.zeros((len(nodes), d, len(nodes), d))
        S[free[:, None], :, free[None, :]] = np.swapaxes(P, 1, 2)
        return relative_poses(poses[i], poses[j], S[a, :, a], S[a, :, b], S[b, :, b])
