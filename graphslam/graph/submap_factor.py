"""A landmark submap as one n-ary GTSAM factor with its full joint covariance and an analytic Jacobian.

The factor is written in Python; three rules keep it safe and fast. It never raises, because GTSAM turns an exception
inside a factor into a broken solver. It fills every Jacobian it is asked for, because GTSAM crashes on a missing one.
It whitens by itself, in three matrix products for all landmarks together, and tells GTSAM that its noise is of unit
size: handing over some twenty small blocks to be whitened one by one costs more than the whole linearisation here.
Whitening commutes with linearisation (it is a constant matrix), so nothing is approximated by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.graph.state import gtsam_key

_TWO_PI = 2.0 * math.pi


def submap_factor(
    start: int, landmark_ids: npt.NDArray[np.int64], z: Array, whitener: Array, origin: Array
) -> gtsam.CustomFactor:
    """Factor on ``(x_start, x_{start+1}, l_…)``; without x_start where that is the fixed first base.

    Parameters
    ----------
    start : int
        Node at the submap's base.
    landmark_ids : (n,) int64
        Graph landmark of each entry; an id that stands twice gives one key whose Jacobian sums both entries.
    z : (3 + 2n,)
        ``[exit x, y, θ, l1x, l1y, …]``, Combined SLAM eq. 15.
    whitener : (3 + 2n, 3 + 2n)
        ``W`` with ``Wᵀ W = P⁻¹``.
    origin : (3,)
        Pose of the fixed first base.
    """
    unique, entry_of = np.unique(landmark_ids, return_inverse=True)
    fixed = start == 0
    keys = [] if fixed else [gtsam_key(f"x{start}")]
    keys += [gtsam_key(f"x{start + 1}"), *(gtsam_key(f"l{i}") for i in unique.tolist())]
    noise = gtsam.noiseModel.Unit.Create(len(z))
    return gtsam.CustomFactor(noise, keys, _error(keys, fixed, entry_of, z, whitener, origin))


def _error(
    keys: list[int], fixed: bool, entry_of: npt.NDArray[np.intp], z: Array, W: Array, origin: Array
) -> Callable[..., Array]:
    m = len(z)
    first_landmark = len(keys) - (len(np.unique(entry_of)) if len(entry_of) else 0)
    landmark_keys = keys[first_landmark:]
    u = len(landmark_keys)
    repeated = u != len(entry_of)
    W = np.ascontiguousarray(W)
    W_end, W_heading = W[:, :2].copy(), W[:, 2].copy()
    W_points = W[:, 3:]
    if repeated:  # columns of entries of one landmark are added up once and for all
        W_unique = np.zeros((m, u, 2))
        for entry, k in enumerate(entry_of.tolist()):
            W_unique[:, k] += W_points[:, 2 * entry : 2 * entry + 2]
    else:
        W_unique = W_points.reshape(m, -1, 2)[:, np.argsort(entry_of)]
    W_unique = np.ascontiguousarray(W_unique.reshape(m * u, 2))
    W_sum = np.stack([W[:, 0] + W_points[:, 0::2].sum(1), W[:, 1] + W_points[:, 1::2].sum(1)], -1)  # Σ over all points
    end_key, start_key = keys[0 if fixed else 1], None if fixed else keys[0]

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            if start_key is None:
                sx, sy, st = origin
            else:
                start = values.atPose2(start_key)
                sx, sy, st = start.x(), start.y(), start.theta()
            end = values.atPose2(end_key)
            c, s = math.cos(st), math.sin(st)
            R = np.array([[c, -s], [s, c]])
            points = np.empty((u + 1, 2))
            points[0] = end.x(), end.y()
            for i, k in enumerate(landmark_keys):
                points[i + 1] = values.atPoint2(k)
            q = (points - (sx, sy)) @ R  # everything in the start frame
            qe = q[1:][entry_of] if u else q[1:]
            r = np.empty(m)
            r[:2] = q[0]
            dt = end.theta() - st
            r[2] = dt
            r[3:] = qe.ravel()
            r -= z
            r[2] = math.pi - (math.pi - r[2]) % _TWO_PI
            if H is not None:
                _fill(H, q[0], qe, dt, R)
            return np.asarray(W @ r)
        except Exception:  # whatever it is, GTSAM must not see it: nan is refused by the solver instead
            for i in range(len(keys) if H is not None else 0):
                H[i] = np.zeros((m, 3 if i < first_landmark else 2))  # type: ignore[index]
            return np.full(m, np.nan)

    def _fill(H: list[Array], q_end: Array, qe: Array, dt: float, R: Array) -> None:
        if not fixed:
            J = np.empty((m, 3), order="F")
            J[:, :2] = -W_sum  # a step of the start moves every point by -1
            turn = np.empty(m)
            turn[0], turn[1], turn[2] = q_end[1], -q_end[0], -1.0
            turn[3::2], turn[4::2] = qe[:, 1], -qe[:, 0]
            J[:, 2] = W @ turn
            H[0] = J
        J = np.empty((m, 3), order="F")
        ce, se = math.cos(dt), math.sin(dt)
        J[:, 0] = W_end[:, 0] * ce + W_end[:, 1] * se  # R_sᵀ R_e
        J[:, 1] = W_end[:, 1] * ce - W_end[:, 0] * se
        J[:, 2] = W_heading
        H[first_landmark - 1] = J
        if u:
            J_points = (W_unique @ R.T).reshape(m, u, 2)  # R_sᵀ in each landmark's own rows
            for i in range(u):
                H[first_landmark + i] = J_points[:, i]

    return error
