"""Records → GTSAM factors. Native factors where GTSAM has them, custom ones where it has not."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array, se2_compose
from graphslam.graph.noise import Robust
from graphslam.graph.records import BetweenRecord, BiasPriorRecord, GpsRecord, Record, SubmapRecord
from graphslam.graph.state import Layout, Values, gtsam_key
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
    origin : (3,)
        Pose of the fixed first base: factors on it lose that key.
    """
    if isinstance(record, SubmapRecord):
        return submap_factor(record.start, record.landmark_ids, record.z, record.whitener, origin)
    if isinstance(record, BetweenRecord):
        return _between(record, origin)
    if isinstance(record, GpsRecord):
        return _gps(record, origin)
    assert isinstance(record, BiasPriorRecord)
    noise = gtsam.noiseModel.Isotropic.Sigma(2, record.sigma)
    return gtsam.PriorFactorPoint2(gtsam_key(f"bias{record.bias}"), np.zeros(2), noise)


def _between(record: BetweenRecord, origin: Array) -> Any:
    # Not SqrtInformation(W): GTSAM wants that upper triangular and of a lower one silently keeps the diagonal alone.
    information = record.whitener.T @ record.whitener
    noise = with_kernel(gtsam.noiseModel.Gaussian.Information(information), record.robust)
    if record.i and record.j:
        ki, kj = gtsam_key(f"x{record.i}"), gtsam_key(f"x{record.j}")
        return gtsam.BetweenFactorPose2(ki, kj, gtsam.Pose2(*record.T_ij), noise)
    if record.j:  # from the fixed base: the same residual Log(T⁻¹ x_0⁻¹ x_j) is that of a prior on x_j
        return gtsam.PriorFactorPose2(gtsam_key(f"x{record.j}"), gtsam.Pose2(*se2_compose(origin, record.T_ij)), noise)
    # To the fixed base: Log(T⁻¹ x_i⁻¹ x_0) is not a prior's residual, so the base stays a key held by the caller's
    # constant through a custom factor.
    T, x0, key = gtsam.Pose2(*record.T_ij), gtsam.Pose2(*origin), gtsam_key(f"x{record.i}")

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            H1, H2 = np.zeros((3, 3), order="F"), np.zeros((3, 3), order="F")
            H3, H4 = np.zeros((3, 3), order="F"), np.zeros((3, 3), order="F")
            h = values.atPose2(key).between(x0, H1, H2)
            r = gtsam.Pose2.Logmap(T.between(h, H3, H4), H2)
            if H is not None:
                H[0] = H2 @ H4 @ H1
            return np.asarray(r)
        except Exception:
            if H is not None:
                H[0] = np.zeros((3, 3))
            return np.full(3, np.nan)

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


def insert_value(out: gtsam.Values, name: str, values: Values, row_of: dict[int, int]) -> None:
    """Insert one variable of ``values`` into GTSAM's."""
    key = gtsam_key(name)
    if name == "datum":
        assert values.datum is not None
        out.insert(key, gtsam.Pose2(*values.datum))
    elif name.startswith("bias"):
        out.insert(key, values.biases[int(name[4:])])
    elif name[0] == "x":
        out.insert(key, gtsam.Pose2(*values.poses[int(name[1:])]))
    else:
        out.insert(key, values.landmarks[row_of[int(name[1:])]])


def to_gtsam(values: Values) -> gtsam.Values:
    """All free variables as GTSAM values."""
    out, layout = gtsam.Values(), values.layout()
    for name in layout.names():
        insert_value(out, name, values, layout.row_of)
    return out


def from_gtsam(estimate: gtsam.Values, like: Values, layout: Layout | None = None) -> Values:
    """GTSAM values → ours; variables that GTSAM does not hold keep their value in ``like``."""
    out = like.copy()
    row_of = (layout or like.layout()).row_of
    keys = np.array(list(estimate.keys()), dtype=np.uint64)
    letter = (keys >> np.uint64(56)).astype(np.int64)
    index = (keys & np.uint64((1 << 56) - 1)).astype(np.int64)
    # bulk extraction comes in the order of the keys, one array a type
    posed, pointed = np.isin(letter, [ord("g"), ord("x")]), np.isin(letter, [ord("b"), ord("l")])
    P = np.asarray(gtsam.utilities.extractPose2(estimate)).reshape(-1, 3)
    p = np.asarray(gtsam.utilities.extractPoint2(estimate)).reshape(-1, 2)
    x = letter[posed] == ord("x")
    out.poses[index[posed][x]] = P[x]
    if np.any(~x):
        out.datum = P[~x][0].copy()
    l = letter[pointed] == ord("l")
    rows = np.array([row_of[int(i)] for i in index[pointed][l]], dtype=np.intp)
    out.landmarks[rows] = p[l]
    out.biases[index[pointed][~l]] = p[~l]
    return out
