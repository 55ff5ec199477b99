"""Custom GTSAM factors in space: fixes and attitudes, in small matrices and scalars.

GTSAM calls them one at a time, and every fix hangs on the datum, so that they run more often than anything else in
Python here: the vectorised terms of the families (:mod:`graphslam.graph.gps_family`, :mod:`graphslam.graph.attitude`)
would spend ten times as long on arrays of one row. They never raise and fill every Jacobian they are asked for: GTSAM
turns an exception inside a factor into a broken solver, and crashes on a missing Jacobian.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import quat_to_matrix
from graphslam.graph.attitude import across
from graphslam.graph.records import AttitudeRecord, GpsRecord
from graphslam.graph.state import gtsam_key

_WIDTH = {"x": 6, "d": 4, "t": 2, "b": 3}
_IDENTITY = np.eye(3)

Error = Callable[[Any, gtsam.Values, list[Array] | None], Array]


def gps_in_space(record: GpsRecord, noise: Any, origin: Array) -> gtsam.CustomFactor:
    """A fix: ``W (arm - x⁻¹ Exp(τ) R_z(ψ)ᵀ (z - bias - t))``; ``noise`` is of unit size."""
    names = record.variables()
    pose, free = _pose(names[0], origin), [n for n in names if n != "x0"]
    datum = gtsam_key("datum")
    bias = None if record.bias is None else gtsam_key(f"bias{record.bias}")
    tilt = gtsam_key("tilt") if record.tilt else None
    W, arm, z = np.array(record.whitener), np.array(record.arm), np.array(record.z)
    W_pose = np.hstack([np.zeros((3, 3)), W])

    def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
        R, t = pose(values)
        d = values.atVector(datum)
        u = z - d[:3]
        if bias is not None:
            u = u - values.atVector(bias)
        c, s = math.cos(d[3]), math.sin(d[3])
        w = np.array([c * u[0] + s * u[1], c * u[1] - s * u[0], u[2]])
        RtE = R.T
        if tilt is not None:
            E, J_r = _turn(*values.atVector(tilt))
            RtE = RtE @ E
        q = RtE @ w - R.T @ t
        if H is not None:
            WRtE, k = W @ RtE, 0
            if names[0] != "x0":
                J = W_pose.copy(order="F")
                J[:, :3] = -W @ _skew(q)
                H[0], k = J, 1
            Rz_t = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            J = np.empty((3, 4), order="F")
            J[:, :3] = WRtE @ Rz_t
            J[:, 3] = WRtE[:, 1] * w[0] - WRtE[:, 0] * w[1]
            H[k] = J
            if bias is not None:
                H[k + 1] = np.asfortranarray(J[:, :3])
            if tilt is not None:
                H[-1] = np.asfortranarray(WRtE @ _skew(w) @ J_r)
        return np.asarray(W @ (arm - q))

    return _factor(noise, free, terms, 3)


def attitude_in_space(record: AttitudeRecord, noise: Any, origin: Array) -> gtsam.CustomFactor:
    """Where gravity points: ``W Bᵀ (-Rᵀ u(τ))``; ``noise`` is of unit size."""
    names = record.variables()
    pose, free, tilt = _pose(names[0], origin), [n for n in names if n != "x0"], gtsam_key("tilt")
    WB = record.whitener @ across(record.direction).T
    down = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # [e_z]×

    def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
        R, _ = pose(values)
        E, J_r = _turn(*values.atVector(tilt))
        h = -(R.T @ E[:, 2])
        if H is not None:
            if names[0] != "x0":
                J = np.zeros((2, 6), order="F")
                J[:, :3] = WB @ _skew(h)
                H[0] = J
            H[-1] = np.asfortranarray(WB @ R.T @ E @ down @ J_r)
        return np.asarray(WB @ h)

    return _factor(noise, free, terms, 2)


def _pose(name: str, origin: Array) -> Callable[[gtsam.Values], tuple[Array, Array]]:
    """Rotation matrix and position of a node; the fixed first base is a constant."""
    if name == "x0":
        constant = quat_to_matrix(origin[3:]), origin[:3]
        return lambda _: constant
    key = gtsam_key(name)

    def found(values: gtsam.Values) -> tuple[Array, Array]:
        x = values.atPose3(key)
        return x.rotation().matrix(), x.translation()

    return found


def _factor(
    noise: Any, free: list[str], terms: Callable[[gtsam.Values, list[Array] | None], Array], rows: int
) -> gtsam.CustomFactor:
    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            return terms(values, H)
        except Exception:  # whatever it is, GTSAM must not see it: nan is refused by the solver instead
            for k, n in enumerate(free if H is not None else []):
                H[k] = np.zeros((rows, _WIDTH[n[0]]))  # type: ignore[index]
            return np.full(rows, np.nan)

    return gtsam.CustomFactor(noise, [gtsam_key(n) for n in free], error)


def _skew(v: Array) -> Array:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _turn(x: float, y: float) -> tuple[Array, Array]:
    """``Exp([x, y, 0])`` and the first two columns of its right Jacobian ``I - a Ω + b Ω²`` (Rodrigues)."""
    t2 = x * x + y * y
    t = math.sqrt(t2)
    small = t < 1e-4
    sinc = 1.0 - t2 / 6.0 if small else math.sin(t) / t
    a = 0.5 - t2 / 24.0 if small else 2.0 * (math.sin(0.5 * t) / t) ** 2
    b = 1.0 / 6.0 - t2 / 120.0 if t < 1e-3 else (t - math.sin(t)) / (t2 * t)
    O = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    O2 = O @ O
    return _IDENTITY + sinc * O + a * O2, (_IDENTITY - a * O + b * O2)[:, :2]
