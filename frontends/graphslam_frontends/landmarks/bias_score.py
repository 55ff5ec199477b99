"""Score test for systematic errors of wheels and landmark observations in a submap.

Observations are smoothed in short windows under the association of the front end, each window from its own base. The
residuals give two results:

- χ² of all residuals over their degrees of freedom: are wheels and observations consistent with one map?
- for every systematic error (:data:`PARAMETERS`), the *score* ``g = Bᵀ W r`` and its information
  ``S = Bᵀ W B - Bᵀ W A (Aᵀ W A)⁻¹ Aᵀ W B``: B is the Jacobian of the residuals by the error, A that by path and
  landmarks. Without errors ``g ~ N(0, S)``; otherwise ``S⁻¹ g`` estimates the error (one step of Gauss-Newton over
  path, landmarks and calibration), with its σ.

Windows are independent, so both are sums (:mod:`graphslam.evaluate.bias_test` reads them). Not observable in principle:
a common scale of ranges and distances, and bearings and rotations mirrored together. They give a map similar to the
true one, and these two sensors cannot distinguish them.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import (
    Array,
    rotation2,
    se2_adjoint,
    se2_between,
    se2_compose,
    se2_inverse,
    se2_transform,
    wrap_angle,
)
from graphslam_frontends.landmarks.prepare import PreparedLog
from graphslam_frontends.landmarks.smoothing_kernels import SmoothingMeasurements, smooth_kernel

Ints = npt.NDArray[np.int64]
PARAMETERS = (
    "range-scale",
    "range-offset",
    "bearing-offset",
    "mount-x",
    "mount-y",
    "distance-scale",
    "turn-scale",
    "turn-per-metre",
)
"""Errors that are tested for: factors (0 is correct) of ranges, distances and rotations; offsets of ranges and of the
sensor position [m]; offset of bearings [rad], and heading error per metre driven [rad/m]."""
WINDOW = 60
"""Scans per window: enough to observe a landmark from several places, few enough that wheel errors are nearly white and
the normal equations small."""
LEAST_SCANS = 5


def bias_score_test(
    data: PreparedLog, first: int, last: int, rows: Ints, landmark: Ints, poses: Array, places: Array
) -> dict[str, Any]:
    """Sums over the windows of a submap, for its report.

    Parameters
    ----------
    first, last : int
        Scans of the submap: ``first … last - 1``.
    rows, landmark : (q,)
        Observations used (rows of ``data.rows``), in order, and the landmark of each.
    poses : (last - first, 3)
        Of the base at the scans, in any common frame.
    places : (L, 2)
        Of the landmarks, same frame.

    Returns
    -------
    dict
        ``windows``, ``chi2``, ``dof``, ``score`` and ``information`` as described in the module, and for the scatter of
        the windows ``score2``, ``score_information``, ``information2``: sums of gᵢ², gᵢ Sᵢᵢ and Sᵢᵢ². Empty without a
        usable window.
    """
    scan = np.searchsorted(data.observations.offsets, rows, side="right") - 1
    p = len(PARAMETERS)
    g, S = np.zeros(p), np.zeros((p, p))
    g2, gS, S2 = np.zeros(p), np.zeros(p), np.zeros(p)
    chi2, dof, windows = 0.0, 0, 0
    count = max(1, round((last - first) / WINDOW))
    edges = np.linspace(first, last, count + 1).astype(np.int64)
    for a, b in pairwise(edges):
        inside = (scan >= a) & (scan < b)
        found = _window(
            data, int(a), int(b), rows[inside], scan[inside] - a, landmark[inside], poses[a - first : b - first], places
        )
        if found is None:
            continue
        c, d, gw, Sw = found
        s = np.diag(Sw)
        chi2, dof, windows = chi2 + c, dof + d, windows + 1
        g, S, g2, gS, S2 = g + gw, S + Sw, g2 + gw**2, gS + gw * s, S2 + s**2
    if not windows:
        return {}
    sums = {"score": g, "information": S, "score2": g2, "score_information": gS, "information2": S2}
    return {"windows": windows, "chi2": chi2, "dof": dof} | {k: v.tolist() for k, v in sums.items()}


def _window(
    data: PreparedLog, a: int, b: int, rows: Ints, pose: Ints, landmark: Ints, poses: Array, places: Array
) -> tuple[float, int, Array, Array] | None:
    """χ², dof, score and information of one window; None without redundancy."""
    names, index, seen = np.unique(landmark, return_inverse=True, return_counts=True)
    again = seen[index] > 1
    rows, pose = rows[again], pose[again]
    if b - a < LEAST_SCANS or len(rows) < 2 * LEAST_SCANS:
        return None
    first_seen: dict[int, int] = {}
    for name in landmark[again].tolist():
        first_seen.setdefault(name, len(first_seen))
    names = np.array(list(first_seen), dtype=np.int64)
    index = np.array([first_seen[n] for n in landmark[again].tolist()], dtype=np.int64)
    # the base of the window is the pose before its first increment
    u, Q = data.odometry.increments[a:b], data.odometry.covariances[a:b]
    base = se2_compose(poses[0], se2_inverse(u[0]))
    x = se2_between(np.broadcast_to(base, poses.shape), poses).copy()
    l = se2_transform(se2_inverse(base), places[names]).copy()
    z = np.column_stack([data.rows[rows, :2], data.smoothing_variances[rows]])
    sensor = np.ascontiguousarray(data.observations.T_base_sensor, dtype=np.float64)
    try:
        W = np.linalg.inv(Q)
        smooth_kernel(x, l, SmoothingMeasurements(u, W, pose, index, z, np.ones(len(z)), sensor), 20, 1e-6)
    except np.linalg.LinAlgError:
        return None
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(l))):
        return None
    return _score(x, l, u, Q, pose, index, z, sensor)


def _score(
    x: Array, l: Array, u: Array, Q: Array, pose: Ints, index: Ints, z: Array, sensor: Array
) -> tuple[float, int, Array, Array] | None:
    T, n, p = len(x), 2 * len(l), len(PARAMETERS)
    q = len(z)
    # wheels: residual u - between, in the tangent of the later pose
    before = np.concatenate([np.zeros((1, 3)), x[:-1]])
    between = se2_between(before, x)
    e = se2_between(u, between)
    root = np.linalg.inv(np.linalg.cholesky(Q))
    A_o, B_o = np.zeros((T, 3, 3 * T + n)), np.zeros((T, 3, p))
    turn = np.zeros((T, 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = rotation2(e[:, 2]), 1.0
    at = np.arange(T)
    for i in range(3):
        A_o[at, :, 3 * at + i] = turn[:, :, i]
    past = -turn @ se2_adjoint(se2_inverse(between))
    for i in range(3):
        A_o[at[1:], :, 3 * (at[1:] - 1) + i] = past[1:, :, i]
    r_o = -e
    # Jacobian by the wheel errors: longer distances, larger rotations, a rotation per metre
    ahead = np.einsum("kji,kj->ki", rotation2(between[:, 2]), between[:, :2])
    B_o[:, :2, PARAMETERS.index("distance-scale")] = ahead
    B_o[:, 2, PARAMETERS.index("turn-scale")] = between[:, 2]
    B_o[:, 2, PARAMETERS.index("turn-per-metre")] = np.hypot(between[:, 0], between[:, 1])
    # residuals are measured - predicted: A δ + B c + noise for a state error δ
    A_o, B_o, r_o = root @ A_o, root @ B_o, np.einsum("kij,kj->ki", root, r_o)
    # observations
    R = rotation2(x[pose, 2])
    d = np.einsum("kji,kj->ki", R, l[index] - x[pose, :2]) - sensor[:2]  # body frame, from the sensor
    r = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-6)
    ex, ey = d[:, 0] / r, d[:, 1] / r
    A_z, B_z = np.zeros((q, 2, 3 * T + n)), np.zeros((q, 2, p))
    k = np.arange(q)
    A_z[k, 0, 3 * pose], A_z[k, 0, 3 * pose + 1] = -ex, -ey
    A_z[k, 0, 3 * pose + 2] = ex * sensor[1] - ey * sensor[0]
    A_z[k, 1, 3 * pose], A_z[k, 1, 3 * pose + 1] = ey / r, -ex / r
    A_z[k, 1, 3 * pose + 2] = (-ey * sensor[1] - ex * sensor[0]) / r - 1.0
    ux, uy = R[:, 0, 0] * ex + R[:, 0, 1] * ey, R[:, 1, 0] * ex + R[:, 1, 1] * ey
    A_z[k, 0, 3 * T + 2 * index], A_z[k, 0, 3 * T + 2 * index + 1] = ux, uy
    A_z[k, 1, 3 * T + 2 * index], A_z[k, 1, 3 * T + 2 * index + 1] = -uy / r, ux / r
    B_z[:, 0, PARAMETERS.index("range-scale")] = r
    B_z[:, 0, PARAMETERS.index("range-offset")] = 1.0
    B_z[:, 1, PARAMETERS.index("bearing-offset")] = 1.0
    B_z[:, 0, PARAMETERS.index("mount-x")], B_z[:, 1, PARAMETERS.index("mount-x")] = -ex, ey / r
    B_z[:, 0, PARAMETERS.index("mount-y")], B_z[:, 1, PARAMETERS.index("mount-y")] = -ey, -ex / r
    bearing = np.arctan2(d[:, 1], d[:, 0]) - sensor[2]
    r_z = np.column_stack([z[:, 0] - r, wrap_angle(z[:, 1] - bearing)])
    weight = 1.0 / np.sqrt(z[:, 2:])  # no bearing: infinite variance, no row
    A_z, B_z, r_z = weight[:, :, None] * A_z, weight[:, :, None] * B_z, weight * r_z
    blind = ~np.isfinite(z[:, 3])
    r_z[blind, 1] = 0.0
    A = np.concatenate([A_o.reshape(3 * T, -1), A_z.reshape(2 * q, -1)])
    B = np.concatenate([B_o.reshape(3 * T, p), B_z.reshape(2 * q, p)])
    res = np.concatenate([r_o.ravel(), r_z.ravel()])
    H = A.T @ A
    try:
        C = np.linalg.cholesky(H)
    except np.linalg.LinAlgError:
        return None
    half = np.linalg.solve(C, A.T @ np.column_stack([B, res]))
    AB, Ar = half[:, :p], half[:, p]
    S = B.T @ B - AB.T @ AB
    g = B.T @ res - AB.T @ Ar
    dof = 3 * T + 2 * q - int(blind.sum()) - H.shape[0]
    chi2 = float(res @ res - Ar @ Ar)
    return (chi2, dof, g, S) if dof > 0 else None
