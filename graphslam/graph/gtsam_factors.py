"""Records → GTSAM factors. Native factors where GTSAM has them, custom ones where it has not."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.graph.factors.imu.gtsam import imu_in_space
from graphslam.graph.gtsam_space import attitude_in_space, gps_in_space
from graphslam.graph.gtsam_values import gtsam_pose
from graphslam.graph.noise import NO_KERNEL, Robust
from graphslam.graph.records import AttitudeRecord, BetweenRecord, BiasPriorRecord, GpsRecord, Record, SubmapRecord
from graphslam.graph.state import gtsam_key
from graphslam.graph.submap_factor import submap_factor


def with_kernel(base: Any, robust: Robust) -> Any:
    """GTSAM noise model with the same kernel as :class:`~graphslam.graph.noise.Robust`."""
    if robust.kind == "none":
        return base
    estimator = getattr(gtsam.noiseModel.mEstimator, robust.kind.capitalize())
    return gtsam.noiseModel.Robust.Create(estimator.Create(robust.k), base)


def gtsam_factor(record: Record, origin: Array) -> Any:
    """The GTSAM factor of a record.

    Parameters
    ----------
    record : Record
    origin : (3,) or (7,)
        Pose of the fixed first base: factors on it lose that key.
    """
    if isinstance(record, SubmapRecord):
        return submap_factor(record.start, record.landmark_ids, record.z, record.whitener, origin)
    if isinstance(record, BetweenRecord):
        return _between(record, origin)
    if isinstance(record, GpsRecord):
        if len(record.z) == 3:
            return gps_in_space(record, with_kernel(gtsam.noiseModel.Unit.Create(3), record.robust), origin)
        return _gps(record, origin)
    if isinstance(record, AttitudeRecord):
        return attitude_in_space(record, with_kernel(gtsam.noiseModel.Unit.Create(2), record.robust), origin)
    if not isinstance(record, BiasPriorRecord):
        kernel = getattr(record, "robust", NO_KERNEL)
        return imu_in_space(record, with_kernel(gtsam.noiseModel.Unit.Create(record.rows), kernel), origin)
    noise = gtsam.noiseModel.Isotropic.Sigma(record.dim, record.sigma)
    prior = gtsam.PriorFactorPoint2 if record.dim == 2 else gtsam.PriorFactorPoint3
    return prior(gtsam_key(f"bias{record.bias}"), np.zeros(record.dim), noise)


def _between(record: BetweenRecord, origin: Array) -> Any:
    # Not SqrtInformation(W): GTSAM wants that upper triangular and of a lower one silently keeps the diagonal alone.
    information = record.whitener.T @ record.whitener
    noise = with_kernel(gtsam.noiseModel.Gaussian.Information(information), record.robust)
    group = group_of(record.T_ij)
    plane = group.dim == 2
    if record.i and record.j:
        ki, kj = gtsam_key(f"x{record.i}"), gtsam_key(f"x{record.j}")
        between = gtsam.BetweenFactorPose2 if plane else gtsam.BetweenFactorPose3
        return between(ki, kj, gtsam_pose(record.T_ij), noise)
    if record.j:  # from the fixed base: the same residual Log(T⁻¹ x_0⁻¹ x_j) is that of a prior on x_j
        prior = gtsam.PriorFactorPose2 if plane else gtsam.PriorFactorPose3
        return prior(gtsam_key(f"x{record.j}"), gtsam_pose(group.compose(origin, record.T_ij)), noise)
    # To the fixed base: Log(T⁻¹ x_i⁻¹ x_0) is not a prior's residual, so the base stays a key held by the caller's
    # constant through a custom factor.
    T, x0, key, d = gtsam_pose(record.T_ij), gtsam_pose(origin), gtsam_key(f"x{record.i}"), group.dof
    Pose = gtsam.Pose2 if plane else gtsam.Pose3

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            H1, H2, H3, H4 = (np.zeros((d, d), order="F") for _ in range(4))
            x = values.atPose2(key) if plane else values.atPose3(key)
            h = x.between(x0, H1, H2)
            r = Pose.Logmap(T.between(h, H3, H4), H2)
            if H is not None:
                H[0] = H2 @ H4 @ H1
            return np.asarray(r)
        except Exception:
            if H is not None:
                H[0] = np.zeros((d, d))
            return np.full(d, np.nan)

    return gtsam.CustomFactor(noise, [key], error)


def _gps(record: GpsRecord, origin: Array) -> Any:
    keys = [gtsam_key(name) for name in record.variables() if name != "x0"]
    noise = with_kernel(gtsam.noiseModel.Unit.Create(2), record.robust)
    return gtsam.CustomFactor(noise, keys, _gps_error(keys, record, origin))


def _gps_error(keys: list[int], record: GpsRecord, origin: Array) -> Callable[..., Array]:
    """``W (arm - x⁻¹ T_gps_world⁻¹ (z - bias))`` (see :mod:`graphslam.graph.gps`) in scalar arithmetic.

    There are hundreds of fixes and every one hangs on the datum, so this runs more often than anything else here:
    numpy's overhead on arrays of two would be most of the time.
    """
    ax, ay = map(float, record.arm)
    zx, zy = map(float, record.z)
    (w00, w01), (w10, w11) = record.whitener.tolist()
    ox, oy, ot = map(float, origin)
    k_pose = keys[0] if record.node else None
    k_datum = keys[1] if record.node else keys[0]
    k_bias = keys[-1] if record.bias is not None else None
    n = len(keys)
    W = np.array(record.whitener)

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            x = values.atPose2(k_pose) if k_pose is not None else None
            px, py, pt = (ox, oy, ot) if x is None else (x.x(), x.y(), x.theta())
            d = values.atPose2(k_datum)
            bx, by = values.atPoint2(k_bias) if k_bias is not None else (0.0, 0.0)
            cd, sd = math.cos(d.theta()), math.sin(d.theta())
            ux, uy = zx - bx - d.x(), zy - by - d.y()
            wx, wy = cd * ux + sd * uy, cd * uy - sd * ux  # fix in the world
            c, s = math.cos(pt), math.sin(pt)
            vx, vy = wx - px, wy - py
            qx, qy = c * vx + s * vy, c * vy - s * vx  # fix in the base frame
            rx, ry = ax - qx, ay - qy
            if H is not None:
                i = 0
                if k_pose is not None:
                    H[0] = np.array(
                        [[w00, w01, w01 * qx - w00 * qy], [w10, w11, w11 * qx - w10 * qy]],
                        order="F",
                    )
                    i = 1
                Rt = np.array([[c, s, c * -wy + s * wx], [-s, c, s * wy + c * wx]])
                H[i] = np.asfortranarray(W @ Rt)
                if k_bias is not None:
                    H[n - 1] = np.asfortranarray(W @ Rt[:, :2] @ np.array([[cd, sd], [-sd, cd]]))
            return np.array([w00 * rx + w01 * ry, w10 * rx + w11 * ry])
        except Exception:
            for i in range(n if H is not None else 0):
                H[i] = np.zeros((2, 2 if keys[i] == k_bias else 3))  # type: ignore[index]
            return np.full(2, np.nan)

    return error
