"""Where to start: odometry chain, spanning tree, and rotations first (chordal relaxation).

Pose-graph optimisation is not convex; which minimum a local solver reaches is decided here. The chordal relaxation
(Martinec & Pajdla 2007; Carlone, Tron, Daniilidis & Dellaert 2015) drops the constraint that rotations are rotations,
which makes them the solution of one sparse linear system, projects the answer back, and then solves for positions,
which are linear given the rotations.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core import se3
from graphslam.core.geometry import Array, rotation2, se2_transform
from graphslam.core.network import PoseNetwork
from graphslam.solve.network.model import compose, inverse


def identity(network: PoseNetwork, n: int) -> Array:
    """``n`` identity poses."""
    out = np.zeros((n, 3 if network.dim == 2 else 7))
    if network.dim == 3:
        out[:, 6] = 1.0
    return out


def _walk(network: PoseNetwork, order: list[tuple[int, int, bool]]) -> Array:
    """Poses by chaining edges: (edge, vertex to set, whether the edge points at it)."""
    poses = identity(network, len(network))
    anchors = network.anchors
    poses[anchors] = network.poses[anchors]
    z, z_inv = network.measurements, inverse(network.measurements)
    for edge, vertex, forward in order:
        i, j = network.edges[edge]
        poses[vertex] = compose(poses[i] if forward else poses[j], z[edge] if forward else z_inv[edge])
    return poses


def neighbours(network: PoseNetwork) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Adjacency in compressed rows: (first, edge, other vertex), edges of a vertex by other vertex, then edge."""
    m = len(network.edges)
    here = np.concatenate([network.edges[:, 0], network.edges[:, 1]])
    there = np.concatenate([network.edges[:, 1], network.edges[:, 0]])
    edge = np.concatenate([np.arange(m), np.arange(m)])
    order = np.lexsort((edge, there, here))
    first = np.searchsorted(here[order], np.arange(len(network) + 1))
    return first, edge[order], there[order]


def odometry_start(network: PoseNetwork) -> Array:
    """Dead reckoning: every vertex from its predecessor in id order where an edge joins them, else from any edge."""
    n = len(network)
    i, j = network.edges.T
    chain = np.full(n, -1)
    forward = np.flatnonzero(j == i + 1)[::-1]
    backward = np.flatnonzero(i == j + 1)[::-1]
    chain[i[backward]] = backward
    chain[j[forward]] = forward  # an edge that points forward has precedence, the first of several
    first, edge, other = neighbours(network)
    done = np.zeros(n, dtype=bool)
    done[network.anchors] = True
    order: list[tuple[int, int, bool]] = []
    queue = deque(sorted(int(a) for a in network.anchors))
    while queue:
        v = queue.popleft()
        while v + 1 < n and not done[v + 1] and chain[v + 1] >= 0:
            e = int(chain[v + 1])
            order.append((e, v + 1, bool(j[e] == v + 1)))
            done[v + 1] = True
            queue.append(v + 1)
            v += 1
        if done.all():
            break
        # side branches and gaps of the chain, from whatever is known
        for k in range(first[v], first[v + 1]):
            if not done[other[k]]:
                order.append((int(edge[k]), int(other[k]), bool(j[edge[k]] == other[k])))
                done[other[k]] = True
                queue.append(int(other[k]))
    return _walk(network, order)


def tree_start(network: PoseNetwork) -> Array:
    """Breadth-first spanning tree: fewest edges between a vertex and an anchor, so the least accumulated error."""
    first, edge, other = neighbours(network)
    done = np.zeros(len(network), dtype=bool)
    done[network.anchors] = True
    queue = deque(int(a) for a in network.anchors)
    order: list[tuple[int, int, bool]] = []
    while queue:
        v = queue.popleft()
        for k in range(first[v], first[v + 1]):
            w = int(other[k])
            if not done[w]:
                done[w] = True
                order.append((int(edge[k]), w, bool(network.edges[edge[k], 1] == w)))
                queue.append(w)
    return _walk(network, order)


def chordal_start(network: PoseNetwork) -> tuple[Array, Array]:
    """Rotations by the chordal relaxation, then positions (and landmarks) by linear least squares.

    Returns
    -------
    poses : (n, 3) or (n, 7)
    landmarks : (l, 2)
    """
    return translations_from(network, chordal_rotations(network))


def _least_squares(A: sp.csc_matrix, b: Array) -> Array:
    H = sp.csc_matrix(A.conj().T @ A)
    # every vertex of a component without an anchor would be singular; a rounding-size ridge keeps the factor finite
    H = H + sp.identity(H.shape[0], format="csc") * (1e-12 * float(np.abs(H.diagonal()).max()))
    factor = spla.splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.solve(np.asarray(A.conj().T @ b)))


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
            u[free] = _least_squares(A, b)
        return rotation2(np.angle(u))
    # R_jᵀ = Z_ijᵀ R_iᵀ: the columns of Rᵀ obey the same 3n × 3n system
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
        out[free] = _least_squares(A3, rhs).reshape(-1, 3, 3)
    U, _, Vt = np.linalg.svd(np.swapaxes(out, 1, 2))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]  # nearest *rotation*
    return np.asarray(U @ Vt)


def _relaxed(
    own: Array, z: Array, weight: Array, i: Array, j: Array, free: Array, at: Array, known: Array
) -> tuple[sp.csc_matrix, Array]:
    """Rows ``w (u_j - z u_i)``, known values moved to the right."""
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
    (bearing-range observations with their information turned to Cartesian coordinates).
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
        positions[free] = _least_squares(A, b.ravel()).reshape(-1, p)
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
    """Landmark positions ``(l, 2)``: the information-free mean of where each is seen from the given poses."""
    if len(network.landmark_ids) == 0:
        return np.zeros((0, 2))
    i, j = network.observations.T
    local, _ = cartesian_observations(network)
    world = se2_transform(poses[i], local)
    count = np.bincount(j, minlength=len(network.landmark_ids))
    total = np.stack([np.bincount(j, world[:, k], minlength=len(count)) for k in range(2)], axis=1)
    return np.asarray(total / np.maximum(count, 1)[:, None])
