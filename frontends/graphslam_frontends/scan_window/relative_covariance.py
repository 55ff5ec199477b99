"""Covariances of where a body is in the frame of its submap, from joint covariances of two poses."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of

LEAST_POSITION, LEAST_ANGLE = 1e-3, 1e-4
"""σ that is added to every covariance [m], [rad]: below what scans can know, and enough to make it invertible."""


def relative_covariance(poses: tuple[Array, Array], frames: tuple[Array, Array], joint: Array) -> Array:
    """Covariance ``(d, d)`` of the motion between two frames that are fixed to the body, right tangent.

    Such a frame may stand level at the body, as bases of submaps do: it does so by what was thought of the body's roll
    and pitch, and is as far off as these were.

    Parameters
    ----------
    poses : (start, end)
        Of the body.
    frames : (start, end)
        That are fixed to the body there; those of the motion.
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
