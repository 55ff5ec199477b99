"""Which steps are the nodes of a refinement, and the path of the steps between them.

A planar scanner sends ten whole scans while the robot moves by its own length: their surfaces are the same, and so are
the errors of their beams. As nodes of their own they cost the cube of their number, and tell nothing new. Nodes are
therefore the steps between which the body moved; what lies between follows the odometry from node to node.
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
    """Numbers ``(m,)`` of the steps that are nodes: first, last, and each that moved enough since the one before.

    In space a step may hold a part of a turn of the scanner only, and all are nodes.

    Parameters
    ----------
    spacing, turn : float
        Way [m] and turn [rad] by the odometry from node to node; a step is one as soon as either is reached.
    """
    n, g = len(steps), steps.group
    if g.dim == 3 or n < 3:
        return np.arange(n, dtype=np.int64)
    u = steps.odometry.increments
    way, turned = np.cumsum(np.hypot(u[:, 0], u[:, 1])), np.cumsum(np.abs(u[:, 2]))
    seen = np.diff(steps.offsets) > 0
    nodes = [0]
    for k in range(1, n - 1):
        if seen[k] and (way[k] - way[nodes[-1]] >= spacing or turned[k] - turned[nodes[-1]] >= turn):
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
    """The same steps with so many beams at most, spread evenly over all there are."""
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
    """Steps along the path of the nodes, each between two of them.

    Parameters
    ----------
    a, b : (n,)
        Numbers of the nodes before and after.
    by_a, by_b : (n, d, d)
        By how much errors of the two move the step, right tangents.
    own : (n, d, d)
        Covariance of a step that it shares with no node.
    """

    a: Index
    b: Index
    by_a: Array
    by_b: Array
    own: Array

    @classmethod
    def at_nodes(cls, n: int, dof: int) -> StepsBetweenNodes:
        """All steps are nodes."""
        every = np.arange(n, dtype=np.int64)
        none = np.zeros((n, dof, dof))
        return cls(every, every, none + np.eye(dof), none, none)


def path_between(
    steps: Scans, nodes: Index, poses: Array, covariances: Array, scales: Array
) -> tuple[Array, Array, StepsBetweenNodes]:
    """All steps along the refined path of the nodes.

    The odometry from node to node is off by what the path tells; how much of that had come about at a step is told by
    its covariance so far (a Gaussian bridge): while wheels stand, hardly anything.

    Parameters
    ----------
    nodes : (m,)
    poses : (m, 7|3)
        Of the nodes.
    covariances : (m, d, d)
    scales : (d,)
        By which the σ of the odometry was widened.

    Returns
    -------
    poses : (n, 7|3)
    covariances : (n, d, d)
        Errors of two nodes in a row are taken to be as alike as they can be.
    between : StepsBetweenNodes
        What steps between nodes do not share with a node holds, where wheels slipped on the way, the jump itself: a
        step at the share s of the way lies before it with the probability 1 - s, and its mean is off by the variance
        s (1 - s) of that.
    """
    g, n = steps.group, len(steps)
    wide = scales[:, None] * scales[None, :]
    steps = replace(steps, odometry=replace(steps.odometry, covariances=steps.odometry.covariances * wide))
    U, P = motion_from_node(steps, nodes)
    a = np.clip(np.searchsorted(nodes, np.arange(n), side="right") - 1, 0, len(nodes) - 2)
    b = a + 1
    whole = scans_at(steps, nodes).odometry
    left = g.log(g.between(whole.increments[b], g.between(poses[a], poses[b])))
    on = g.adjoint(g.between(whole.increments[b], U))  # from an error at the step to one at the node after it
    Q = whole.covariances[b]
    by_b = np.swapaxes(np.linalg.solve(Q, on @ P), 1, 2)
    out = g.compose(g.compose(poses[a], U), g.exp(np.einsum("kij,kj->ki", by_b, left)))
    out[nodes] = poses
    own = P - by_b @ on @ P
    s = np.clip(np.einsum("kii->k", by_b) / g.dof, 0.0, 1.0)[:, None, None]
    # wheels that slipped did so at one instant, which nothing tells: spread evenly is a guess with the jump's own size
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
