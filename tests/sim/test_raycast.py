"""Rays into meshes against casting them one triangle at a time."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.sim import raycast
from graphslam.sim.raycast import RayCaster
from tests.reference.plain_mesh import box, hall, plain_ranges, quad


def some_rays(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return np.hstack([rng.uniform([-1, -5, 0.8], [17, 5, 3.5], (n, 3)), d])


def test_ranges_are_those_of_the_nearest_triangle(rng: np.random.Generator) -> None:
    world = hall()
    rays = some_rays(rng, 3000)
    got, wanted = RayCaster.of(world).ranges(rays), plain_ranges(world.vertices, world.triangles, rays)
    assert np.all(np.isfinite(wanted))  # the hall is closed
    assert np.mean(np.abs(got - wanted) < 1e-5) > 0.999  # an edge may be met or not in single precision
    assert len(np.unique(np.round(wanted, 3))) > 2000


def test_a_ray_that_meets_nothing_is_nan_and_either_side_stops_one() -> None:
    caster = RayCaster(*quad([1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]))
    rays = np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 0, -1, 0, 0], [3, 0, 0, -1, 0, 0], [0, 2, 0, 1, 0, 0]])
    np.testing.assert_allclose(caster.ranges(rays), [1, np.nan, 2, np.nan], atol=1e-6)


def test_chunks_change_nothing(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    caster, rays = RayCaster.of(hall()), some_rays(rng, 1000)
    whole = caster.ranges(rays)
    monkeypatch.setattr(raycast, "_CHUNK", 7)
    assert caster.ranges(rays).tobytes() == whole.tobytes()
    assert len(caster.ranges(np.zeros((0, 6)))) == 0


def test_a_mesh_far_from_the_origin_is_as_exact(rng: np.random.Generator) -> None:
    world, shift = hall(), np.array([4e5, 5e6, 300.0])
    rays = some_rays(rng, 500)
    near = RayCaster.of(world).ranges(rays)
    far = RayCaster(world.vertices + shift, world.triangles).ranges(rays + [*shift, 0, 0, 0])
    assert np.nanmedian(np.abs(far - near)) < 1e-5  # without taking the middle off, single precision is 0.5 m there


def test_distances_of_points() -> None:
    caster = RayCaster(*box([0, 0, 0], [2, 2, 2]))
    points = [[1, 1, 0.25], [1, 1, 3.5], [3, 3, 1]]
    np.testing.assert_allclose(caster.distances(points), [0.25, 1.5, np.sqrt(2)], atol=1e-6)


@pytest.mark.parametrize(
    ("vertices", "triangles", "what"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3), int), "without a triangle"),
        (np.zeros((3, 2)), [[0, 1, 2]], "wrong shape"),
        (np.zeros((3, 3)), [[0.0, 1, 2]], "wrong shape or type"),
        (np.zeros((3, 3)), [[0, 1, 3]], "triangle 0 names no vertex"),
        (np.zeros((3, 3)), [[0, 1, 2], [0, 1, -1]], "triangle 1 names no vertex"),
        ([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]], [[0, 1, 2]], "vertex 1 of a mesh is not finite"),
    ],
)
def test_impossible_meshes_are_refused(vertices: object, triangles: object, what: str) -> None:
    with pytest.raises(DataError, match=what):
        RayCaster(vertices, triangles)  # type: ignore[arg-type]


def test_impossible_rays_are_refused() -> None:
    caster = RayCaster(*box([0, 0, 0], [1, 1, 1]))
    with pytest.raises(DataError, match="wrong shape"):
        caster.ranges(np.zeros((4, 3)))
    rays = np.ones((9, 6))
    rays[4, 2] = np.nan
    with pytest.raises(DataError, match="ray 4 is not finite"):
        caster.ranges(rays)
