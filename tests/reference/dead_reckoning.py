"""Dead reckoning of a car-like vehicle, one control at a time, by the rear-axle model."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.records import SteeringControls


def integrate(controls: SteeringControls, times: np.ndarray) -> np.ndarray:
    """Rear-axle poses ``(q, 3)`` at ``times``, from (0, 0, 0) at the first control; each control holds to the next."""
    L, H = controls.geometry.wheelbase, controls.geometry.encoder_offset
    x = y = phi = 0.0
    k = 0
    now = float(controls.times[0])
    out = []
    for t in times:
        while now < t:
            until = float(controls.times[k + 1]) if k + 1 < len(controls.times) else math.inf
            dt = min(until, float(t)) - now
            tangent = math.tan(controls.steering[k])
            v = controls.speed[k] / (1.0 - tangent * H / L)  # left wheel to the middle of the axle
            x += dt * v * math.cos(phi)
            y += dt * v * math.sin(phi)
            phi += dt * v / L * tangent
            now += dt
            if now >= until:
                k += 1
        out.append((x, y, phi))
    return np.array(out)


def drive_arcs(speed, rate, dt, steps=400) -> np.ndarray:
    """Pose ``(3,)`` after speeds and yaw rates held for ``dt`` each: tiny straight steps, midpoint heading."""
    x = y = th = 0.0
    for v, w, h in zip(speed, rate, dt):
        for _ in range(steps):
            d = h / steps
            x += v * d * math.cos(th + 0.5 * w * d)
            y += v * d * math.sin(th + 0.5 * w * d)
            th += w * d
    return np.array([x, y, th])


def drive_arcs_covariance(speed, rate, dt, noise) -> np.ndarray:
    """Right-tangent covariance ``(3, 3)`` of :func:`drive_arcs`: finite differences on every error, one by one."""

    def pose(dv, dw):
        return drive_arcs(speed + dv, rate + dw, dt, steps=20)

    base = pose(0.0 * speed, 0.0 * rate)
    moving = (speed != 0) | (rate != 0)
    errors = []  # each a (dv, dw) of one standard deviation
    if noise.per_increment:
        constant = [(noise.speed * moving, 0 * rate), (0 * speed, noise.yaw_rate * moving)]
        errors = [*constant, (noise.speed_fraction * speed, 0 * rate), (0 * speed, noise.yaw_rate_fraction * rate)]
    for k in np.flatnonzero(moving):
        one = np.eye(len(speed))[k]
        errors.append((one * noise.speed_walk / math.sqrt(dt[k]), 0 * rate))
        errors.append((0 * speed, one * noise.yaw_walk / math.sqrt(dt[k])))
        if not noise.per_increment:
            errors.append((one * math.hypot(noise.speed, noise.speed_fraction * speed[k]), 0 * rate))
            errors.append((0 * speed, one * math.hypot(noise.yaw_rate, noise.yaw_rate_fraction * rate[k])))
    P = np.zeros((3, 3))
    c, s = math.cos(base[2]), math.sin(base[2])
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    for dv, dw in errors:
        j = turn @ (pose(1e-4 * dv, 1e-4 * dw) - pose(-1e-4 * dv, -1e-4 * dw)) / 2e-4
        P += np.outer(j, j)
    d = float(np.sum(np.abs(speed) * dt))
    return P + np.diag(
        [
            noise.floor_position**2,
            noise.floor_position**2 + (noise.lateral * d) ** 2,
            noise.floor_heading**2 + (noise.heading * d) ** 2,
        ]
    )
