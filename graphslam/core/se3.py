"""SE(3) on arrays; conventions in :mod:`graphslam.core.geometry`.

A pose is ``(..., 7)``: x, y, z, qx, qy, qz, qw. Tangents are rotation first, then translation (GTSAM's Pose3).
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array, ArrayLike

_SMALL = 1e-4


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices ``(..., 3, 3)``: ``skew(v) w = v × w``."""
    a = np.asarray(v, dtype=np.float64)
    out = np.zeros(a.shape[:-1] + (3, 3))
    out[..., 0, 1], out[..., 0, 2] = -a[..., 2], a[..., 1]
    out[..., 1, 0], out[..., 1, 2] = a[..., 2], -a[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -a[..., 1], a[..., 0]
    return out


def quat_normalize(q: ArrayLike) -> Array:
    """Unit quaternions ``(..., 4)`` (xyzw) with w ≥ 0."""
    a = np.asarray(q, dtype=np.float64)
    if a.size == 4:  # one: NumPy's calls would cost twenty times as much; the bits are the same
        x, y, z, w = a.ravel().tolist()
        length = math.sqrt(x * x + y * y + z * z + w * w)
        if 1e-12 <= length < math.inf:
            sign = -1.0 if w / length < 0 else 1.0
            return np.array([sign * (c / length) for c in (x, y, z, w)]).reshape(a.shape)
    n = np.linalg.norm(a, axis=-1, keepdims=True)
    if not np.all(np.isfinite(n)) or np.any(n < 1e-12):
        raise GeometryError(
            "quaternion of zero or non-finite length",
            got=a[np.ravel(~(n[..., 0] >= 1e-12)).argmax()] if a.ndim == 2 else a,
            wanted="a unit quaternion (x, y, z, w)",
        )
    a = a / n
    return np.where(a[..., 3:] < 0, -a, a)


def _cross(a: Array, b: Array) -> Array:
    """Cross products ``(..., 3)``, bitwise equal to NumPy's, but several times faster for few rows."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    np.subtract(a[..., 1] * b[..., 2], a[..., 2] * b[..., 1], out=out[..., 0])
    np.subtract(a[..., 2] * b[..., 0], a[..., 0] * b[..., 2], out=out[..., 1])
    np.subtract(a[..., 0] * b[..., 1], a[..., 1] * b[..., 0], out=out[..., 2])
    return out


def quat_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Hamilton product of quaternions ``(..., 4)`` in xyzw order."""
    a, b = np.asarray(p, dtype=np.float64), np.asarray(q, dtype=np.float64)
    if a.size == 4 and a.shape == b.shape:
        (ax, ay, az, s), (bx, by, bz, t) = a.ravel().tolist(), b.ravel().tolist()
        x = s * bx + t * ax + (ay * bz - az * by)
        y = s * by + t * ay + (az * bx - ax * bz)
        z = s * bz + t * az + (ax * by - ay * bx)
        return np.array([x, y, z, s * t - (ax * bx + ay * by + az * bz)]).reshape(a.shape)
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    v = aw * bv + bw * av + _cross(av, bv)
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([v, w], -1)


def quat_rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Rotate vectors ``(..., 3)`` by unit quaternions ``(..., 4)``."""
    a, u = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    if a.size == 4 and u.shape == (*a.shape[:-1], 3):
        (x, y, z, w), (vx, vy, vz) = a.ravel().tolist(), u.ravel().tolist()
        tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
        turned = vx + w * tx + (y * tz - z * ty), vy + w * ty + (z * tx - x * tz), vz + w * tz + (x * ty - y * tx)
        return np.array(turned).reshape(u.shape)
    t = 2.0 * _cross(a[..., :3], u)
    return np.asarray(u + a[..., 3:] * t + _cross(a[..., :3], t))


def quat_to_matrix(q: ArrayLike) -> Array:
    """Rotation matrices ``(..., 3, 3)`` of unit quaternions ``(..., 4)``."""
    a = np.asarray(q, dtype=np.float64)
    x, y, z, w = a.ravel().tolist() if a.size == 4 else (a[..., i] for i in range(4))
    out = np.empty((*a.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return out


def matrix_to_quat(R: ArrayLike) -> Array:
    """Unit quaternions ``(..., 4)`` of rotation matrices ``(..., 3, 3)``; the largest component is computed first."""
    m = np.asarray(R, dtype=np.float64)
    if m.size == 9:
        return _one_matrix_to_quat(m.ravel().tolist()).reshape(*m.shape[:-2], 4)
    d = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    tr = d.sum(-1)
    # four equivalent formulas; each is accurate if its leading component is large
    q = np.empty(m.shape[:-2] + (4, 4))
    q[..., 3, 3] = 1 + tr
    q[..., 3, 0] = m[..., 2, 1] - m[..., 1, 2]
    q[..., 3, 1] = m[..., 0, 2] - m[..., 2, 0]
    q[..., 3, 2] = m[..., 1, 0] - m[..., 0, 1]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        q[..., i, i] = 1 + 2 * d[..., i] - tr
        q[..., i, j] = m[..., i, j] + m[..., j, i]
        q[..., i, k] = m[..., i, k] + m[..., k, i]
        q[..., i, 3] = m[..., k, j] - m[..., j, k]
    lead = np.concatenate([1 + 2 * d - tr[..., None], (1 + tr)[..., None]], -1).argmax(-1)
    best = np.take_along_axis(q, lead[..., None, None], axis=-2)[..., 0, :]
    return quat_normalize(best)


def _one_matrix_to_quat(m: list[float]) -> Array:
    """:func:`matrix_to_quat` of one matrix, row by row, with the same bits."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = m
    tr = xx + yy + zz
    lead = [1 + 2 * xx - tr, 1 + 2 * yy - tr, 1 + 2 * zz - tr, 1 + tr]
    best = max(range(4), key=lead.__getitem__)
    rows = (
        (lead[0], xy + yx, xz + zx, zy - yz),
        (yx + xy, lead[1], yz + zy, xz - zx),
        (zx + xz, zy + yz, lead[2], yx - xy),
        (zy - yz, xz - zx, yx - xy, lead[3]),
    )
    return quat_normalize(rows[best])


def so3_exp(omega: ArrayLike) -> Array:
    """Rotation vector ``(..., 3)`` → unit quaternion ``(..., 4)``."""
    v = np.asarray(omega, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    small = angle < _SMALL
    s = np.where(small, 0.5 - angle**2 / 48.0, np.sin(angle / 2.0) / np.where(small, 1.0, angle))
    return np.concatenate([s * v, np.cos(angle / 2.0)], -1)


def so3_log(q: ArrayLike) -> Array:
    """Unit quaternion ``(..., 4)`` → rotation vector ``(..., 3)`` of angle ≤ π; accurate near 0 and near π."""
    a = np.asarray(q, dtype=np.float64)
    a = np.where(a[..., 3:] < 0, -a, a)
    s = np.linalg.norm(a[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(s, a[..., 3:])
    small = s < _SMALL
    k = np.where(small, 2.0 + s**2 / 3.0, angle / np.where(small, 1.0, s))
    return k * a[..., :3]


def _coefficients(omega: Array) -> tuple[Array, Array, Array]:
    """``(1 - cos)/φ²`` and ``(φ - sin)/φ³`` with series near zero, and ``φ²``; each with a trailing axis."""
    t2 = np.sum(omega**2, axis=-1, keepdims=True)
    t = np.sqrt(t2)
    small = t < 1e-3
    safe = np.where(small, 1.0, t)
    a = np.where(small, 0.5 - t2 / 24.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe**2)
    b = np.where(small, 1.0 / 6.0 - t2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return a, b, t2


def _matrix(outer: Array, vector: Array, diagonal: Array) -> Array:
    """``outer + [vector]× + diagonal · I``: products of ``(..., 3, 3)`` with ``(..., 1, 1)`` are slow in NumPy."""
    out = skew(vector)
    out += outer
    out[..., [0, 1, 2], [0, 1, 2]] += diagonal
    return out


def so3_left_jacobian(omega: ArrayLike) -> Array:
    """``J_l`` ``(..., 3, 3)``: ``Exp(ω + δ) ≈ Exp(J_l δ) Exp(ω)``; also the V matrix of SE(3)."""
    w = np.asarray(omega, dtype=np.float64)
    a, b, t2 = _coefficients(w)
    return _matrix((b * w)[..., :, None] * w[..., None, :], a * w, 1.0 - b * t2)


def so3_left_jacobian_inverse(omega: ArrayLike) -> Array:
    """Inverse of :func:`so3_left_jacobian`, closed form."""
    w = np.asarray(omega, dtype=np.float64)
    t = np.linalg.norm(w, axis=-1, keepdims=True)
    small = t < 1e-3
    safe = np.where(small, 1.0, t)
    half = safe / 2.0
    c = np.where(small, 1.0 / 12.0 + t**2 / 720.0, (1.0 - half * np.cos(half) / np.sin(half)) / safe**2)
    return _matrix((c * w)[..., :, None] * w[..., None, :], -0.5 * w, 1.0 - c * t**2)


def se3_compose(T_ab: ArrayLike, T_bc: ArrayLike) -> Array:
    """``T_ac`` from ``T_ab`` and ``T_bc``, each ``(..., 7)``."""
    a, b = np.asarray(T_ab, dtype=np.float64), np.asarray(T_bc, dtype=np.float64)
    t = a[..., :3] + quat_rotate(a[..., 3:], b[..., :3])
    return np.concatenate([t, quat_normalize(quat_multiply(a[..., 3:], b[..., 3:]))], -1)


def se3_inverse(T_ab: ArrayLike) -> Array:
    """``T_ba`` of ``T_ab`` ``(..., 7)``."""
    a = np.asarray(T_ab, dtype=np.float64)
    q = a[..., 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([-quat_rotate(q, a[..., :3]), q], -1)


def se3_between(T_wa: ArrayLike, T_wb: ArrayLike) -> Array:
    """``T_ab = T_wa⁻¹ T_wb``."""
    return se3_compose(se3_inverse(T_wa), T_wb)


def se3_transform(T_ab: ArrayLike, points_b: ArrayLike) -> Array:
    """Points ``(..., 3)`` in frame b to frame a."""
    a = np.asarray(T_ab, dtype=np.float64)
    return a[..., :3] + quat_rotate(a[..., 3:], points_b)


def se3_move(T_ab: Array, points_b: Array) -> Array:
    """Transform points ``(n, 3)`` by one pose ``(7,)``, with its matrix, five times faster than with the quaternion."""
    return np.asarray(points_b @ quat_to_matrix(T_ab[3:]).T + T_ab[:3])


def se3_exp(xi: ArrayLike) -> Array:
    """Exponential map: tangent ``(..., 6)`` (rotation, translation) → pose ``(..., 7)``."""
    v = np.asarray(xi, dtype=np.float64)
    t = (so3_left_jacobian(v[..., :3]) @ v[..., 3:, None])[..., 0]
    return np.concatenate([t, so3_exp(v[..., :3])], -1)


def se3_log(T: ArrayLike) -> Array:
    """Logarithm: pose ``(..., 7)`` → tangent ``(..., 6)``; inverse of :func:`se3_exp`."""
    p = np.asarray(T, dtype=np.float64)
    w = so3_log(p[..., 3:])
    rho = (so3_left_jacobian_inverse(w) @ p[..., :3, None])[..., 0]
    return np.concatenate([w, rho], -1)


def se3_adjoint(T: ArrayLike) -> Array:
    """Adjoint ``(..., 6, 6)``: ``T Exp(ξ) = Exp(Ad_T ξ) T``, rotation first."""
    p = np.asarray(T, dtype=np.float64)
    R = quat_to_matrix(p[..., 3:])
    out = np.zeros(p.shape[:-1] + (6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., 3:, :3] = skew(p[..., :3]) @ R
    return out


def se3_right_jacobian(xi: ArrayLike) -> Array:
    """``J_r`` ``(..., 6, 6)``: ``Exp(ξ + δ) ≈ Exp(ξ) Exp(J_r δ)`` (Barfoot & Furgale 2014, with rotation first).

    With ``k = w · ρ``, products of the skew matrices W and P of w and ρ are ``W² = w wᵀ - φ² I``, ``W P W = -k W``,
    ``W P + P W = ρ wᵀ + w ρᵀ - 2 k I`` and ``W W P + P W W - 3 W P W = [w × (w × ρ) + k w]×``.
    """
    v = -np.asarray(xi, dtype=np.float64)  # J_r(ξ) = J_l(-ξ)
    w, rho = v[..., :3], v[..., 3:]
    k = np.sum(w * rho, axis=-1, keepdims=True)
    t = np.linalg.norm(w, axis=-1, keepdims=True)
    small = t < 1e-2
    s = np.where(small, 1.0, t)
    sin, cos = np.sin(s), np.cos(s)
    a = np.where(small, 1 / 6 - t**2 / 120, (s - sin) / s**3)
    b = np.where(small, 1 / 24 - t**2 / 720, (s**2 + 2 * cos - 2) / (2 * s**4))
    c = np.where(small, 1 / 120 - t**2 / 2520, (2 * s - 3 * sin + s * cos) / (2 * s**5))
    vector = 0.5 * rho - a * k * w + b * (_cross(w, _cross(w, rho)) + k * w)
    outer = (a * rho - c * k * w)[..., :, None] * w[..., None, :]
    out = np.zeros(v.shape[:-1] + (6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = so3_left_jacobian(w)
    out[..., 3:, :3] = _matrix(outer + np.swapaxes(outer, -1, -2), vector, 2.0 * k * (c * t**2 - a))
    return out


def se3_right_jacobian_inverse(xi: ArrayLike) -> Array:
    """``J_r⁻¹`` ``(..., 6, 6)``: ``Log(Exp(ξ) Exp(δ)) ≈ ξ + J_r⁻¹ δ``."""
    out = se3_right_jacobian(xi)
    J = so3_left_jacobian_inverse(-np.asarray(xi, dtype=np.float64)[..., :3])
    out[..., :3, :3] = out[..., 3:, 3:] = J
    out[..., 3:, :3] = -J @ out[..., 3:, :3] @ J
    return out


def roll_pitch_jacobian(poses: Array) -> tuple[Array, Array]:
    """Roll and pitch ``(n, 2)`` [rad] and their derivatives by the right tangent ``(n, 2, 6)``."""
    up = quat_to_matrix(poses[:, 3:])[:, 2, :]  # e_z of the world in the body frame
    x, y, z = up.T
    roll, pitch = np.arctan2(y, z), -np.arcsin(np.clip(x, -1.0, 1.0))
    # R Exp(w): up changes by up × w
    n = len(poses)
    U = np.zeros((n, 3, 3))
    U[:, 0, 1], U[:, 0, 2] = -z, y
    U[:, 1, 0], U[:, 1, 2] = z, -x
    U[:, 2, 0], U[:, 2, 1] = -y, x
    D = np.zeros((n, 2, 6))
    flat = np.maximum(y**2 + z**2, 1e-12)
    D[:, 0, :3] = (z[:, None] * U[:, 1] - y[:, None] * U[:, 2]) / flat[:, None]
    D[:, 1, :3] = -U[:, 0] / np.sqrt(np.maximum(1.0 - x**2, 1e-12))[:, None]
    return np.column_stack([roll, pitch]), D


def pose_to_matrix(T: ArrayLike) -> Array:
    """Poses ``(..., 7)`` → homogeneous matrices ``(..., 4, 4)``."""
    p = np.asarray(T, dtype=np.float64)
    out = np.zeros(p.shape[:-1] + (4, 4))
    out[..., :3, :3] = quat_to_matrix(p[..., 3:])
    out[..., :3, 3] = p[..., :3]
    out[..., 3, 3] = 1.0
    return out


def align_se3(points: ArrayLike, reference: ArrayLike, *, scale: bool = False) -> tuple[Array, float]:
    """Transform ``T_reference_points`` (7,) and scale that take points ``(n, 3)`` onto reference (Umeyama 1991)."""
    p, q = np.asarray(points, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    mp, mq = p.mean(0), q.mean(0)
    U, D, Vt = np.linalg.svd((q - mq).T @ (p - mp) / len(p))
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    k = float(np.trace(np.diag(D) @ S) / np.mean(np.sum((p - mp) ** 2, 1))) if scale else 1.0
    return np.concatenate([mq - k * R @ mp, matrix_to_quat(R)]), k
