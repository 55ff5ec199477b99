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
