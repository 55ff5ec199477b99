"""Latitude from Earth-centred coordinates by plain iteration."""

from __future__ import annotations

import math


def iterate_geodetic(x: float, y: float, z: float, rounds: int = 200) -> tuple[float, float, float]:
    """Latitude, longitude [deg], height [m]: ``tan φ = (z + e² N(φ) sin φ) / ρ`` until it stands still."""
    a, f = 6378137.0, 1.0 / 298.257223563
    e2 = f * (2.0 - f)
    rho = math.hypot(x, y)
    phi = math.atan2(z, rho * (1.0 - e2))
    for _ in range(rounds):
        n = a / math.sqrt(1.0 - e2 * math.sin(phi) ** 2)
        phi = math.atan2(z + e2 * n * math.sin(phi), rho)
    n = a / math.sqrt(1.0 - e2 * math.sin(phi) ** 2)
    height = rho * math.cos(phi) + z * math.sin(phi) - a * a / n
    return math.degrees(phi), math.degrees(math.atan2(y, x)), height
