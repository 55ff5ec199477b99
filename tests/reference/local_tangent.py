"""Geodetic coordinates in a local tangent frame."""

from __future__ import annotations

import numpy as np

from graphslam.core.geodesy import check_geodetic, geodetic_to_ecef, tangent_axes
from graphslam.core.geometry import Array, ArrayLike


def geodetic_to_enu(geodetic: ArrayLike, latitude: float, longitude: float, height: float = 0.0) -> Array:
    """Inverse of :func:`enu_to_geodetic`: east, north, up [m] ``(..., 3)``."""
    g = np.asarray(geodetic, dtype=np.float64)
    check_geodetic(g[..., 0], g[..., 1])
    check_geodetic(latitude, longitude)
    origin = geodetic_to_ecef([latitude, longitude, height])
    return np.asarray((geodetic_to_ecef(g) - origin) @ tangent_axes(latitude, longitude).T)
