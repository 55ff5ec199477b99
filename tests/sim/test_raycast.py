"""Rays into meshes against casting them one triangle at a time."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.extras import import_extra
from graphslam.sim.garage import garage
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
    np.testing.assert_allclose(got, wanted, rtol=1e-12)
    assert len(np.unique(np.round(wanted, 3))) > 2000


def test_a_ray_that_meets_nothing_is_nan_and_either_side_stops_one() -> None:
    caster = RayCaster(*quad([1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]))
    rays = np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 0, -1, 0, 0], [3, 0, 0, -1, 0, 0], [0, 2, 0, 1, 0, 0]])
    np.testing.assert_allclose(caster.ranges(rays), [1, np.nan, 2, np.nan], atol=1e-6)


@pytest.mark.skipif(find_spec("open3d") is None, reason="the extra open3d is not installed")
def test_ranges_and_distances_are_those_of_open3d(rng: np.random.Generator) -> None:
    """It casts in single precision: a tenth of a millimetre in a garage of 60 m. Its distances of points to slim
    triangles are too great by up to a centimetre, so ours may be smaller, never greater."""
    o3d = import_extra("open3d", "a comparison")
    world = garage("A")
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(world.vertices.astype("f4")), o3d.core.Tensor(world.triangles.astype("u4")))
    low, high = world.vertices.min(axis=0), world.vertices.max(axis=0)
    d = rng.normal(size=(20_000, 3))
    rays = np.hstack([rng.uniform(low, high, (20_000, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)])
    caster = RayCaster.of(world)
    got, wanted = caster.ranges(rays), scene.cast_rays(o3d.core.Tensor(rays.astype("f4")))["t_hit"].numpy()
    wanted[np.isinf(wanted)] = np.nan
    assert np.mean(np.isnan(got)) > 0.01
    assert np.mean(np.isnan(got) == np.isnan(wanted)) > 0.9999
    assert np.nanquantile(np.abs(got - wanted), 0.999) < 1e-4
    more = scene.compute_distance(o3d.core.Tensor(rays[:, :3].astype("f4")), nthreads=1).numpy()
    more -= caster.distances(rays[:, :3])
    assert more.min() > -1e-4
    assert np.median(np.abs(more)) < 1e-5


def test_distances_are_those_of_the_nearest_triangle(rng: np.random.Generator) -> None:
    """Slim triangles, triangles without an area and triangles that overlap among them."""
    vertices = rng.uniform(-1, 1, (60, 3))
    triangles = rng.integers(0, 60, (80, 3))
    triangles[:4, 2] = triangles[:4, 1]
    vertices[triangles[5, 2]] = 0.5 * (vertices[triangles[5, 0]] + vertices[triangles[5, 1]])
    points = rng.uniform(-2, 2, (200, 3))
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    # weights of a fine lattice over each triangle: never nearer than the nearest place, nor farther by a cell
    u, v = np.array([(i, j) for i in range(41) for j in range(41 - i)]).T[:, :, None, None] / 40.0
    lattice = (a + u * (b - a) + v * (c - a)).reshape(-1, 3)
    near = np.array([np.min(np.linalg.norm(lattice - p, axis=1)) for p in points])
    got = RayCaster(vertices, triangles).distances(points)
    assert np.all(got <= near + 1e-12)
    assert np.all(got >= near - 0.1)
    assert np.median(near - got) < 2e-3


def test_a_mesh_far_from_the_origin_is_as_exact(rng: np.random.Generator) -> None:
    world, shift = hall(), np.array([4e5, 5e6, 300.0])
    rays = some_rays(rng, 500)
    near = RayCaster.of(world).ranges(rays)
    far = RayCaster(world.vertices + shift, world.triangles).ranges(rays + [*shift, 0, 0, 0])
    np.testing.assert_allclose(far, near, atol=1e-6)  # the shift alone rounds by 1e-9 m


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
