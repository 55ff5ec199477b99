"""Position of the antenna in the frame of a base, and its covariance, at given times."""

from __future__ import annotations

from graphslam.core.geometry import Array
from graphslam.core.trajectory import Trajectory
from graphslam.graph.sensors.gps import lever_arm


def antenna_in_base(trajectory: Trajectory, times: Array, lever: Array) -> tuple[Array, Array]:
    """Antenna in the base frame, and its covariance from the submap's own trajectory.

    Parameters
    ----------
    trajectory : Trajectory
        ``T_start_body(t)``; covariances in the right tangent, none = the arm is taken as exact.
    times : (q,)
    lever : (dim,)
        Antenna in the body frame [m].

    Returns
    -------
    arm : (q, dim)
    covariance : (q, dim, dim)
        See :func:`lever_arm`.
    """
    covariances = None if trajectory.covariances is None else trajectory.interpolate_covariance(times)
    return lever_arm(trajectory.interpolate(times), covariances, lever)
