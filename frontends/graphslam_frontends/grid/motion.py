"""Motion model of the particles: odometry with its noise (SegSLAM eq. 1–2), and roll and pitch from gravity.

Roll and pitch by gravity do not drift, but have time-correlated errors of a fraction of a degree over seconds. Each
particle has its own sample of this error, an Ornstein–Uhlenbeck process.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, heading_of
from graphslam_frontends.grid.config import GridFilterConfig


def motion_covariance(increment: Array, covariance: Array, config: GridFilterConfig) -> Array:
    """Covariance for sampling the motion of a step: that of the odometry plus walks that cover its systematic errors.

    Parameters
    ----------
    increment : (3,) or (7,)
        ``T_before_after``.
    covariance : (d, d)
        Of the odometry, right tangent.

    Returns
    -------
    (d, d)
        Right tangent, positive semi-definite.
    """
    planar = len(increment) == 3
    path = float(np.linalg.norm(increment[: 2 if planar else 3]))
    share = config.walk_scale**2
    walks = (config.position_walk, config.height_walk, config.tilt_walk)
    position, height, tilt = (share * w * w * path for w in walks)
    turn = abs(float(increment[2])) if planar else 2.0 * float(np.arctan2(abs(increment[5]), abs(increment[6])))
    heading = share * (config.heading_walk**2 * path + config.heading_turn**2 * turn)
    if planar:
        added = [position, position, heading]
    else:
        added = [tilt, tilt, heading, position, position, height]
    return config.motion_scale**2 * np.asarray(covariance, dtype=np.float64) + np.diag(added)


def square_root(covariance: Array) -> Array:
    """``L`` with ``L Lᵀ`` = a positive semi-definite ``(d, d)``; Cholesky fails if a direction has no noise."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def move_poses(poses: Array, increment: Array, noise: Array | None) -> Array:
    """``T ∘ u ∘ Exp(r)`` for poses ``(n, 3)`` or ``(n, 7)`` and noise ``(n, d)``; None: no noise."""
    group = group_of(poses)
    moved = group.compose(poses, np.broadcast_to(increment, poses.shape))
    return moved if noise is None else group.compose(moved, group.exp(noise))


def roll_pitch_of(poses: Array) -> Array:
    """Roll and pitch ``(..., 2)`` of 3-D poses [rad], ``R = Rz(heading) Ry(pitch) Rx(roll)``."""
    x, y, z, w = np.moveaxis(poses[..., 3:], -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return np.stack([roll, pitch], -1)


def with_roll_pitch(poses: Array, tilt: Array) -> Array:
    """Poses ``(n, 7)`` with roll and pitch replaced by ``(n, 2)`` [rad]; headings and positions stay."""
    half = 0.5 * np.column_stack([tilt, heading_of(poses)])
    (sr, sp, sy), (cr, cp, cy) = np.sin(half).T, np.cos(half).T
    q = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    return np.column_stack([poses[:, :3], *q])


def walk_tilt_errors(errors: Array, seconds: float, sigma: float, time: float, normal: Array) -> Array:
    """Errors of roll and pitch ``(n, 2)`` after some seconds: exact for an Ornstein–Uhlenbeck process.

    Parameters
    ----------
    errors : (n, 2)
    sigma : float
        Stationary σ [rad].
    time : float
        Correlation time (1/e) [s]; 0: white.
    normal : (n, 2)
        Standard normal.
    """
    left = float(np.exp(-seconds / time)) if time > 0.0 else 0.0
    return left * errors + sigma * float(np.sqrt(1.0 - left * left)) * normal
