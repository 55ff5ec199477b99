"""Covariances of poses relative to their submap, from joint covariances of two poses."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of

LEAST_POSITION, LEAST_ANGLE = 1e-3, 1e-4
"""σ added to every covariance [m], [rad]: below the accuracy of scans, and enough to make it invertible."""


def relative_covariance(poses: tuple[Array, Array], frames: tuple[Array, Array], joint: Array) -> Array:
    """Covariance ``(d, d)`` of the motion between two frames that are fixed to the body, right tangent.

    Such a frame may be levelled, as the base of a submap is: it is levelled with the estimated roll and pitch of the
    body, so it has their errors.

    Parameters
    ----------
    poses : (start, end)
        Poses of the body.
    frames : (start, end)
        Frames fixed to the body at these poses; the motion is between them.
    joint : (2 d, 2 d)
        Joint covariance of the right tangents of the poses.
    """
    g = group_of(poses[0])
    (a, b), (A, B) = frames, (g.adjoint(g.between(frame, pose)) for frame, pose in zip(frames, poses))
    J = np.concatenate([-g.adjoint(g.between(b, a)) @ A, B], axis=1)
    least = np.full(g.dof, LEAST_ANGLE)
    least[g.position] = LEAST_POSITION
    C = J @ joint @ J.T + np.diag(least**2)
    return np.asarray(0.5 * (C + C.T))
