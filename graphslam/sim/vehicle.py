"""The simulated vehicle: a closed wavy route, and the front-steer model of Combined SLAM that drives along it."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array, arc_length, se2_inverse, se2_transform, wrap_angle
from graphslam.sim.kernels import follow_route_kernel

# Spacing of the route's polyline [m]: small against any look-ahead, so the carrot moves smoothly.
_SPACING = 0.1


def wavy_loop(lap_length: float, waves: int, amplitude: float) -> Array:
    """Closed curve ``r(θ) = R (1 + amplitude · sin(waves · θ))``, driven counter-clockwise.

    Parameters
    ----------
    lap_length : float
        Length of one lap [m]; fixes R.
    waves : int
        Number of waves per lap; 0 is a circle.
    amplitude : float
        Wave height relative to R, in [0, 1).

    Returns
    -------
    (m, 2)
        Points at equal distances, in the frame whose origin is the first point and whose x axis is the tangent
        there. The first point is not repeated at the end.
    """
    theta = np.linspace(0.0, 2.0 * np.pi, 200 * max(waves, 1) + 20_000)
    r = 1.0 + amplitude * np.sin(waves * theta)
    curve = np.stack([r * np.cos(theta), r * np.sin(theta)], -1)
    s = arc_length(curve)
    curve, s = curve * (lap_length / s[-1]), s * (lap_length / s[-1])
    at = np.linspace(0.0, lap_length, max(round(lap_length / _SPACING), 16), endpoint=False)
    points = np.stack([np.interp(at, s, curve[:, 0]), np.interp(at, s, curve[:, 1])], -1)
    # tangent at θ = 0: (dr/dθ, r) with r = 1
    start = np.array([*points[0], np.arctan2(1.0, amplitude * waves)])
    return se2_transform(se2_inverse(start), points)


def offset_from_route(route: Array, s: Array, lateral: Array) -> Array:
    """Points ``(n, 2)`` at arc length ``s`` (n,) [m] and ``lateral`` (n,) metres left of a closed route ``(m, 2)``."""
    m = len(route)
    closed = np.concatenate([route, route[:1]])
    length = arc_length(closed)
    at = np.mod(s, length[-1])
    p = np.stack([np.interp(at, length, closed[:, k]) for k in (0, 1)], -1)
    i = np.clip(np.searchsorted(length, at, side="right") - 1, 0, m - 1)
    t = closed[i + 1] - closed[i]
    t = t / np.linalg.norm(t, axis=1, keepdims=True)
    return p + lateral[:, None] * np.stack([-t[:, 1], t[:, 0]], -1)


def follow_route(
    route: Array,
    steps: int,
    *,
    speed: float,
    dt: float,
    wheelbase: float,
    max_steering: float,
    steering_rate: float,
    look_ahead: float,
) -> tuple[Array, Array]:
    """Drive ``steps`` control steps along a closed route from the identity pose.

    Combined SLAM, section 5: ``x' = x + V dt cos(G + φ)``, ``y' = y + V dt sin(G + φ)``, ``φ' = φ + V dt sin(G)/L``;
    the steering angle G points at a carrot ``look_ahead`` metres away, within its limit and rate.

    Returns
    -------
    poses : (steps + 1, 3)
        Base poses in the first base's frame, headings wrapped.
    steering : (steps,)
        G [rad], constant during each step.
    """
    poses = np.zeros((steps + 1, 3))
    steering = np.zeros(steps)
    follow_route_kernel(
        np.ascontiguousarray(route),
        look_ahead,
        speed * dt,
        wheelbase,
        max_steering,
        steering_rate * dt,
        poses,
        steering,
    )
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses, steering
