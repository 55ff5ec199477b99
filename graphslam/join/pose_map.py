"""Maps of poses in information form, joined by adding their matrices.

Every node is perturbed on the right, ``X_i Exp(ξ_i)``, and the base of a map is kept *in* its matrix, which the gauge
therefore makes singular. A relative pose then has the Jacobians ``J_j = J_r⁻¹(r)``, ``J_i = -J_r⁻¹(r) Ad(X_j⁻¹ X_i)``:
functions of relative poses alone, so that **the matrix of a map is the same in every frame**. To join B, whose base is
the end of A, is to write ``X_i = A.end ∘ B.X_i`` and to add the two matrices, which share one block: no Jacobian, no
residual. Ties of which one end lies in A and the other in B then enter by Gauss–Newton steps with the base struck out,

    ξ = -(I + Jᵀ J)⁻¹ Jᵀ r,   X ← X Exp(ξ),   I ← Tᵀ (I + Jᵀ J) T,   T = blkdiag(J_r⁻¹(ξ_i)),

and carrying the matrix over to the new point fills nothing in. Passes beyond the first linearise the ties afresh and
carry the prior along: matrix ``Tᵀ I T``, gradient ``Tᵀ I ξ``.

Where bases are levelled, a map also knows which way is up: a frame ``U`` whose z axis points there, with the tangent
``U Exp([τ_x, τ_y, 0])``. What a node sees of gravity depends on ``X_i⁻¹ U`` alone, so it is free of the frame as well.
Two maps that are joined both know it; that is a measurement, and the only one that a join without ties makes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.core.poses import SE3, Group, group_of
from graphslam.core.se3 import quat_rotate, so3_exp, so3_left_jacobian
from graphslam.join.joined_map import JoinTimes
from graphslam.join.pose_problem import PoseProblem, RelativePoseFactors
from graphslam.linear.block_cholesky import BlockSymbolic
from graphslam.linear.symmetric_factor import elimination_order
from graphslam.solve.batch import optimise_problem
from graphslam.solve.sparse import SparseProblem

Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SymmetricBlocks:
    """A symmetric matrix of blocks ``(d, d)``: the upper triangle, every pair of nodes once, in rising order.

    The last node is the level frame; of its blocks only the first two rows and columns mean anything.

    Parameters
    ----------
    pairs : (nb, 2)
        ``i ≤ j``.
    values : (nb, d, d)
        Rows of i, columns of j.
    """

    pairs: Index
    values: Array

    @classmethod
    def summed(cls, pairs: Index, values: Array) -> SymmetricBlocks:
        """Of blocks in any order and triangle, those of one pair added."""
        swap = pairs[:, 0] > pairs[:, 1]
        pairs = np.where(swap[:, None], pairs[:, ::-1], pairs)
        values = np.where(swap[:, None, None], np.swapaxes(values, 1, 2), values)
        if not len(pairs):
            return cls(pairs, values)
        key = pairs[:, 0] * (pairs[:, 1].max() + 1) + pairs[:, 1]
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        return cls(pairs[order[first]], np.add.reduceat(values[order], first, axis=0))

    def __add__(self, other: SymmetricBlocks) -> SymmetricBlocks:
        return SymmetricBlocks.summed(
            np.concatenate([self.pairs, other.pairs]), np.concatenate([self.values, other.values])
        )

    def __matmul__(self, vector: Array) -> Array:
        """Product with ``(n, d)``."""
        (i, j), out = self.pairs.T, np.zeros_like(vector)
        np.add.at(out, i, np.einsum("bij,bj->bi", self.values, vector[j]))
        off = i != j
        np.add.at(out, j[off], np.einsum("bij,bi->bj", self.values[off], vector[i[off]]))
        return out

    def carried(self, T: Array) -> SymmetricBlocks:
        """``Tᵀ A T`` for ``T`` ``(n, d, d)``, block by block."""
        i, j = self.pairs.T
        return SymmetricBlocks(self.pairs, np.swapaxes(T[i], 1, 2) @ self.values @ T[j])


@dataclass(frozen=True, eq=False)
class PoseMap:
    """A map of poses and, in space, of the direction up, in the frame of its base.

    Parameters
    ----------
    poses : (n, 3|7)
        ``T_base_node``; the first is the identity, the last the end of the map.
    up : (7,) or None
        Level frame, its position of no meaning.
    information : SymmetricBlocks
        Over the nodes, the base among them; node n is ``up``.
    """

    poses: Array
    up: Array | None
    information: SymmetricBlocks

    @property
    def group(self) -> Group:
        """SE(2) or SE(3)."""
        return group_of(self.poses)

    @property
    def size(self) -> int:
        """Free scalars."""
        return self.group.dof * (len(self.poses) - 1) + 2 * (self.up is not None)

    def matrix(self) -> sp.csc_matrix:
        """Information matrix ``(size, size)`` without the base, both triangles; the level frame stands last."""
        d, n = self.group.dof, len(self.poses)
        pairs, values = self.information.pairs, self.information.values
        free = pairs[:, 0] > 0
        pairs, values = pairs[free], values[free]
        off = pairs[:, 0] < pairs[:, 1]
        pairs = np.concatenate([pairs, pairs[off, ::-1]])
        values = np.concatenate([values, np.swapaxes(values[off], 1, 2)])
        at = d * (pairs - 1)
        rows = at[:, 0, None, None] + np.arange(d)[:, None] + np.zeros((d, d), dtype=np.int64)
        columns = at[:, 1, None, None] + np.arange(d) + np.zeros((d, d), dtype=np.int64)
        keep = (rows < self.size) & (columns < self.size)
        assert self.up is None or self.size == d * (n - 1) + 2
        return sp.csc_matrix((values[keep], (rows[keep], columns[keep])), shape=(self.size, self.size))

    @classmethod
    def leaf(cls, part: PoseProblem) -> PoseMap:
        """One submap, at its own optimum."""
        poses, up = part.start, None
        if part.levelled or len(part.ends) >= len(part.times):
            best = optimise_problem(SparseProblem(part.flat), part.values(poses, _first_tilt(part))).values
            poses = best.poses
            up = None if best.tilt is None else _frame(so3_exp(np.append(best.tilt, 0.0)))
        d = part.group.dof
        nothing = cls(poses, up, SymmetricBlocks(np.zeros((0, 2), dtype=np.int64), np.zeros((0, d, d))))
        return cls(poses, up, nothing.linearised(part)[0])

    def linearised(self, ties: RelativePoseFactors) -> tuple[SymmetricBlocks, Array]:
        """``Jᵀ J`` and ``Jᵀ r`` ``(n + 1, d)`` of ties here."""
        n, d = len(self.poses), self.group.dof
        r, J, s, K = ties.whitened(self.poses, self.up)
        K = np.concatenate([K, np.zeros((len(K), 2, 2 * d - 8))], axis=2) if len(K) else np.zeros((0, 2, 2 * d))
        ends = np.concatenate([ties.ends, np.stack([ties.level_nodes, np.full(len(ties.level_nodes), n)], axis=1)])
        if len(K) == 0:
            ends = ties.ends
        H = np.concatenate([np.swapaxes(A, 1, 2) @ A for A in (J, K)])
        g = np.concatenate([np.einsum("mij,mi->mj", A, b) for A, b in ((J, r), (K, s))])
        (i, j), gradient = ends.T, np.zeros((n + 1, d))
        np.add.at(gradient, i, g[:, :d])
        np.add.at(gradient, j, g[:, d:])
        pairs = np.concatenate([np.stack(p, axis=1) for p in ((i, i), (j, j), (i, j))])
        return SymmetricBlocks.summed(pairs, np.concatenate([H[:, :d, :d], H[:, d:, d:], H[:, :d, d:]])), gradient

    def moved(self, step: Array) -> PoseMap:
        """Values after a step ``(n + 1, d)``; the matrix stays."""
        g, n = self.group, len(self.poses)
        up = None if self.up is None else SE3.compose(self.up, _frame(so3_exp(np.append(step[n, :2], 0.0))))
        return PoseMap(g.compose(self.poses, g.exp(step[:n])), up, self.information)

    def tangents(self, step: Array) -> Array:
        """``T`` ``(n + 1, d, d)``: small steps after ``step`` as they change it."""
        g, n = self.group, len(self.poses)
        T = np.broadcast_to(np.eye(g.dof), (n + 1, g.dof, g.dof)).copy()
        T[:n] = np.linalg.inv(g.right_jacobian(step[:n]))
        if self.up is not None:
            T[n, :2, :2] = level_tangent(step[n, :2])
        return T

    def solve(self, A: SymmetricBlocks, gradient: Array) -> Array:
        """Step ``(n + 1, d)`` of ``A ξ = -gradient`` with the base held."""
        n, d = len(self.poses), self.group.dof
        N = n - 1 + (self.up is not None)
        width = np.full(N, d, dtype=np.int64)
        width[n - 1 :] = 2
        free = A.pairs[:, 0] > 0
        pairs, values = A.pairs[free] - 1, A.values[free]
        order = elimination_order(pairs[:, 0], pairs[:, 1], N).astype(np.int64)
        # a block is read from the list of the node that is eliminated first
        place = np.argsort(order)
        swap = place[pairs[:, 0]] > place[pairs[:, 1]]
        pairs[swap] = pairs[swap, ::-1]
        values[swap] = np.swapaxes(values[swap], 1, 2)
        by_row = np.argsort(pairs[:, 0], kind="stable")
        pairs = pairs[by_row]
        rows, columns = width[pairs].T
        at = np.cumsum(rows * columns) - rows * columns
        flat = np.empty(int((rows * columns).sum()))
        for height, span in ((d, d), (d, 2), (2, d), (2, 2)):
            here = np.flatnonzero((rows == height) & (columns == span))
            cut = values[by_row[here], :height, :span]
            flat[at[here, None] + np.arange(height * span)] = cut.reshape(len(here), height * span)
        ptr = np.searchsorted(pairs[:, 0], np.arange(N + 1))
        symbolic = BlockSymbolic(order, width, ptr, np.ascontiguousarray(pairs[:, 1]))
        x = symbolic.factor(at, flat).solve(-gradient[1:].ravel()[: int(width.sum())])
        step = np.zeros((n + 1, d))
        step[1:].ravel()[: len(x)] = x
        return step

    def updated(
        self, ties: RelativePoseFactors, times: JoinTimes, *, passes: int = 1, gradient: Array | None = None
    ) -> PoseMap:
        """The map after ties between its nodes.

        Parameters
        ----------
        times : JoinTimes
            Where to add the time spent.
        passes : int
            How often they are linearised.
        gradient : (n + 1, d), optional
            Of what the map's matrix says, here; zero if not given.
        """
        here, total = self, np.zeros((len(self.poses) + 1, self.group.dof))
        slope = total if gradient is None else gradient
        for k in range(passes):
            with times.measure("update"):
                T = self.tangents(total)
                H, g = here.linearised(ties)
                H = H + (self.information.carried(T) if k else self.information)
                g = g + np.einsum("nij,ni->nj", T, slope + self.information @ total)
            with times.measure("recovery"):
                step = here.solve(H, g)
            with times.measure("update"):
                reached = here.moved(step)
                total = self.step_to(reached)
                if k + 1 < passes:
                    here = self.moved(total)
        with times.measure("update"):
            return PoseMap(reached.poses, reached.up, H.carried(here.tangents(step)))

    def step_to(self, other: PoseMap) -> Array:
        """The step ``(n + 1, d)`` that leads from the values here to others."""
        g, n = self.group, len(self.poses)
        step = np.zeros((n + 1, g.dof))
        step[:n] = g.log(g.between(self.poses, other.poses))
        if self.up is not None and other.up is not None:
            step[n, :2] = level_step(self.up, other.up)
        return step


def join_poses(a: PoseMap, b: PoseMap, ties: RelativePoseFactors, times: JoinTimes, *, passes: int = 1) -> PoseMap:
    """Join B, whose base is the end of A, and the ties of which one end lies in each.

    Parameters
    ----------
    ties : RelativePoseFactors
        Nodes counted from the base of A; node ``len(a.poses) - 1`` is the base of B, ``len(a.poses)`` its next one.
    passes : int
        How often the ties are linearised.
    """
    with times.measure("update"):
        g, na, nb = a.group, len(a.poses), len(b.poses)
        n = na + nb - 1
        poses = np.concatenate([a.poses, g.compose(a.poses[-1], b.poses[1:])])
        image_a, image_b = np.append(np.arange(na), n), np.append(na - 1 + np.arange(nb), n)
        A, B, up = a.information, b.information, a.up
        gradient = None
        if b.up is not None:
            seen = SE3.compose(a.poses[-1], b.up)
            up = seen
            if a.up is not None:  # both know it: B's word of it is now a step away from where the two agree to put it
                step = np.zeros((nb + 1, g.dof))
                step[nb, :2], turn, up = level_meeting(a.up, seen)
                pull = B @ step
                T = b.tangents(step)
                B = B.carried(T)
                gradient = np.zeros((n + 1, g.dof))
                gradient[image_b] = np.einsum("nij,ni->nj", T, pull)
                R = np.broadcast_to(np.eye(g.dof), (na + 1, g.dof, g.dof)).copy()
                R[na, :2, :2] = turn.T
                A = A.carried(R)
        joined = PoseMap(
            poses,
            up,
            SymmetricBlocks.summed(
                np.concatenate([image_a[A.pairs], image_b[B.pairs]]), np.concatenate([A.values, B.values])
            ),
        )
    if gradient is None and not len(ties):
        return joined
    return joined.updated(ties, times, passes=passes, gradient=gradient)


# ---------------------------------------------------------------- the level frame


def level_step(frame: Array, other: Array) -> Array:
    """Turn ``(2,)`` about x and y of a level frame that leads its z axis to that of another."""
    x, y, z = quat_rotate(SE3.between(frame, other)[3:], np.array([0.0, 0.0, 1.0]))
    sine = np.hypot(x, y)
    scale = 1.0 if sine < 1e-12 else np.arctan2(sine, z) / sine
    return scale * np.array([-y, x])


def level_tangent(step: Array) -> Array:
    """How a small turn after ``step`` changes it ``(2, 2)``, turns about the z axis of the frame left aside."""
    J_r = so3_left_jacobian(-np.append(step, 0.0))
    return np.asarray(np.linalg.inv(J_r[:2, :2]))


def level_meeting(mine: Array, seen: Array) -> tuple[Array, Array, Array]:
    """Two frames of one direction: the step from ``seen`` to where ``mine`` points, the turn ``(2, 2)`` from tangents
    of ``mine`` to those of the common frame, and that frame."""
    step = level_step(seen, mine)
    common = SE3.compose(seen, _frame(so3_exp(np.append(step, 0.0))))
    c, s, _ = quat_rotate(SE3.between(common, mine)[3:], np.array([1.0, 0.0, 0.0]))
    return step, np.array([[c, -s], [s, c]]), common


def _frame(quaternion: Array) -> Array:
    return np.concatenate([np.zeros(3), quaternion])


def _first_tilt(part: PoseProblem) -> Array | None:
    """Where up is, by the first node that saw gravity."""
    if not part.levelled:
        return None
    seen = -quat_rotate(part.start[part.level_nodes[0], 3:], part.directions[0])
    x, y, z = seen
    sine = np.hypot(x, y)
    return np.zeros(2) if sine < 1e-12 else np.arctan2(sine, z) / sine * np.array([-y, x])
