"""Parametrisations ("charts") in which a landmark map is Gaussian.

A heading error moves the end of a submap and its landmarks along arcs; a Gaussian over Cartesian coordinates models
straight lines. In the *group chart* of SE₁₊ₙ(2) the residual of a pose (t, θ) and of every point l with this pose as
anchor is, with ``d = θ - θ̂``,

    (V(d)⁻¹ (t - R(d) t̂),  d,  V(d)⁻¹ (l - R(d) l̂)),        V(d) = ∫₀¹ R(s d) ds.

Because ``R(d) = I + S V(d) d`` (S the quarter turn), this is

    (V(d)⁻¹ (t - t̂) - S t̂ d,  d,  V(d)⁻¹ (l - l̂) - S l̂ d),

and the terms in ``S`` cancel with the transformation of the information matrix to this chart: the weighted square of
the residual is that of ``u = (V(d)⁻¹ (t - t̂), d, V(d)⁻¹ (l - l̂))`` with the *Cartesian* information matrix. So mean
and covariance of a map are unchanged, and the chart is one scaled rotation,

    V(d)⁻¹ = a I - b S,        a = (d/2) cot(d/2),  b = d/2.

In a joined map the *anchor* of a point is the end pose of the submap that observed it first.

In 3-D the same is true in SE₁₊ₙ(3). The error of the rotation is ``w = Log(R R̂ᵀ)``, about the axes of the base frame;
``Exp(w) = I + [w]× V(w)``, so with the Cartesian information matrix over ``(w, t, l…)`` the weighted square of the
residual is that of ``(w, V(w)⁻¹ (t - t̂), V(w)⁻¹ (l - l̂))``. For a single pose that is exactly its right tangent:
``Log(T T̂⁻¹) = Ad(T̂) Log(T̂⁻¹ T)``.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, ArrayLike, wrap_angle
from graphslam.core.se3 import quat_multiply, skew, so3_left_jacobian_inverse, so3_log

Chart = Literal["cartesian", "group"]
CHARTS: tuple[str, ...] = get_args(Chart)

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_SMALL_TURN = 0.1
"""Below this angle [rad] the series of :func:`inverse_left_jacobian_slopes` are as accurate as the closed forms."""
_SMALL = 1e-3
"""Below this half angle [rad] the series are accurate to rounding, and the closed forms suffer from cancellation."""


def check_chart(chart: str) -> str:
    """Return the name of a chart, or refuse an unknown one."""
    if chart not in CHARTS:
        raise ConfigError(f"unknown chart {chart!r}; wanted {' or '.join(repr(c) for c in CHARTS)}")
    return chart


def inverse_left_jacobian_terms(d: ArrayLike) -> tuple[Array, Array, Array]:
    """``a``, ``b`` and ``da/dd`` of ``V(d)⁻¹ = a I - b S`` for headings ``d`` in [-π, π]."""
    h = 0.5 * np.asarray(d, dtype=np.float64)
    small = np.abs(h) < _SMALL
    safe = np.where(small, 1.0, h)
    cot, sin2 = 1.0 / np.tan(safe), np.sin(safe) ** 2
    a = np.where(small, 1.0 - h**2 / 3.0 - h**4 / 45.0, safe * cot)
    slope = np.where(small, -h / 3.0 - 2.0 * h**3 / 45.0, 0.5 * (cot - safe / sin2))
    return a, h, slope


def apply_inverse_left_jacobian(difference: Array, d: ArrayLike) -> Array:
    """``V(d)⁻¹ e`` for differences e ``(..., 2)`` of points whose anchor pose has a heading difference ``d``."""
    a, b, _ = inverse_left_jacobian_terms(d)
    x, y = difference[..., 0], difference[..., 1]
    return np.stack([a * x + b * y, a * y - b * x], -1)


def inverse_left_jacobians(w: Array) -> Array:
    """``V(w)⁻¹`` ``(..., 3, 3)`` for rotation vectors ``(..., 3)``."""
    return so3_left_jacobian_inverse(w)


def inverse_left_jacobian_slopes(w: Array, e: Array) -> Array:
    """Derivatives ``(..., 3, 3)`` of ``V(w)⁻¹ e`` by w, for rotation vectors and differences ``(..., 3)``.

    ``V(w)⁻¹ = I - ½ W + c W²`` with ``W = [w]×`` and ``c = (1 - (φ/2) cot(φ/2)) / φ²``.
    """
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < _SMALL_TURN
    safe = np.where(small, 1.0, angle)
    half = 0.5 * safe
    cot = 1.0 / np.tan(half)
    rest = 1.0 - half * cot
    slope = -0.5 * (cot - half / np.sin(half) ** 2)  # of `rest` by the angle
    t2 = angle**2
    c = np.where(small, 1.0 / 12.0 + t2 / 720.0 + t2**2 / 30240.0, rest / safe**2)
    by_angle = np.where(
        small, 1.0 / 360.0 + t2 / 7560.0 + t2**2 / 201600.0, slope / safe**3 - 2.0 * rest / safe**4
    )  # dc/dφ over φ
    W, E = skew(w), skew(e)
    We = (W @ e[..., None])[..., 0]
    along = (W @ We[..., None]) * w[..., None, :]
    return np.asarray(0.5 * E - c * (skew(We) + W @ E) + by_angle * along)


def pose_differences(poses: Array, means: Array, chart: str) -> tuple[Array, Array]:
    """Differences ``(m, 6)`` of 3-D poses from means (rotation about the base axes, translation), and the rotations.

    Parameters
    ----------
    poses, means : (m, 7)
    chart : "cartesian" or "group"
    """
    w = so3_log(quat_multiply(poses[:, 3:], means[:, 3:] * _CONJUGATE))
    e = poses[:, :3] - means[:, :3]
    return np.hstack([w, chart_difference(e, w, chart)]), w


def chart_difference(e: Array, w: Array, chart: str) -> Array:
    """Differences ``(n, 3)`` of points whose anchor poses are rotated by ``w`` ``(n, 3)``, in a chart."""
    return np.einsum("kij,kj->ki", inverse_left_jacobians(w), e) if chart == "group" else e


def map_difference(x: ArrayLike, mean: ArrayLike, chart: str, *, space: bool = False) -> Array:
    """Difference of a vector ``[x, y, θ, l1x, l1y, …]`` from a mean, in a chart ``(n,)``.

    In 3-D the vector is ``[pose (7), l1x, l1y, l1z, …]``; the difference starts with rotation and translation (6).
    ``rᵀ P⁻¹ r`` with the covariance P of the Cartesian vector is the squared distance in that chart.

    Parameters
    ----------
    x, mean : (n,)
        In the base frame.
    chart : "cartesian" or "group"
    """
    x, mean = np.asarray(x, dtype=np.float64), np.asarray(mean, dtype=np.float64)
    if space:
        first, w = pose_differences(x[None, :7], mean[None, :7], chart)
        e = (x[7:] - mean[7:]).reshape(-1, 3)
        return np.concatenate([first[0], chart_difference(e, np.broadcast_to(w, e.shape), chart).ravel()])
    r = x - mean
    r[2] = wrap_angle(r[2])
    if chart == "group":
        points = apply_inverse_left_jacobian(np.concatenate([r[:2], r[3:]]).reshape(-1, 2), r[2])
        r[:2], r[3:] = points[0], points[1:].ravel()
    return r
