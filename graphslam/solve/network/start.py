"""Initialisation: odometry chain, spanning tree, and rotations first (chordal relaxation).

Pose-graph optimisation is not convex; the start decides which minimum a local solver reaches. The chordal relaxation
(Martinec & Pajdla 2007; Carlone, Tron, Daniilidis & Dellaert 2015) drops the orthogonality constraint of rotations,
solves one sparse linear system, projects the result to rotations, and then solves for positions, which are linear given
the rotations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from graphslam.core import se3
from graphslam.core.geometry import Array, rotation2, se2_transform, wrap_angle
from graphslam.core.network import Mask, PoseNetwork
from graphslam.core.poses import group_of, rotation_matrices
from graphslam.core.position_priors import align_to_positions, without_position_priors
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.network import problem_of_network
from graphslam.solve.sparse import MANY, BlockElimination, factorise_sparse

Index = npt.NDArray[np.intp]

# A cycle whose measurements have a larger closing error [rad] is not used to detect extra turns.
UNDECIDED = 2.0 * np.pi / 3.0


def network_arrays(network: PoseNetwork, used: Mask | None = None) -> FactorArrays:
    """Least-squares problem of a network, in an elimination order, unless nested dissection is used later."""
    return problem_of_network(network, used, ordered=len(network) <= MANY[network.dim] or len(network.landmark_ids) > 0)


def neighbours(network: PoseNetwork) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Adjacency in compressed rows: (first, edge, other vertex), edges of a vertex by other vertex, then edge."""
    m = len(network.edges)
    here = np.concatenate([network.edges[:, 0], network.edges[:, 1]])
    there = np.concatenate([network.edges[:, 1], network.edges[:, 0]])
    edge = np.concatenate([np.arange(m), np.arange(m)])
    order = np.lexsort((edge, there, here))
    first = np.searchsorted(here[order], np.arange(len(network) + 1))
    return first, edge[order], there[order]


@dataclass(frozen=True, slots=True)
class SpanningTree:
    """A spanning tree of the edges, rooted at the anchors.

    Parameters
    ----------
    parent : (n,)
        Vertex towards the root; a root is its own parent.
    edge : (n,)
        Edge to the parent, -1 for a root.
    forward : (n,) bool
        Whether the edge points from the parent.
    """

    parent: Index
    edge: Index
    forward: npt.NDArray[np.bool_]

    def rooted(self, step: Array, join: Callable[[Array, Array], Array]) -> Array:
        """``step[root] ∘ … ∘ step[v]`` for every vertex, ``(n, …)``, in log2(depth) rounds."""
        total, up = step.copy(), self.parent.copy()
        while len(move := np.flatnonzero(up != up[up])):
            total[move] = join(total[up[move]], total[move])
            up[move] = up[up[move]]
        below = np.flatnonzero(self.parent != np.arange(len(up)))
        total[below] = join(step[up[below]], total[below])
        return total


def spanning_tree(network: PoseNetwork, *, chain: bool = False) -> SpanningTree:
    """Breadth-first tree: fewest edges between a vertex and an anchor, so the least accumulated error.

    With ``chain`` edges between neighbours in id order have precedence: dead reckoning.
    """
    n, (i, j) = len(network), network.edges.T
    # anchors are connected to one extra node; of parallel edges the first is used, preferably a forward one
    low, high = np.minimum(i, j), np.maximum(i, j)
    order = np.lexsort((np.arange(len(i)), i > j))
    pair, first = np.unique((low * n + high)[order], return_index=True)
    edge, low, high = order[first], pair // n, pair % n
    weight = np.where(high - low == 1, 1.0, 2.0) if chain else np.ones(len(pair))
    anchors = network.anchors
    links = sp.csr_matrix(
        (
            np.concatenate([weight, np.full(len(anchors), 0.5)]),
            (np.concatenate([low, anchors]), np.concatenate([high, np.full(len(anchors), n)])),
        ),
        shape=(n + 1, n + 1),
    )
    if chain:
        links = minimum_spanning_tree(links)
    _, parent = breadth_first_order(links, n, directed=False, return_predecessors=True)
    parent = parent[:n].astype(np.intp)
    vertex = np.arange(n)
    rooted = (parent < 0) | (parent == n)
    parent[rooted] = vertex[rooted]
    key = np.minimum(parent, vertex) * n + np.maximum(parent, vertex)
    used = np.full(n, -1)
    used[~rooted] = edge[np.searchsorted(pair, key[~rooted])]
    return SpanningTree(parent, used, np.where(used >= 0, j[used] == vertex, True))


def tree_poses(network: PoseNetwork, tree: SpanningTree) -> Array:
    """Poses by chaining the measurements of a tree from the anchors."""
    g = group_of(network.poses)
    step = np.tile(g.identity, (len(network), 1))
    roots = tree.edge < 0
    step[network.anchors] = network.poses[network.anchors]
    z = network.measurements[tree.edge[~roots]]
    step[~roots] = np.where(tree.forward[~roots, None], z, g.inverse(z))
    return tree.rooted(step, g.compose)


def odometry_start(network: PoseNetwork) -> Array:
    """Dead reckoning: every vertex from its predecessor in id order if there is an edge, otherwise from any edge."""
    part = without_position_priors(network)
    return align_to_positions(network, tree_poses(part, spanning_tree(part, chain=True)))


def tree_start(network: PoseNetwork) -> Array:
    """Breadth-first spanning tree: fewest edges between a vertex and an anchor, so the least accumulated error."""
    part = without_position_priors(network)
    return align_to_positions(network, tree_poses(part, spanning_tree(part)))


def wound_cycles(network: PoseNetwork, poses: Array) -> tuple[int, int, int]:
    """Cycles of edges along which a solution has a full turn more (or less) than the measurements.

    Given the rotations of a pose network, its positions are linear, so another minimum has other rotations, usually
    with an extra turn in some cycle. Every edge outside a spanning tree closes one cycle. In 2-D the residual angles
    around it must add up to less than half a turn; in 3-D the product of the residual rotations, each lifted to the
    nearer of its two quaternions, must have the sign of the measurements (there, two turns are none). A cycle with a
    closing error of more than a third of a turn is undecided.
    """
    network = without_position_priors(network)
    tree, (i, j) = spanning_tree(network), network.edges.T
    branch = tree.edge >= 0
    chord = np.ones(len(network.edges), dtype=bool)
    chord[tree.edge[branch]] = False
    i, j = i[chord], j[chord]
    if network.dim == 2:
        residual = wrap_angle(
            poses[network.edges[:, 1], 2] - poses[network.edges[:, 0], 2] - network.measurements[:, 2]
        )
        step = np.zeros(len(network))
        step[branch] = np.where(tree.forward[branch], 1.0, -1.0) * residual[tree.edge[branch]]
        along = tree.rooted(step, np.add)
        around = along[i] + residual[chord] - along[j]
        decided = np.abs(wrap_angle(around)) < UNDECIDED
        wound = np.abs(around) > np.pi
    else:
        q = network.measurements[:, 3:]
        step = np.tile([0.0, 0.0, 0.0, 1.0], (len(network), 1))
        turns = q[tree.edge[branch]]
        step[branch] = np.where(tree.forward[branch, None], turns, turns * [-1.0, -1.0, -1.0, 1.0])
        measured = tree.rooted(step, se3.quat_multiply)
        # signs of the poses' quaternions such that no edge of the tree turns by more than half a turn
        x = poses[:, 3:]
        turned = np.sum(se3.quat_multiply(x[tree.parent], step) * x, axis=1)
        x = x * tree.rooted(np.where(branch & (turned < 0.0), -1.0, 1.0), np.multiply)[:, None]
        closes = np.sum(se3.quat_multiply(measured[i], q[chord]) * measured[j], axis=1)
        solved = np.sum(se3.quat_multiply(x[i], q[chord]) * x[j], axis=1)
        decided = np.abs(closes) > np.cos(UNDECIDED / 2.0)
        wound = closes * solved < 0.0
    return int((wound & decided).sum()), int((~decided).sum()), len(i)


def chordal_start(network: PoseNetwork) -> tuple[Array, Array]:
    """Rotations by the chordal relaxation, then positions (and landmarks) by linear least squares.

    Returns
    -------
    poses : (n, 3) or (n, 7)
    landmarks : (l, 2)
    """
    part = without_position_priors(network)
    found = translations_from(part, chordal_rotations(part))
    if part is network:
        return found
    aligned = align_to_positions(network, found[0])
    turns = rotation_matrices(aligned)
    return translations_from(network, turns)


def _least_squares(A: sp.csc_matrix, b: Array, width: int) -> Array:
    """Least squares of variables of ``width`` real scalars each (a complex number is two)."""
    H = sp.csc_matrix(A.conj().T @ A)
    # a component without an anchor would be singular; a tiny ridge keeps the factor finite
    H = sp.csc_matrix(H + sp.identity(H.shape[0], format="csc") * (1e-12 * float(np.abs(H.diagonal()).max())))
    rhs = np.asarray(A.conj().T @ b)
    whole = np.iscomplexobj(rhs)
    if H.shape[0] // (1 if whole else width) <= MANY[width]:
        return np.asarray(factorise_sparse(H).solve(rhs))
    lu = BlockElimination(H, width).factor(H)
    if whole:
        x = lu.solve(np.stack([rhs.real, rhs.imag], axis=1).ravel()).reshape(-1, 2)
        return np.asarray(x[:, 0] + 1j * x[:, 1])
    return np.stack([lu.solve(column) for column in rhs.reshape(len(rhs), -1).T], axis=1).reshape(rhs.shape)


def chordal_rotations(network: PoseNetwork) -> Array:
    """Rotations ``(n, dim, dim)`` minimising ``Σ κ ‖R_j - R_i Z_ij‖²`` without the orthogonality constraint, projected.

    κ is the mean rotational information of an edge. In 2-D a rotation is one complex number.
    """
    n, (i, j) = len(network), network.edges.T
    free = np.ones(n, dtype=bool)
    free[network.anchors] = False
    at = np.cumsum(free) - 1
    if network.dim == 2:
        weight = np.sqrt(network.information[:, 2, 2])
        z = np.exp(1j * network.measurements[:, 2])
        known = np.where(free, 0.0, np.exp(1j * network.poses[:, 2]))
        A, b = _relaxed(np.ones_like(z), z, weight, i, j, free, at, known)
        u = known.copy()
        if free.any():
            u[free] = _least_squares(A, b, 2)
        return rotation2(np.angle(u))
    # R_jᵀ = Z_ijᵀ R_iᵀ: the columns of Rᵀ solve the same 3n × 3n system
    weight = np.sqrt(np.trace(network.information[:, :3, :3], axis1=1, axis2=2) / 3.0)
    Zt = np.swapaxes(se3.quat_to_matrix(network.measurements[:, 3:]), 1, 2)
    known3 = np.swapaxes(se3.quat_to_matrix(network.poses[:, 3:]), 1, 2)
    m, rows, size = len(i), 3 * np.arange(len(i)), 3 * int(free.sum())
    r9 = (rows[:, None, None] + np.arange(3)[:, None] + np.zeros(3, dtype=int)).ravel()
    parts = []
    rhs = np.zeros((3 * m, 3))
    for vertex, block in ((j, np.broadcast_to(np.eye(3), (m, 3, 3))), (i, -Zt)):
        w = weight[:, None, None] * block
        columns = (3 * at[vertex][:, None, None] + np.arange(3) + np.zeros((3, 1), dtype=int)).ravel()
        keep = np.repeat(free[vertex], 9)
        parts.append((w.ravel()[keep], r9[keep], columns[keep]))
        held = ~free[vertex]
        rhs.reshape(m, 3, 3)[held] -= w[held] @ known3[vertex[held]]
    values, r, c = (np.concatenate(p) for p in zip(*parts, strict=True))
    out = known3.copy()
    if size:
        A3 = sp.csc_matrix((values, (r, c)), shape=(3 * m, size))
        out[free] = _least_squares(A3, rhs, 3).reshape(-1, 3, 3)
    U, _, Vt = np.linalg.svd(np.swapaxes(out, 1, 2))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]  # nearest *rotation*
    return np.asarray(U @ Vt)


def _relaxed(
    own: Array, z: Array, weight: Array, i: Array, j: Array, free: Array, at: Array, known: Array
) -> tuple[sp.csc_matrix, Array]:
    """Rows ``w (u_j - z u_i)``, known values moved to the right-hand side."""
    m = np.arange(len(i))
    keep_i, keep_j = free[i], free[j]
    values = np.concatenate([(weight * own)[keep_j], (-weight * z)[keep_i]])
    rows = np.concatenate([m[keep_j], m[keep_i]])
    columns = np.concatenate([at[j[keep_j]], at[i[keep_i]]])
    b = weight * (np.where(keep_i, 0.0, z * known[i]) - np.where(keep_j, 0.0, known[j]))
    return sp.csc_matrix((values, (rows, columns)), shape=(len(i), int(free.sum()))), b


def translations_from(network: PoseNetwork, rotations: Array) -> tuple[Array, Array]:
    """Positions and landmarks by linear least squares, given rotations ``(n, dim, dim)``.

    Minimises ``Σ ‖R_iᵀ(t_j - t_i) - z‖²_Ω + Σ ‖R_iᵀ(l - t_i) - z‖²_Ω`` with the translational blocks of Ω
    (bearing-range observations with their information transformed to Cartesian coordinates).
    """
    n, l, p = len(network), len(network.landmark_ids), network.dim
    free = np.ones(n + l, dtype=bool)
    free[network.anchors] = False
    at = np.cumsum(free) - 1
    known = np.zeros((n + l, p))
    known[network.anchors] = network.poses[network.anchors, :p]
    block = slice(0, 2) if p == 2 else slice(3, 6)
    pairs, z = network.edges, network.measurements[:, :p]
    omega = network.information[:, block, block]
    if len(network.observations):
        values, information = cartesian_observations(network)
        pairs = np.concatenate([pairs, network.observations + [0, n]])
        z, omega = np.concatenate([z, values]), np.concatenate([omega, information])
    i, j = pairs.T
    # whitening in the world frame: S (t_j - t_i) = S R_i z with SᵀS = R_i Ω R_iᵀ
    Ri = rotations[i]
    w, V = np.linalg.eigh(omega)
    S = np.sqrt(np.maximum(w, 0.0))[:, :, None] * np.swapaxes(Ri @ V, 1, 2)
    m = len(i)
    b = np.einsum("mij,mj->mi", S @ Ri, z)
    b += np.einsum("mij,mj->mi", S, known[i] - known[j])
    rows = np.broadcast_to((np.arange(m)[:, None] * p + np.arange(p))[:, :, None], S.shape)
    parts = []
    for vertex, sign in ((j, 1.0), (i, -1.0)):
        columns = np.broadcast_to(p * at[vertex][:, None, None] + np.arange(p), S.shape)
        keep = np.broadcast_to(free[vertex][:, None, None], S.shape)
        parts.append(((sign * S)[keep], rows[keep], columns[keep]))
    values, r, c = (np.concatenate(q) for q in zip(*parts, strict=True))
    positions = known.copy()
    if free.any():
        A = sp.csc_matrix((values, (r, c)), shape=(m * p, p * int(free.sum())))
        positions[free] = _least_squares(A, b.ravel(), p).reshape(-1, p)
    if p == 2:
        poses = np.concatenate([positions[:n], np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])[:, None]], axis=1)
    else:
        poses = np.concatenate([positions[:n], se3.matrix_to_quat(rotations)], axis=1)
    poses[network.anchors] = network.poses[network.anchors]
    return poses, positions[n:].reshape(l, p) if l else np.zeros((0, 2))


def cartesian_observations(network: PoseNetwork) -> tuple[Array, Array]:
    """Observations as x, y in the vertex frame ``(k, 2)`` with their information ``(k, 2, 2)``, to first order."""
    z, omega = network.observation_values, network.observation_information
    if network.observation_kind == "cartesian":
        return z, omega
    b, r = z.T
    local = np.stack([r * np.cos(b), r * np.sin(b)], axis=1)
    J = np.empty((len(z), 2, 2))  # d(bearing, range) / d(x, y)
    J[:, 0, 0], J[:, 0, 1] = -np.sin(b) / r, np.cos(b) / r
    J[:, 1, 0], J[:, 1, 1] = np.cos(b), np.sin(b)
    return local, np.swapaxes(J, 1, 2) @ omega @ J


def landmarks_from(network: PoseNetwork, poses: Array) -> Array:
    """Landmark positions ``(l, 2)``: the unweighted mean of its observations from the given poses."""
    if len(network.landmark_ids) == 0:
        return np.zeros((0, 2))
    i, j = network.observations.T
    local, _ = cartesian_observations(network)
    world = se2_transform(poses[i], local)
    count = np.bincount(j, minlength=len(network.landmark_ids))
    total = np.stack([np.bincount(j, world[:, k], minlength=len(count)) for k in range(2)], axis=1)
    return np.asarray(total / np.maximum(count, 1)[:, None])
