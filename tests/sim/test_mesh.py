"""Solids, sections and what stands about, against plain arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.sim.clutter import KeepClear, park_cars, scatter_obstacles
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, find_revisits
from tests.reference.mesh_section import mesh_section
from tests.sim.solid import Solid


def solid(mesh: MeshBuilder) -> Solid:
    vertices, triangles = mesh.build()
    xyz = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    return Solid(
        World(name="test", vertices=vertices, triangles=triangles, waypoints=xyz, corner_radius=1.0, speed=1.0, meta={})
    )


def volume(mesh: MeshBuilder) -> float:
    """By the divergence theorem: right only if every facet looks outwards."""
    v, t = mesh.build()
    a, b, c = v[t[:, 0]], v[t[:, 1]], v[t[:, 2]]
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def is_closed(mesh: MeshBuilder) -> bool:
    v, t = mesh.build()
    _, same = np.unique(np.round(v, 9), axis=0, return_inverse=True)
    edges = np.sort(same.ravel()[t][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all())


def test_solids_are_closed_and_have_their_volume() -> None:
    cases = {
        "box": (lambda m: m.box((1.0, 2.0, 3.0), (2.0, 4.0, 6.0)), 6.0),
        "turned box": (lambda m: m.turned_box((5.0, 1.0), (2.0, 0.5), 0.7, -1.0, 2.0), 3.0),
        "prism": (lambda m: m.prism((1.0, 1.0), 0.5, 0.0, 2.0, sides=6), 2.0 * 1.5 * np.sqrt(3.0) * 0.25),
        "ramp to the ground": (lambda m: m.ramp((0.0, 0.0, 0.0), (10.0, 0.0, 2.0), 3.0, 0.0), 30.0),
        "ramp plate": (lambda m: m.ramp((0.0, 0.0, 1.0), (0.0, 10.0, 2.0), 3.0), 9.0),
        "wall with a door": (
            lambda m: m.wall((0.0, 0.0), (3.0, 4.0), 0.0, 3.0, thickness=0.2, openings=[(1.0, 2.0, 0.0, 2.1)]),
            0.2 * (15.0 - 2.1),
        ),
        "slab with holes": (
            lambda m: m.slab((0.0, 0.0, 10.0, 5.0), 3.0, thickness=0.3, holes=[(1, 1, 2, 3), (4, 4, 9, 9)]),
            0.3 * (50.0 - 2.0 - 5.0),
        ),
    }
    for name, (build, wanted) in cases.items():
        mesh = MeshBuilder()
        build(mesh)
        assert volume(mesh) == pytest.approx(wanted, rel=1e-9), name
        assert is_closed(mesh), name


def test_beams_pass_openings_and_nothing_else() -> None:
    mesh = MeshBuilder()
    openings = [(1.0, 2.0, 0.0, 2.1), (3.0, 4.5, 1.0, 1.8)]
    mesh.wall((0.0, 0.0), (0.0, 6.0), 0.0, 3.0, thickness=0.2, openings=openings)
    mesh.slab((0.0, 0.0, 8.0, 6.0), 3.0, holes=[(2.0, 1.0, 3.0, 2.0)])
    s = solid(mesh)
    rng = np.random.default_rng(3)
    p = np.column_stack([np.full(20000, 5.0), rng.uniform(0.0, 6.0, 20000), rng.uniform(0.0, 2.69, 20000)])
    t = s.cast(p, np.broadcast_to([-1.0, 0.0, 0.0], p.shape))
    free = np.zeros(len(p), bool)
    for a, b, c, d in openings:
        free |= (p[:, 1] > a) & (p[:, 1] < b) & (p[:, 2] > c) & (p[:, 2] < d)
    assert np.array_equal(np.isinf(t), free)
    assert np.allclose(t[~free], 4.9)
    p = np.column_stack([rng.uniform(0.2, 8.0, 20000), rng.uniform(0.0, 6.0, 20000), np.full(20000, 1.0)])
    t = s.cast(p, np.broadcast_to([0.0, 0.0, 1.0], p.shape))
    hole = (p[:, 0] > 2.0) & (p[:, 0] < 3.0) & (p[:, 1] > 1.0) & (p[:, 1] < 2.0)
    assert np.array_equal(np.isinf(t), hole)


def test_ramp_and_its_sides_rise_evenly() -> None:
    mesh = MeshBuilder()
    start, end = (2.0, 1.0, 0.5), (2.0, 11.0, 2.5)
    mesh.ramp(start, end, 4.0, 0.0)
    mesh.ramp_sides(start, end, 4.0, 1.0, 0.0)
    s = solid(mesh)
    y = np.linspace(1.01, 10.99, 50)
    for x, above in ((2.0, 0.0), (0.1, 0.0), (-0.1, 1.0), (4.1, 1.0)):
        p = np.column_stack([np.full(50, x), y, np.full(50, 10.0)])
        t = s.cast(p, np.broadcast_to([0.0, 0.0, -1.0], p.shape))
        assert np.allclose(10.0 - t, 0.5 + 0.2 * (y - 1.0) + above, atol=1e-5)


def test_impossible_solids_are_refused() -> None:
    mesh = MeshBuilder()
    with pytest.raises(GeometryError, match="no extent"):
        mesh.slab((0.0, 0.0, -1.0, 5.0), 0.0)
    with pytest.raises(GeometryError, match="not finite"):
        mesh.box((0.0, 0.0, np.nan), (1.0, 1.0, 1.0))
    v, t = mesh.build()
    assert v.shape == (0, 3)
    assert t.shape == (0, 3)


def section_by_hand(vertices: Array, triangles: np.ndarray, height: float) -> list[tuple[float, ...]]:
    """One triangle at a time."""
    found = []
    for t in triangles:
        ends = []
        for i in range(3):
            a, b = vertices[t[i]], vertices[t[(i + 1) % 3]]
            if (a[2] >= height) != (b[2] >= height):
                u = (height - a[2]) / (b[2] - a[2])
                ends.append(tuple(np.round(a[:2] + u * (b[:2] - a[:2]), 9)))
        if ends:
            found.append(tuple(sorted(ends)))
    return sorted(found)


@pytest.mark.parametrize("height", [0.0, 0.37, 1.0, 5.0])
def test_section_is_that_of_every_triangle(height: float) -> None:
    rng = np.random.default_rng(1)
    vertices = rng.uniform(-1.0, 1.0, (60, 3))
    vertices[::7, 2] = height  # corners exactly on the plane
    triangles = rng.permuted(np.tile(np.arange(60), (40, 1)), axis=1)[:, :3].astype(np.int32)
    got = mesh_section(vertices, triangles, height)
    assert sorted(tuple(sorted(tuple(np.round(e, 9)) for e in s)) for s in got) == section_by_hand(
        vertices, triangles, height
    )


def test_nothing_is_put_in_the_way() -> None:
    corners = [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (20.0, 15.0, 0.0)]
    clear = KeepClear(plan_route(corners, 2.0), margin=1.0)
    # 1.5 m off the way, half a metre thick: allowed; half a metre nearer: not; on another floor: anywhere
    assert clear.allows((10.0, 1.4), (6.0, 0.5), 0.0, 0.0)
    assert not clear.allows((10.0, 1.2), (6.0, 0.5), 0.0, 0.0)
    assert not clear.allows((10.0, 1.4), (6.0, 0.5), np.pi / 2, 0.0)
    assert clear.allows((10.0, 0.0), (6.0, 0.5), 0.0, 3.2)
    assert clear.distance((10.0, 3.0), (2.0, 2.0), 0.0, 0.0) == pytest.approx(2.0, abs=0.02)
    rng = SeedTree(1).generator()
    mesh = MeshBuilder()
    count = scatter_obstacles(mesh, (0.0, -4.0, 18.0, 4.0), 0.0, 200, clear, rng, forbidden=[(5.0, 1.0, 9.0, 4.0)])
    bays = np.array([(x, y, np.pi / 2) for x in range(1, 16, 3) for y in (-8.0, -2.6, 9.0)])
    cars = park_cars(mesh, bays, 0.0, 1.0, clear, rng)
    assert 50 < count < 190
    assert cars == 10  # the row that reaches to within a metre of the way stays empty
    s = solid(mesh)
    route = plan_route(corners, 2.0)
    p = route.positions(route.every(0.1))
    assert s.distance(p + [0.0, 0.0, 0.5]).min() > 0.95
    v, _ = mesh.build()
    inside = (v[:, 0] > 5.01) & (v[:, 0] < 8.99) & (v[:, 1] > 1.01) & (v[:, 1] < 3.99)
    assert not inside.any()


def test_a_bay_more_changes_no_other_car() -> None:
    route = plan_route([(0.0, 50.0, 0.0), (10.0, 50.0, 0.0)], 1.0)
    bays = np.array([(3.0 * k, 0.0, np.pi / 2) for k in range(8)])
    meshes = []
    for some in (bays, bays[:-1]):
        mesh = MeshBuilder()
        park_cars(mesh, some, 0.0, 0.6, KeepClear(route), SeedTree(4).generator())
        meshes.append(mesh.build()[0])
    assert np.array_equal(meshes[0][: len(meshes[1])], meshes[1])


def test_revisits_of_a_known_way() -> None:
    """A square of 40 m driven one and a half times, and a way there and back beside it."""
    square = [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (40.0, 40.0, 0.0), (0.0, 40.0, 0.0), (0.0, 0.0, 0.0)]
    route = plan_route([(-10.0, 0.0, 0.0), *square, (40.0, 0.0, 0.0), (40.0, 30.0, 0.0)], 1.5)
    [found] = find_revisits(route)
    assert found["same_heading"]
    a, b = route.positions(np.array(found["first"])), route.positions(np.array(found["again"]))
    assert np.linalg.norm(a - b, axis=1).max() < 1.0
    lap = 160.0 - 4 * 1.5 * (2.0 - np.pi / 2)
    assert found["again"][0] - found["first"][0] == pytest.approx(lap, abs=1.5)
    assert found["again"][1] == pytest.approx(route.length, abs=0.01)
    there = [(0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (50.0, 8.0, 0.0), (60.0, 8.0, 0.0), (60.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    [back] = find_revisits(plan_route(there, 1.5), shortest=3.0)
    assert not back["same_heading"]
    assert back["first"][0] == pytest.approx(50.0, abs=1.6)
    assert back["first"][1] == pytest.approx(0.0, abs=1.1)
    assert find_revisits(plan_route([(0.0, 0.0, 0.0), (90.0, 0.0, 0.0), (90.0, 50.0, 0.0)], 1.5)) == []
    # the same place in the plan, a storey higher, is another place
    spiral = [(0, 0, 0), (40, 0, 1.0), (40, 40, 2.0), (0, 40, 3.0), (0, 0, 4.0), (40, 0, 5.0)]
    assert find_revisits(plan_route(spiral, 1.5)) == []
