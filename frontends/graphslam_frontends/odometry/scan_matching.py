"""Planar odometry corrected by matching each scan with the previous one (Lu and Milios 1997).

If wheels slip, a filter with some tens of particles cannot estimate the heading and keep its map straight. Matches of
neighbouring scans are fused with the odometry by their covariances; in a corridor the odometry determines the motion
along it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, se2_between, se2_compose, se2_exp, se2_log
from graphslam.core.log import DropCounter
from graphslam.registration.config import LEAST_POINTS, RegistrationConfig
from graphslam.registration.register import register
from graphslam.registration.target import Target
from graphslam_frontends.odometry.steps import Steps

MATCHING = RegistrationConfig(radii=(0.6, 0.3), near=0.15, floor_sigma=0.01, floor_turn=0.003)
FITNESS = 0.6
"""Least share of points with a neighbour: below it, the scan shows another place or people."""
STILL = (0.01, 0.005)
"""Smaller motions are not corrected [m, rad]: noise of matches would accumulate while the robot is stationary."""


def match_neighbours(steps: Steps, *, drops: DropCounter | None = None) -> Steps:
    """Steps with increments fused with matches of neighbouring scans.

    Between two matched scans there may be steps without a beam; the correction is then in the last increment.
    ``errors`` (covariance over intervals) is removed, because it is that of the odometry alone; the odometry is kept in
    ``recorded``.

    Parameters
    ----------
    steps : Steps
        2-D steps.
    drops : DropCounter, optional
        Counts scans without an accepted match, where the odometry is kept.
    """
    if steps.dim != 2:
        raise ConfigError(f"{steps.name}: scans in space are not matched with their neighbours")
    o = steps.odometry
    increments, covariances = o.increments.copy(), o.covariances.copy()
    target: Target | None = None
    T, P = np.zeros(3), np.zeros((3, 3))  # since the target
    failed = 0
    for k in range(len(steps)):
        if k:
            P = _carried(P, o.increments[k]) + o.covariances[k]
            before, T = T, se2_compose(T, o.increments[k])
        points, _, returns = steps.scan(k)
        cloud = points[returns]
        if len(cloud) < LEAST_POINTS:
            continue
        here = Target(cloud)
        moved = np.hypot(T[0], T[1]) > STILL[0] or abs(T[2]) > STILL[1]
        if target is not None and not moved:
            continue  # keep the older target until the motion since then is significant
        if target is not None:
            found = register(here, target, T, MATCHING)
            if found.converged and found.fitness >= FITNESS:
                fused, Q = fuse_motions(T, P, found.T_target_source, found.covariance)
                increments[k] = se2_between(before, fused)
                covariances[k] = Q
            else:
                failed += 1
        target, T, P = here, np.zeros(3), np.zeros((3, 3))
    if drops is not None:
        drops.drop("steps", "scan does not match the one before (odometry kept)", failed)
    motion = replace(o, increments=increments, covariances=covariances)
    return replace(steps, odometry=motion, errors=None, recorded=o)


def fuse_motions(T: Array, P: Array, T_match: Array, R: Array) -> tuple[Array, Array]:
    """Fuse two estimates of one motion ``(3,)`` with covariances ``(3, 3)``, in the tangent of the first."""
    gain = P @ np.linalg.inv(P + R)
    x = gain @ se2_log(se2_between(T, T_match))
    Q = (np.eye(3) - gain) @ P
    return se2_compose(T, se2_exp(x)), 0.5 * (Q + Q.T)


def _carried(P: Array, u: Array) -> Array:
    """Covariance of a motion, right tangent, propagated over the next motion."""
    c, s = np.cos(u[2]), np.sin(u[2])
    J = np.array([[c, s, -c * u[1] + s * u[0]], [-s, c, s * u[1] + c * u[0]], [0.0, 0.0, 1.0]])
    return np.asarray(J @ P @ J.T)
