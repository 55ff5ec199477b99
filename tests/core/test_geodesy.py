"""Tangent plane to WGS 84: against plain iteration, round trips, known places, and small displacements."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import GeometryError
from graphslam.core.geodesy import ecef_to_geodetic, enu_to_geodetic, geodetic_to_ecef
from tests.reference.geodesy import iterate_geodetic
from tests.reference.local_tangent import geodetic_to_enu


def test_closed_form_equals_iteration(rng):
    g = np.column_stack([rng.uniform(-89.9, 89.9, 300), rng.uniform(-180, 180, 300), rng.uniform(-5e3, 4e5, 300)])
    for xyz, closed in zip(geodetic_to_ecef(g), ecef_to_geodetic(geodetic_to_ecef(g))):
        slow = iterate_geodetic(*xyz)
        np.testing.assert_allclose(closed[:2], slow[:2], atol=1e-10)
        assert closed[2] == pytest.approx(slow[2], abs=1e-6)


def test_poles_and_equator():
    b = 6356752.314245
    np.testing.assert_allclose(geodetic_to_ecef([[90, 0, 0], [0, 90, 10]]), [[0, 0, b], [0, 6378147, 0]], atol=1e-6)
    np.testing.assert_allclose(
        ecef_to_geodetic([[0, 0, -b - 5], [6378137.0, 0, 0]]), [[-90, 0, 5], [0, 0, 0]], atol=1e-6
    )


def test_a_metre_north_and_east():
    """Radii of curvature say how many degrees a metre is (meridian M, prime vertical N)."""
    lat, lon = -33.88, 151.19
    e2 = 0.00669437999014
    w = 1 - e2 * np.sin(np.deg2rad(lat)) ** 2
    M, N = 6378137.0 * (1 - e2) / w**1.5, 6378137.0 / np.sqrt(w)
    north = enu_to_geodetic([0.0, 1.0], lat, lon)
    east = enu_to_geodetic([1.0, 0.0], lat, lon)
    assert north[0] - lat == pytest.approx(np.rad2deg(1 / M), rel=1e-6)
    assert east[1] - lon == pytest.approx(np.rad2deg(1 / (N * np.cos(np.deg2rad(lat)))), rel=1e-6)
    assert north[1] == pytest.approx(lon, abs=1e-12)


def test_round_trip(rng):
    enu = rng.normal(size=(50, 3)) * [3e4, 3e4, 100]
    back = geodetic_to_enu(enu_to_geodetic(enu, 47.4, -122.3, 80.0), 47.4, -122.3, 80.0)
    np.testing.assert_allclose(back, enu, atol=1e-6)
    flat = enu_to_geodetic([300.0, 0.0], 47.4, -122.3)
    assert flat[2] == pytest.approx(300.0**2 / (2 * 6.388e6), rel=0.01)  # the plane leaves the ellipsoid


@pytest.mark.parametrize("datum", [(91.0, 0.0), (np.nan, 0.0), (0.0, 1e3)])
def test_impossible_datums_are_refused(datum):
    with pytest.raises(GeometryError, match="impossible"):
        enu_to_geodetic([0.0, 0.0], *datum)


def test_impossible_points_are_refused():
    with pytest.raises(GeometryError, match="not usable"):
        enu_to_geodetic([np.inf, 0.0], 0.0, 0.0)
    with pytest.raises(GeometryError, match="centre"):
        ecef_to_geodetic([1.0, 1.0, 1.0])
