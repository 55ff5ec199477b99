"""Compiled loops of the simulators: a vehicle that steers along a route."""

from __future__ import annotations

import math

from graphslam.core.geometry import Array
from graphslam.core.jit import njit


@njit(error_model="numpy")
def follow_route_kernel(
    route: Array,
    look_ahead: float,
    stride: float,
    wheelbase: float,
    max_steering: float,
    max_step: float,
    poses: Array,
    steering: Array,
) -> None:
    """Drive a front-steered vehicle after a carrot on a closed polyline.

    route : (m, 2) closed polyline (first point not repeated), densely sampled against ``look_ahead``.
    stride : distance per step [m]. max_step : steering rate times dt [rad].
    poses : (n + 1, 3) out, poses[0] given; headings are left unwrapped.
    steering : (n,) out, held constant during step k.
    """
    m = len(route)
    carrot = 0
    g = 0.0
    for k in range(len(steering)):
        x, y, phi = poses[k, 0], poses[k, 1], poses[k, 2]
        # the carrot only moves forward: a path that comes near itself cannot pull it back
        dx, dy = route[carrot, 0] - x, route[carrot, 1] - y
        moved = 0
        while dx * dx + dy * dy < look_ahead * look_ahead and moved < m:
            carrot = (carrot + 1) % m
            moved += 1
            dx, dy = route[carrot, 0] - x, route[carrot, 1] - y
        # the base moves along φ + G, so G = direction to the carrot - φ, within the limits of rate and angle
        want = math.atan2(dy, dx) - phi
        want = math.pi - (math.pi - want) % (2.0 * math.pi)
        g = min(max(want, g - max_step), g + max_step)
        g = min(max(g, -max_steering), max_steering)
        steering[k] = g
        poses[k + 1, 0] = x + stride * math.cos(g + phi)
        poses[k + 1, 1] = y + stride * math.sin(g + phi)
        poses[k + 1, 2] = phi + stride * math.sin(g) / wheelbase
