"""Position priors of a pose network: what of its datum they determine, and alignment of initial poses to them.

A *part* is a set of vertices that measurements other than position priors connect. A part without a fixed vertex gets
its frame from the positions: two distinct ones in 2-D, three that are not on one line in 3-D. With fewer some rigid
motions of the part change no residual, and one more edge from the origin fixes just those.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from graphslam.core.geometry import Array
from graphslam.core.network import Index, Mask, PoseNetwork
from graphslam.core.poses import Group, group_of, rotation_matrices
from graphslam.core.se3 import matrix_to_quat, skew

log = logging.getLogger(__name__)
# A rigid motion is not determined if its information is below this share of the largest (lengths relative to the extent
# of the positions).
FREE = 1e-9
# Information [1/rad², 1/m²] that fixes such a motion. It changes no other estimate, and no objective.
HELD = 1e8
# Weight of orientations relative to positions in an alignment, for turns that the positions leave free.
ORIENTATION = 1e-3


def _parts(network: PoseNetwork, *, landmarks: bool) -> npt.NDArray[np.int32]:
    """Number of the part of each vertex ``(n,)``; fixed vertices are all in one part."""
    n = len(network)
    pairs = network.edges[network.relative]
    if landmarks:
        pairs = np.concatenate([pairs, network.observations + [0, n]])
    held = network.anchors
    i, j = np.concatenate([pairs, np.stack([held, np.broadcast_to(held[0], held.shape)], axis=1)]).T
    size = n + len(network.landmark_ids)
    links = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(size, size))
    return np.asarray(connected_components(links, directed=False)[1][:n])


def _motion(group: Group, p: Array, scale: float) -> Array:
    """Derivative ``(k, dim, dof)`` of points by a rigid motion; its turns are in units of ``1 / scale``."""
    out = np.empty((len(p), group.dim, group.dof))
    out[:, :, group.position] = np.eye(group.dim)
    if group.dim == 2:
        out[:, :, 2] = np.stack([-p[:, 1], p[:, 0]], axis=1) / scale
    else:
        out[:, :, :3] = -skew(p) / scale
    return out


def _tangent(group: Group, R: Array, p: Array, scale: float) -> Array:
    """Right tangent ``(dof, dof)`` of a pose with rotation R at p, by the same motion."""
    out = np.zeros((group.dof, group.dof))
    out[group.position] = R.T @ _motion(group, p[None], scale)[0]
    if group.dim == 2:
        out[2, 2] = 1.0 / scale
    else:
        out[:3, :3] = R.T / scale
    return out


class _Frame(NamedTuple):
    """A part without a fixed vertex.

    Parameters
    ----------
    priors : (p,)
        Its position priors.
    others : (q,)
        Other edges that fix directions of its frame.
    """

    priors: Index
    others: Index

    def free_motions(self, network: PoseNetwork, used: Index) -> tuple[int, Array, Array]:
        """What the priors ``used`` leave free.

        Returns
        -------
        vertex : int
            The first one with a prior.
        position : (dim,)
            Its mean.
        motions : (f, dof)
            Maps a right tangent of this vertex to the free motions.
        """
        group, ends = group_of(network.poses), network.edges[:, 1]
        vertex, which = np.unique(ends[used], return_inverse=True)
        total = np.stack([np.bincount(which, network.measurements[used, k]) for k in range(group.dim)], axis=1)
        p = np.asarray(total / np.bincount(which)[:, None], dtype=np.float64)
        p, middle = p - p.mean(axis=0), p.mean(axis=0)
        scale = float(np.linalg.norm(p, axis=1).max()) or 1.0
        J = _motion(group, p, scale)[which]
        G = np.einsum("kia,kij,kjb->ab", J, network.information[used][:, group.position, group.position], J)
        R = rotation_matrices(network.poses[np.append(vertex[0], ends[self.others])])
        for turned, e in zip(R[1:], self.others.tolist(), strict=True):
            C = _tangent(group, turned, network.measurements[e, : group.dim] - middle, scale)
            G += C.T @ network.information[e] @ C
        w, V = np.linalg.eigh(G)
        N = V[:, w <= FREE * w[-1]]
        turns = np.ones(group.dof, dtype=bool)
        turns[group.position] = False
        N[turns] /= scale  # in radians again
        return int(vertex[0]), p[0] + middle, N.T @ np.linalg.inv(_tangent(group, R[0], p[0], scale))


def _frames(network: PoseNetwork, *, landmarks: bool) -> Iterator[tuple[Mask, _Frame]]:
    """Vertices ``(n,)`` of each part with position priors and without a fixed vertex."""
    away = np.flatnonzero(~network.relative)
    if not len(away):
        return
    part = _parts(network, landmarks=landmarks)
    of_edge = part[network.edges[away, 1]]
    for name in np.unique(of_edge[network.position_priors[away]]):
        if name != part[network.anchors[0]]:
            mine, priors = away[of_edge == name], network.position_priors
            yield part == name, _Frame(mine[priors[mine]], mine[~priors[mine]])


def complete_datum(network: PoseNetwork) -> PoseNetwork:
    """The network with an edge from the origin for every part whose position priors do not determine its frame.

    The edge fixes only the motions that are free: with one position the orientation of its vertex in the file, with
    positions on a line the turn about the line, without altitudes the height. A warning names them.
    """
    rows: list[tuple[int, Array, Array]] = []
    for _, frame in _frames(network, landmarks=True):
        v, p, A = frame.free_motions(network, frame.priors)
        if len(A):
            rows.append((v, np.append(p, network.poses[v, network.dim :]), HELD * A.T @ A))
            log.warning(
                "%s: %d position priors leave %d of %d directions of the frame free; vertex %d fixes them by its pose "
                "in the file", network.source, len(frame.priors), len(A), network.tangent_dim, network.ids[v],
            )  # fmt: skip
    if not rows:
        return network
    first, count = int(network.position_priors.argmax()), len(rows)
    origin = network.edges[first, 0]
    return replace(
        network,
        edges=np.insert(network.edges, first, [(origin, v) for v, _, _ in rows], axis=0),
        measurements=np.insert(network.measurements, first, [z for _, z, _ in rows], axis=0),
        information=np.insert(network.information, first, [omega for _, _, omega in rows], axis=0),
        position_priors=np.insert(network.position_priors, first, [False] * count),
    )


def without_position_priors(network: PoseNetwork) -> PoseNetwork:
    """Only the edges between poses; in a part without a fixed vertex the first one is fixed where it is."""
    if not network.position_priors.any():
        return network
    part = _parts(network, landmarks=False)
    fixed = network.fixed.copy()
    name, first = np.unique(part, return_index=True)
    fixed[first[name != part[network.anchors[0]]]] = True
    used = np.concatenate([network.relative, np.ones(len(network.observations), dtype=bool)])
    return replace(network.only(used), fixed=fixed, has_initial=network.has_initial | fixed)


def keep_datum(network: PoseNetwork, used: Mask) -> Mask:
    """``used`` ``(m + k,)`` with all position priors of the parts where it has less than half of them, or too few for
    the frame: most of the positions are not outliers."""
    out = used
    for _, frame in _frames(network, landmarks=False):
        agreed = frame.priors[used[frame.priors]]
        if 2 * len(agreed) < len(frame.priors) or len(frame.free_motions(network, agreed)[2]):
            out = out.copy()
            out[frame.priors] = True
    return out


def align_to_positions(network: PoseNetwork, poses: Array) -> Array:
    """Poses ``(n, 3|7)`` after a rigid motion of each part without a fixed vertex, the nearest to its positions.

    Weighted with their information (Kabsch 1976; Umeyama 1991).
    """
    group, out, d = group_of(poses), poses.copy(), network.dim
    for inside, (near, turned) in _frames(network, landmarks=False):
        v, z = network.edges[near, 1], network.measurements[near, :d]
        weight = np.trace(network.information[near][:, group.position, group.position], axis1=1, axis2=2)
        weight /= weight.sum() or 1.0
        a, b = weight @ poses[v, :d], weight @ z
        p = poses[v, :d] - a
        p[np.linalg.norm(p, axis=1) <= FREE * np.linalg.norm(a)] = 0.0  # rounding is no direction
        B = (z - b).T @ (weight[:, None] * p)
        turns = rotation_matrices(network.measurements[turned]) @ np.swapaxes(
            rotation_matrices(poses[network.edges[turned, 1]]), 1, 2
        )
        B += ORIENTATION * (float(np.linalg.norm(B)) or 1.0) * turns.sum(axis=0)
        U, _, Vt = np.linalg.svd(B)
        U[:, -1] *= np.sign(np.linalg.det(U @ Vt))
        R = U @ Vt
        turn = [np.arctan2(R[1, 0], R[0, 0])] if d == 2 else matrix_to_quat(R)
        out[inside] = group.compose(np.concatenate([b - R @ a, turn]), poses[inside])
    return out
