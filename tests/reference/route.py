"""The vehicle of the landmark field in plain Python: the twin of the compiled route follower."""

from __future__ import annotations

import math

import numpy as np


def follow_route_slowly(
    route: np.ndarray,
    steps: int,
    *,
    speed: float,
    dt: float,
    wheelbase: float,
    max_steering: float,
    steering_rate: float,
    look_ahead: float,
) -> tuple[np.ndarray, np.ndarray]:
    poses, steering = [(0.0, 0.0, 0.0)], []
    carrot, G = 0, 0.0
    for _ in range(steps):
        x, y, phi = poses[-1]
        for _ in range(len(route)):
            if math.dist((x, y), route[carrot]) >= look_ahead:
                break
            carrot = (carrot + 1) % len(route)
        want = math.remainder(math.atan2(route[carrot][1] - y, route[carrot][0] - x) - phi, 2 * math.pi)
        G += min(max(want - G, -steering_rate * dt), steering_rate * dt)
        G = min(max(G, -max_steering), max_steering)
        steering.append(G)
        poses.append(
            (
                x + speed * dt * math.cos(G + phi),
                y + speed * dt * math.sin(G + phi),
                phi + speed * dt * math.sin(G) / wheelbase,
            )
        )
    return np.array(poses), np.array(steering)
