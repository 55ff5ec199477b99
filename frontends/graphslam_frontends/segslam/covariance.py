"""Covariance of the end pose of a segment: spread of the particles plus drift model.

The spread alone (moment matching) is overconfident by a factor of 100: after resampling the particles have a recent
common ancestor, and an error common to all of them (a heading bias) is not in the spread. So the default adds a drift
model, the covariance of dead reckoning over the length of the segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import CovarianceError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of, pose_mean, pose_scatter


@dataclass(frozen=True, slots=True)
class ExitCovariance:
    """Covariances of the end pose of a segment, all in the right tangent of :attr:`pose`.

    Parameters
    ----------
    pose : (7,) or (3,)
    total : (d, d)
        Particles plus drift model: used in the graph.
    particles : (d, d)
        Second moment of the particles about ``pose``.
    matched : (d, d)
        As in the paper: moments of the particles about their own mean, with a floor that makes it invertible.
    drift : (d, d)
    effective : float
        ``1 / Σ w²`` of the particles.
    """

    pose: Array
    total: Array
    particles: Array
    matched: Array
    drift: Array
    effective: float


def exit_covariance(
    exits: ArrayLike,
    about: ArrayLike,
    drift: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    drift_scale: float = 1.0,
    floor_position: float = 0.01,
    floor_angle: float = 1e-3,
) -> ExitCovariance:
    """Covariance of the pose at the end of a segment, relative to its start.

    Parameters
    ----------
    exits : (n, 7) or (n, 3)
        Of all particles of the interval, each relative to its own start pose.
    about : (7,) or (3,)
        The end pose used; if it is not the mean, the squared offset is included.
    drift : (d, d)
        Covariance of dead reckoning over the segment, right tangent.
    weights : (n,), optional
    drift_scale : float
        Factor on the drift model's covariance.
    floor_position, floor_angle : float
        Standard deviations [m], [rad] added to the moment-matched covariance.
    """
    group = group_of(about)
    D = np.array(drift, dtype=np.float64)
    if D.shape != (group.dof, group.dof) or not np.all(np.isfinite(D)):
        raise CovarianceError(
            "the drift model gave no covariance", got=D.tolist(), wanted=f"({group.dof}, {group.dof}) finite numbers"
        )
    p = np.atleast_2d(np.asarray(exits, dtype=np.float64))
    n = len(p)
    w = np.full(n, 1.0 / n) if weights is None else np.asarray(weights, dtype=np.float64)
    mean = pose_mean(p, w)
    floor = np.full(group.dof, floor_angle**2)
    floor[group.position] = floor_position**2
    particles = pose_scatter(p, about, w)
    matched = pose_scatter(p, mean, w) + np.diag(floor)
    total = check_covariance(particles + drift_scale * D, what="exit covariance of a segment", dim=group.dof)
    return ExitCovariance(
        pose=np.array(about, dtype=np.float64),
        total=total,
        particles=particles,
        matched=0.5 * (matched + matched.T),
        drift=D,
        effective=float(w.sum() ** 2 / np.sum(w**2)),
    )
