"""SE(2) and SE(3) on arrays.

Conventions (of the whole package)
------------------------------------------
* A 2-D pose is ``(..., 3)``: x, y, θ [m, m, rad]. A 3-D pose is ``(..., 7)``: x, y, z, qx, qy, qz, qw.
* ``T_ab`` takes coordinates in frame b to frame a, so ``T_ac = compose(T_ab, T_bc)``.
* Tangent vectors are in GTSAM's order: Pose2 (x, y, θ); Pose3 rotation first, then translation.
* A pose error is a right perturbation: ``ξ = Log(T_est⁻¹ T_true)``; Jacobians are with respect to ``T ∘ Exp(ξ)``.

Every function broadcasts over leading axes and never changes its arguments. SE(3) is in :mod:`graphslam.core.se3`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
ArrayLike = npt.ArrayLike

# Below this |θ| the series of sin(θ)/θ etc. are used; their error is θ⁴/120 < 1e-17 there.
_SMALL = 1e-4


def wrap_angle(angle: ArrayLike) -> Array:
    """Wrap to (-π, π]."""
    a = np.asarray(angle, dtype=np.float64)
    return np.asarray(np.pi - np.mod(np.pi - a, 2.0 * np.pi))


def circular_mean(angles: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Weighted mean direction of angles ``(n,)`` [rad] (Combined SLAM eq. 7 for a heading)."""
    a = np.asarray(angles, dtype=np.float64)
    w = np.ones_like(a) if weights is None else np.asarray(weights, dtype=np.float64)
    return float(np.arctan2(np.sum(w * np.sin(a)), np.sum(w * np.cos(a))))


def rotation2(theta: ArrayLike) -> Array:
    """Rotation matrices ``(..., 2, 2)`` of angles ``(...)``."""
    t = np.asarray(theta, dtype=np.float64)
    c, s = np.cos(t), np.sin(t)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def arc_length(points: ArrayLike) -> Array:
    """Path length along points ``(n, k)`` up to each of them ``(n,)``; the first is 0. ``n ≥ 1``."""
    p = np.asarray(points, dtype=np.float64)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])


def se2_compose(T_ab: ArrayLike, T_bc: ArrayLike) -> Array:
    """``T_ac`` from ``T_ab`` and ``T_bc``, each ``(..., 3)``; heading wrapped."""
    a, b = np.asarray(T_ab, dtype=np.float64), np.asarray(T_bc, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [
            a[..., 0] + c * b[..., 0] - s * b[..., 1],
            a[..., 1] + s * b[..., 0] + c * b[..., 1],
            wrap_angle(a[..., 2] + b[..., 2]),
        ],
        -1,
    )


def se2_inverse(T_ab: ArrayLike) -> Array:
    """``T_ba`` of ``T_ab`` ``(..., 3)``."""
    a = np.asarray(T_ab, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], wrap_angle(-a[..., 2])],
        -1,
    )


def se2_between(T_wa: ArrayLike, T_wb: ArrayLike) -> Array:
    """``T_ab = T_wa⁻¹ T_wb``."""
    a, b = np.asarray(T_wa, dtype=np.float64), np.asarray(T_wb, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap_angle(b[..., 2] - a[..., 2])], -1)


def se2_transform(T_ab: ArrayLike, points_b: ArrayLike) -> Array:
    """Points ``(..., 2)`` in frame b to frame a; poses ``(..., 3)`` broadcast against them."""
    a, p = np.asarray(T_ab, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [a[..., 0] + c * p[..., 0] - s * p[..., 1], a[..., 1] + s * p[..., 0] + c * p[..., 1]],
        -1,
    )


def se2_adjoint(T: ArrayLike) -> Array:
    """Adjoint ``(..., 3, 3)``: ``T Exp(ξ) = Exp(Ad_T ξ) T``, tangent order x, y, θ."""
    a = np.asarray(T, dtype=np.float64)
    out = np.zeros(a.shape[:-1] + (3, 3))
    out[..., :2, :2] = rotation2(a[..., 2])
    out[..., 0, 2] = a[..., 1]
    out[..., 1, 2] = -a[..., 0]
    out[..., 2, 2] = 1.0
    return out


def _sinc_cosc(theta: Array) -> tuple[Array, Array]:
    """``sin θ / θ`` and ``(1 - cos θ) / θ`` with series near zero."""
    small = np.abs(theta) < _SMALL
    safe = np.where(small, 1.0, theta)
    sinc = np.where(small, 1.0 - theta**2 / 6.0, np.sin(safe) / safe)
    # 2 sin²(θ/2)/θ instead of (1 - cos θ)/θ: no cancellation
    cosc = np.where(small, theta / 2.0 - theta**3 / 24.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe)
    return sinc, cosc


def se2_exp(xi: ArrayLike) -> Array:
    """Exponential map ``(..., 3)`` tangent (x, y, θ) → pose."""
    v = np.asarray(xi, dtype=np.float64)
    a, b = _sinc_cosc(v[..., 2])
    return np.stack(
        [a * v[..., 0] - b * v[..., 1], b * v[..., 0] + a * v[..., 1], wrap_angle(v[..., 2])],
        -1,
    )


def se2_log(T: ArrayLike) -> Array:
    """Logarithm ``(..., 3)`` pose → tangent (x, y, θ); inverse of :func:`se2_exp`."""
    p = np.asarray(T, dtype=np.float64)
    theta = wrap_angle(p[..., 2])
    half = theta / 2.0
    small = np.abs(theta) < _SMALL
    # θ/2 · cot(θ/2), finite at π where the rotation part of V⁻¹ vanishes
    safe = np.where(small, 1.0, half)
    a = np.where(small, 1.0 - theta**2 / 12.0, safe * np.cos(safe) / np.sin(safe))
    return np.stack(
        [a * p[..., 0] + half * p[..., 1], -half * p[..., 0] + a * p[..., 1], theta],
        -1,
    )


def se2_right_jacobian(xi: ArrayLike) -> Array:
    """``J_r`` ``(..., 3, 3)``: ``Exp(ξ + δ) ≈ Exp(ξ) Exp(J_r δ)``."""
    v = np.asarray(xi, dtype=np.float64)
    theta = v[..., 2]
    a, b = _sinc_cosc(theta)
    small = np.abs(theta) < _SMALL
    safe = np.where(small, 1.0, theta)
    # (1 - a)/θ and (b... )/θ are the integrals of the rotation in the translation columns
    c = np.where(small, theta / 6.0, (1.0 - a) / safe)
    d = np.where(small, 0.5 - theta**2 / 24.0, b / safe)
    out = np.zeros(v.shape[:-1] + (3, 3))
    out[..., 0, 0], out[..., 0, 1] = a, b
    out[..., 1, 0], out[..., 1, 1] = -b, a
    out[..., 0, 2] = c * v[..., 0] - d * v[..., 1]
    out[..., 1, 2] = d * v[..., 0] + c * v[..., 1]
    out[..., 2, 2] = 1.0
    return out


def se2_right_jacobian_inverse(xi: ArrayLike) -> Array:
    """``J_r⁻¹`` ``(..., 3, 3)``: ``Log(Exp(ξ) Exp(δ)) ≈ ξ + J_r⁻¹ δ``."""
    return np.asarray(np.linalg.inv(se2_right_jacobian(xi)))


def vector_to_tangent_covariance(pose: ArrayLike, cov_vector: ArrayLike) -> Array:
    """Covariance of (x, y, θ) *in the parent frame* → right-tangent covariance ``(..., 3, 3)`` of the same pose.

    A landmark submap has its exit as the plain vector of Combined SLAM eq. 15 (parent frame); graphs use the tangent at
    the pose. Both differ by the rotation of the position part.
    """
    p = np.asarray(pose, dtype=np.float64)
    G = np.zeros(p.shape[:-1] + (3, 3))
    G[..., :2, :2] = rotation2(-p[..., 2])
    G[..., 2, 2] = 1.0
    return G @ np.asarray(cov_vector, dtype=np.float64) @ np.swapaxes(G, -1, -2)


def tangent_to_vector_covariance(pose: ArrayLike, cov_tangent: ArrayLike) -> Array:
    """Inverse of :func:`vector_to_tangent_covariance`."""
    p = np.asarray(pose, dtype=np.float64)
    G = np.zeros(p.shape[:-1] + (3, 3))
    G[..., :2, :2] = rotation2(p[..., 2])
    G[..., 2, 2] = 1.0
    return G @ np.asarray(cov_tangent, dtype=np.float64) @ np.swapaxes(G, -1, -2)


def align_se2(points: ArrayLike, reference: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Rigid transform ``T_reference_points`` (3,) that takes points ``(n, 2)`` onto reference ``(n, 2)``.

    Least squares, no scale (Umeyama 1991 in two dimensions, closed form).
    """
    p, q = np.asarray(points, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    w = np.ones(len(p)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    mp, mq = w @ p, w @ q
    dp, dq = p - mp, q - mq
    s = np.sum(w * (dp[:, 0] * dq[:, 1] - dp[:, 1] * dq[:, 0]))
    c = np.sum(w * np.sum(dp * dq, axis=1))
    theta = np.arctan2(s, c)
    return np.concatenate([mq - rotation2(theta) @ mp, [theta]])
