"""A chain of submaps with loops, solved by itself: what loops are decided against where there is no larger graph.

Nodes are the places of the chain and its end, the first is held. Gauss-Newton with the loops' robust weights; joint
marginals by sparse solves on the columns that are asked for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core.errors import DataError, IndeterminateError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import compose_increments, group_of
from graphslam.graph.noise import RobustKernel
from graphslam.graph.relative import relative_poses
from graphslam.loops.measure import Loop
from graphslam.loops.places import Ints
from graphslam.solve.sparse import factorise_sparse
from tests.reference.plain_network import Layout, edge_costs, linearise

ITERATIONS = 50
STEP = 1e-7
"""Gauss-Newton ends with a step smaller than this [m, rad] …"""
GAIN = 1e-9
"""… or a relative gain of the objective smaller than this."""


class LoopNetwork:
    """A :class:`~graphslam.loops.loops.LoopGraph` of a chain alone.

    Parameters
    ----------
    increments, covariances : (n, 7|3), (n, d, d)
        From node k to node k + 1, right tangents (:class:`~tests.reference.chain_poses.ChainRelativePoses`).

    Raises
    ------
    CovarianceError
        A covariance that is none.
    """

    def __init__(self, increments: Array, covariances: Array) -> None:
        g = group_of(increments)
        for k, P in enumerate(covariances):
            check_covariance(P, what=f"covariance of increment {k}", dim=g.dof)
        self._poses = compose_increments(increments)
        n = len(increments)
        self._ends = [(k, k + 1) for k in range(n)]
        self._measured = [T.copy() for T in increments]
        self._information = [np.linalg.inv(P) for P in covariances]
        self._ids = list(range(n))
        self._kernels: list[RobustKernel | None] = [None] * n
        self._next = n
        self._factored: spla.SuperLU | None = None

    # ---------------------------------------------------------------- what a LoopGraph has

    @property
    def poses(self) -> Array:
        """Of all nodes in the frame of the first ``(n + 1, 7|3)``."""
        return self._poses

    def add_loop(self, loop: Loop, robust: RobustKernel) -> int:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        if not (min(loop.i, loop.j) >= 0 and max(loop.i, loop.j) < len(self._poses) and loop.i != loop.j):
            raise DataError("a loop joins nodes that are not there", got=(loop.i, loop.j), wanted=len(self._poses))
        P = check_covariance(loop.covariance, what="covariance of a loop", dim=group_of(self._poses).dof)
        self._ends.append((loop.i, loop.j))
        self._measured.append(np.array(loop.T_ij))
        self._information.append(np.linalg.inv(P))
        self._kernels.append(robust)
        self._ids.append(self._next)
        self._next += 1
        self._factored = None
        return self._next - 1

    def remove_loop(self, factor_id: int) -> None:
        """See :class:`~graphslam.loops.loops.LoopGraph`; the chain cannot be removed."""
        if factor_id not in self._ids or self._kernels[self._ids.index(factor_id)] is None:
            raise DataError(f"factor {factor_id} is no loop of this network")
        k = self._ids.index(factor_id)
        for column in (self._ends, self._measured, self._information, self._kernels, self._ids):
            del column[k]  # type: ignore[attr-defined]
        self._factored = None

    def solve(self) -> None:
        """Gauss-Newton to the optimum, loops reweighted at every step; halved steps where one does not help."""
        net = self._network()
        layout = Layout.of(net)
        marks = np.zeros((0, 2))
        cost = self._cost(net, self._poses)
        for _ in range(ITERATIONS):
            weighted = self._weighted(net, self._poses)
            J, r = linearise(weighted, self._poses, marks, layout)
            step = -self._factor(J).solve(J.T @ r)
            scale, moved, new = 1.0, self._poses, cost
            for _ in range(20):
                moved, _ = layout.retract(self._poses, marks, scale * step)
                new = self._cost(net, moved)
                if new <= cost:
                    break
                scale *= 0.5
            else:
                break
            done = np.abs(scale * step).max() < STEP or cost - new < GAIN * (1.0 + cost)
            self._poses, cost = moved, new
            if done:
                break
        self._factored = None

    def chi2(self) -> dict[int, float]:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        return dict(zip(self._ids, edge_costs(self._network(), self._poses).tolist()))

    def relative(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        """See :class:`~graphslam.loops.loops.LoopGraph`."""
        nodes, at = np.unique(np.concatenate([i, j]), return_inverse=True)
        a, b = at[: len(i)], at[len(i) :]
        S = self.joint(nodes)
        return relative_poses(self._poses[i], self._poses[j], S[a, :, a], S[a, :, b], S[b, :, b])

    def joint(self, nodes: Ints) -> Array:
        """Joint covariance ``(k, d, k, d)`` of nodes, right tangents; zeros for the first, which is held."""
        if self._factored is None:
            net = self._network()
            J, _ = linearise(self._weighted(net, self._poses), self._poses, np.zeros((0, 2)), Layout.of(net))
            self._factored = self._factor(J)
        d, k = group_of(self._poses).dof, len(nodes)
        free = np.flatnonzero(nodes > 0)
        rows = ((nodes[free] - 1)[:, None] * d + np.arange(d)).ravel()
        B = np.zeros((self._factored.shape[0], len(rows)))
        B[rows, np.arange(len(rows))] = 1.0
        block = self._factored.solve(B)[rows].reshape(len(free), d, len(free), d)
        S = np.zeros((k, d, k, d))
        S[free[:, None], :, free[None, :]] = np.swapaxes(block, 1, 2)
        return S

    # ---------------------------------------------------------------- inside

    def _network(self) -> PoseNetwork:
        n = len(self._poses)
        return PoseNetwork(
            dim=group_of(self._poses).dim,
            ids=np.arange(n),
            poses=self._poses,
            has_initial=np.ones(n, dtype=np.bool_),
            edges=np.array(self._ends, dtype=np.intp),
            measurements=np.stack(self._measured),
            information=np.stack(self._information),
            source="chain of submaps",
        )

    def _weights(self, costs: Array) -> Array:
        return np.array([1.0 if k is None else float(k.weight(np.array([c]))[0]) for k, c in zip(self._kernels, costs)])

    def _weighted(self, net: PoseNetwork, poses: Array) -> PoseNetwork:
        w = self._weights(edge_costs(net, poses))
        return replace(net, information=net.information * w[:, None, None])

    def _cost(self, net: PoseNetwork, poses: Array) -> float:
        c = edge_costs(net, poses)
        return float(sum(x if k is None else float(k.loss(np.array([x]))[0]) for k, x in zip(self._kernels, c)))

    def _factor(self, J: sp.csr_matrix) -> spla.SuperLU:
        try:
            return factorise_sparse(sp.csc_matrix(J.T @ J))
        except (RuntimeError, np.linalg.LinAlgError):
            raise IndeterminateError("the chain with its loops does not determine its poses") from None
