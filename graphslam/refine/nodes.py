"""Choose the steps that are nodes of a refinement, and compute the path of the steps between them.

A planar scanner makes about ten scans while the robot moves by its own length: their surfaces are the same, and so are
the errors of their beams. Nodes for all of them cost the cube of their number and add no information. Nodes are
therefore steps after some motion; the steps in between follow the odometry from node to node.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.records import Odometry
from graphslam.refine.motion import SLIPPED
from graphslam.refine.scans import Scans

Index = npt.NDArray[np.int64]


def find_nodes(steps: Scans, spacing: float, turn: float) -> Index:
    """Indices ``(m,)`` of the steps that are nodes: first, last, and each that moved enough since the previous one.

    In 3-D a step may be a part of a scanner revolution only, and all steps are nodes.

    Parameters
    ----------
    spacing, turn : float
        Path length [m] and rotation [rad] of the odometry between nodes; a step is a node if either is reached.
    """
    n, g = len(steps), steps.group
    if g.dim == 3 or n < 3:
        return np.arange(n, dtype=np.int64)
    u = steps.odometry.increments
    along, turned = np.cumsum(np.hypot(u[:, 0], u[:, 1])), np.cumsum(np.abs(u[:, 2]))
    seen = np.diff(steps.offsets) > 0
    nodes = [0]
    for k in range(1, n - 1):
        if seen[k] and (along[k] - along[nodes[-1]] >= spacing or turned[k] - turned[nodes[-1]] >= turn):
            nodes.append(k)
    return np.array([*nodes, n - 1], np.int64)


def scans_at(steps: Scans, nodes: Index) -> Scans:
    """The scans of some steps, with the motion between them."""
    g, o = steps.group, steps.odometry
    increments, covariances = o.increments[nodes].copy(), o.covariances[nodes].copy()
    U, P = motion_from_node(steps, nodes)
    last = nodes[1:] - 1
    increments[1:] = g.compose(U[last], o.increments[nodes[1:]])
    back = g.adjoint(g.inverse(o.increments[nodes[1:]]))
    covariances[1:] += back @ P[last] @ np.swapaxes(back, 1, 2)
    counts = np.diff(steps.offsets)[nodes]
    rows = np.repeat(steps.offsets[nodes] - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    times = steps.times[nodes]
    return replace(
        steps,
        times=times,
        odometry=Odometry(times=times, increments=increments, covariances=covariances),
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=steps.points[rows],
        origins=steps.origins[rows],
        returns=steps.returns[rows],
        ages=None if steps.ages is None else steps.ages[rows],
        tilt=None if steps.tilt is None else steps.tilt[nodes],
    )


def thin_beams(steps: Scans, most: int) -> Scans:
    """The same steps with at most ``most`` beams, thinned evenly."""
    q = len(steps.points)
    if q <= most:
        return steps
    rows = np.arange(most, dtype=np.int64) * q // most
    return replace(
        steps,
        offsets=np.searchsorted(rows, steps.offsets).astype(np.int64),
        points=steps.points[rows],
        origins=steps.origins[rows],
        returns=steps.returns[rows],
        ages=None if steps.ages is None else steps.ages[rows],
    )


def motion_from_node(steps: Scans, nodes: Index) -> tuple[Array, Array]:
    """Motion ``(n, 7|3)`` from the last node to each step, and its covariance ``(n, d, d)``, right tangent."""
    g, o, n = steps.group, steps.odometry, len(steps)
    first = np.zeros(n, bool)
    first[nodes] = True
    U, P = np.tile(g.identity, (n, 1)), np.zeros((n, g.dof, g.dof))
    back = g.adjoint(g.inverse(o.increments))
    for k in range(1, n):
        if not first[k]:
            U[k] = g.compose(U[k - 1], o.increments[k])
            P[k] = back[k] @ P[k - 1] @ back[k].T + o.covariances[k]
    return U, P


@dataclass(frozen=True, slots=True)
class StepsBetweenNodes:
    """Steps between the nodes of a path, with their dependence on the nodes.

    Parameters
    ----------
    a, b : (n,)
        Indices of the previous and the next node.
    by_a, by_b : (n, d, d)
        Derivatives of the step by the errors of these nodes, right tangents.
    own : (n, d, d)
        Covariance of a step that is independent of the nodes.
    """

    a: Index
    b: Index
    by_a: Array
    by_b: Array
    own: Array

    @classmethod
    def at_nodes(cls, n: int, dof: int) -> StepsBetweenNodes:
        """For steps that are all nodes."""
        every = np.arange(n, dtype=np.int64)
        none = np.zeros((n, dof, dof))
        return cls(every, every, none + np.eye(dof), none, none)


def path_between(
    steps: Scans, nodes: Index, poses: Array, covariances: Array, scales: Array
) -> tuple[Array, Array, StepsBetweenNodes]:
    """All steps along the refined path of the nodes.

    The error of the odometry between two nodes is given by the path; its share up to a step is computed from the
    covariance so far (a Gaussian bridge): almost none while the robot is static.

    Parameters
    ----------
    nodes : (m,)
    poses : (m, 7|3)
        Of the nodes.
    covariances : (m, d, d)
    scales : (d,)
        Factors on the σ of the odometry.
    Returns
    -------
    poses : (n, 7|3)
    covariances : (n, d, d)
        Assumes the largest possible correlation between the errors of two consecutive nodes.
    between : StepsBetweenNodes
        After wheel slip, the independent covariance includes the jump: a step at the share s of the interval is before
        it with the probability 1 - s, so the variance of its mean is s (1 - s) times the squared jump.
    """
    g, n = steps.group, len(steps)
    wide = scales[:, None] * scales[None, :]
    steps = replace(steps, odometry=replace(steps.odometry, covariances=steps.odometry.covariances * wide))
    U, P = motion_from_node(steps, nodes)
    a = np.clip(np.searchsorted(nodes, np.arange(n), side="right") - 1, 0, len(nodes) - 2)
    b = a + 1
    whole = scans_at(steps, nodes).odometry
    left = g.log(g.between(whole.increments[b], g.between(poses[a], poses[b])))
    on = g.adjoint(g.between(whole.increments[b], U))  # transforms an error at the step to the next node
    Q = whole.covariances[b]
    by_b = np.swapaxes(np.linalg.solve(Q, on @ P), 1, 2)
    out = g.compose(g.compose(poses[a], U), g.exp(np.einsum("kij,kj->ki", by_b, left)))
    out[nodes] = poses
    own = P - by_b @ on @ P
    s = np.clip(np.einsum("kii->k", by_b) / g.dof, 0.0, 1.0)[:, None, None]
    # wheels slip at one unknown instant: spreading it evenly is a guess with an error of the size of the jump
    inside = np.setdiff1d(np.arange(n), nodes)
    x = np.linalg.solve(Q[inside], left[inside, :, None])[:, :, 0]
    slipped = inside[np.sum(left[inside] * x, axis=1) > SLIPPED]
    own[slipped] += (s * (1.0 - s))[slipped] * left[slipped, :, None] * left[slipped, None, :]
    own = 0.5 * (own + np.swapaxes(own, 1, 2))
    C = own.copy()
    for node, weight in ((a, 1.0 - s), (b, s)):
        A = g.adjoint(g.between(out, poses[node]))
        C += weight * (A @ covariances[node] @ np.swapaxes(A, 1, 2))
    by_a = g.adjoint(g.between(out, poses[a])) - by_b @ g.adjoint(g.between(poses[b], poses[a]))
    C[nodes], own[nodes] = covariances, 0.0
    last = nodes[-1]
    by_a[nodes], by_b[nodes] = np.eye(g.dof), 0.0
    by_a[last], by_b[last] = 0.0, np.eye(g.dof)
    return out, 0.5 * (C + np.swapaxes(C, 1, 2)), StepsBetweenNodes(a, b, by_a, by_b, own)
