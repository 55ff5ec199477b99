"""Conversion between a local tangent plane (east, north, up) and latitude, longitude on the WGS 84 ellipsoid.

Angles are degrees, heights metres above the ellipsoid. Arrays broadcast over leading axes.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array, ArrayLike

SEMI_MAJOR = 6378137.0
"""a [m]."""
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)


def check_geodetic(latitude: ArrayLike, longitude: ArrayLike) -> None:
    """Refuse impossible latitudes and longitudes."""
    lat, lon = np.asarray(latitude, dtype=np.float64), np.asarray(longitude, dtype=np.float64)
    if not (np.all(np.isfinite(lat)) and np.all(np.abs(lat) <= 90.0)):
        raise GeometryError("latitude is impossible", got=latitude, wanted="degrees in [-90, 90]")
    if not (np.all(np.isfinite(lon)) and np.all(np.abs(lon) <= 360.0)):
        raise GeometryError("longitude is impossible", got=longitude, wanted="degrees")


def geodetic_to_ecef(geodetic: ArrayLike) -> Array:
    """Earth-centred coordinates ``(..., 3)`` [m] of latitude, longitude [deg] and height [m] ``(..., 3)``."""
    g = np.asarray(geodetic, dtype=np.float64)
    lat, lon, h = np.deg2rad(g[..., 0]), np.deg2rad(g[..., 1]), g[..., 2]
    N = SEMI_MAJOR / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    r = (N + h) * np.cos(lat)
    return np.stack([r * np.cos(lon), r * np.sin(lon), (N * (1.0 - _E2) + h) * np.sin(lat)], -1)


def ecef_to_geodetic(ecef: ArrayLike) -> Array:
    """Inverse of :func:`geodetic_to_ecef`, in closed form (Vermeille, Journal of Geodesy 76, 2002, eq. 1-13)."""
    x, y, z = np.moveaxis(np.asarray(ecef, dtype=np.float64), -1, 0)
    if np.any(np.sqrt(x**2 + y**2 + z**2) < 5e4):
        raise GeometryError("point is near the Earth's centre", wanted="50 km from it, or more")
    rho = np.hypot(x, y)
    p = rho**2 / SEMI_MAJOR**2
    q = (1.0 - _E2) / SEMI_MAJOR**2 * z**2
    r = (p + q - _E2**2) / 6.0
    s = _E2**2 * p * q / (4.0 * r**3)
    t = np.cbrt(1.0 + s + np.sqrt(s * (2.0 + s)))
    u = r * (1.0 + t + 1.0 / t)
    v = np.sqrt(u**2 + _E2**2 * q)
    w = _E2 * (u + v - q) / (2.0 * v)
    k = np.sqrt(u + v + w**2) - w
    D = k * rho / (k + _E2)
    d = np.hypot(D, z)
    height = (k + _E2 - 1.0) / k * d
    return np.stack([np.rad2deg(2.0 * np.arctan2(z, D + d)), np.rad2deg(np.arctan2(y, x)), height], -1)


def tangent_axes(latitude: float, longitude: float) -> Array:
    """Rows: east, north and up at a place, in Earth-centred axes ``(3, 3)``."""
    lat, lon = np.deg2rad(latitude), np.deg2rad(longitude)
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def enu_to_geodetic(enu: ArrayLike, latitude: float, longitude: float, height: float = 0.0) -> Array:
    """Latitude, longitude [deg] and height [m] ``(..., 3)`` of points in the tangent plane at a datum.

    Parameters
    ----------
    enu : (..., 2) or (..., 3)
        East, north and up (default 0) [m].
    latitude, longitude, height : float
        Of the plane's origin.
    """
    check_geodetic(latitude, longitude)
    p = np.asarray(enu, dtype=np.float64)
    if p.shape[-1] not in (2, 3) or not np.all(np.isfinite(p)):
        raise GeometryError("points of the tangent plane are not usable", got=p.shape, wanted="finite (..., 2 or 3)")
    if p.shape[-1] == 2:
        p = np.concatenate([p, np.zeros((*p.shape[:-1], 1))], -1)
    origin = geodetic_to_ecef([latitude, longitude, height])
    return ecef_to_geodetic(origin + p @ tangent_axes(latitude, longitude))
