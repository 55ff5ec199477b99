"""The residual of a position fix in the plane, as it is defined."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array, rotation2


def gps_residual(pose: Array, datum: Array, bias: Array, arm: Array, z: Array) -> Array:
    """``arm - x⁻¹ T_gps_world⁻¹ (z - bias)``; every argument broadcasts over leading axes."""
    p_world = (z - bias - datum[..., :2])[..., None, :] @ rotation2(datum[..., 2])
    q = (p_world[..., 0, :] - pose[..., :2])[..., None, :] @ rotation2(pose[..., 2])
    return np.asarray(arm - q[..., 0, :])
