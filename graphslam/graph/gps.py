"""GPS fixes before they are factors: how they enter, where they hang, and where the datum starts.

The factor itself is in :mod:`graphslam.graph.factors.gps`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.config import spelled
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, align_se2, rotation2, se2_transform
from graphslam.core.poses import group_of
from graphslam.core.se3 import quat_to_matrix, skew
from graphslam.core.trajectory import Trajectory
from graphslam.graph.noise import Robust


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsConfig:
    """How fixes enter the graph.

    Parameters
    ----------
    robust : Robust
        Kernel on each fix.
    sigma : float or None
        Standard deviation of a coordinate [m] in place of the stream's own.
    baseline : float
        Fixes wait until they span this distance [m], on the ground and in the map; then a rigid alignment starts
        the datum.
    bias_sigma : float or None
        With a number [m]: one bias per GPS segment with that prior (default: none).
    segment_gap : float
        A pause longer than this [s] starts a new segment.
    """

    robust: Robust = spelled(Robust("none", 2.385), robust="kind", robust_width="k")
    sigma: float | None = None
    baseline: float = 20.0
    bias_sigma: float | None = None
    segment_gap: float = 2.0

    def __post_init__(self) -> None:
        for name in ("sigma", "baseline", "bias_sigma", "segment_gap"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"gps.{name} must be positive, got {value}")


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A fix that has not become a factor yet."""

    factor_id: int
    time: float
    position: Array
    sigma: float
    lever: Array
    config: GpsConfig


@dataclass(frozen=True, slots=True, eq=False)
class TiedFix:
    """A fix with its node in a submap: all it needs but a datum."""

    fix: Fix
    node: int
    arm: Array
    covariance: Array


def arm_of(trajectory: Trajectory, times: Array, lever: Array) -> tuple[Array, Array]:
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


def lever_arm(T: Array, covariances: Array | None, lever: Array) -> tuple[Array, Array]:
    """Antennas ``T · lever`` and their covariances, in the plane or in space.

    Parameters
    ----------
    T : (q, 3) or (q, 7)
        ``T_node_body``.
    covariances : (q, d, d) or None
        Right tangent; None = exact.
    lever : (dim,)

    Returns
    -------
    arm : (q, dim)
    covariance : (q, dim, dim)
        ``G C Gᵀ`` with ``G = R [I | (-l_y, l_x)ᵀ]``, in space ``R [-[l]× | I]``: the derivative of
        ``T Exp(ξ) · lever``.
    """
    group = group_of(T)
    dim = group.dim
    arm = group.transform(T, np.broadcast_to(lever, (len(T), dim)))
    if covariances is None:
        return arm, np.zeros((len(T), dim, dim))
    G = np.zeros((len(T), dim, group.dof))
    if dim == 2:
        R = rotation2(T[:, 2])
        G[:, :, :2] = R
        G[:, :, 2] = R @ np.array([-lever[1], lever[0]])
    else:
        R = quat_to_matrix(T[:, 3:])
        G[:, :, :3], G[:, :, 3:] = -R @ skew(lever), R
    return arm, G @ covariances @ np.swapaxes(G, 1, 2)


def spread(points: Array) -> float:
    """Greatest distance from the first point [m]: zero for none."""
    return float(np.max(np.linalg.norm(points - points[0], axis=1))) if len(points) else 0.0


def start_datum(world: Array, fixes: Array, sigma: Array) -> Array:
    """First ``T_gps_world`` from antenna positions in the map and their fixes.

    Rigid alignment, reweighted a few times with Cauchy weights of three sigma (at least 1 m), so that one wild fix
    does not turn the datum.

    Parameters
    ----------
    world, fixes : (q, 2)
    sigma : (q,)
    """
    w = 1.0 / sigma**2
    T = align_se2(world, fixes, w)
    width = np.maximum(3.0 * sigma, 1.0)
    for _ in range(10):
        d = np.linalg.norm(se2_transform(T, world) - fixes, axis=1)
        T = align_se2(world, fixes, w / (1.0 + (d / width) ** 2))
    return T
