"""Worlds: the way has the stated length, is free and lies on the floor; seeds move clutter, layouts differ."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from graphslam.core.errors import GeometryError, UnknownNameError
from graphslam.sim.garage import garage
from graphslam.sim.garage_layouts import garage_layout
from graphslam.sim.mesh_worlds import mesh_world
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, find_revisits
from graphslam_studies.sim.building import building
from graphslam_studies.sim.mine import mine
from graphslam_studies.sim.tunnels import surface_nets
from tests.sim.solid import Solid

GARAGES = ["garage-A", "garage-B", "garage-C", "garage-D"]
NAMES = [*GARAGES, "mine", "building"]
LENGTH = {
    "garage-A": (303.0, 10.0),
    "garage-B": (303.0, 10.0),
    "garage-C": (303.0, 10.0),
    "garage-D": (303.0, 10.0),
    "mine": (1300.0, 15.0),
    "building": (892.0, 20.0),
}


@functools.cache
def world(name: str, seed: int = 0) -> World:
    kind, _, layout = name.partition("-")
    return {
        "garage": lambda: garage(layout, seed=seed),
        "mine": lambda: mine(seed=seed),
        "building": lambda: building(seed=seed),
    }[kind]()


@functools.cache
def solid(name: str, seed: int = 0) -> Solid:
    return Solid(world(name, seed))


def clearance(name: str, seed: int = 0, shift: float = 0.0) -> float:
    """Least distance from the axis of the robot's capsule, moved sideways, to anything on its way [m]."""
    route = world(name, seed).route()
    s = route.every(0.1)
    h = route.headings(s)
    axis = route.positions(s) + shift * np.column_stack([-np.sin(h), np.cos(h), np.zeros(len(s))])
    # radius 0.35 m, from 0.15 to 1.2 m above the floor: the axis goes from 0.5 to 0.85 m
    points = np.concatenate([axis + [0.0, 0.0, z] for z in np.linspace(0.5, 0.85, 8)])
    return float(solid(name, seed).distance(points).min())


@pytest.mark.parametrize("name", NAMES)
def test_way_has_the_stated_length(name: str) -> None:
    wanted, tolerance = LENGTH[name]
    w = world(name)
    s = w.route().every(0.05)
    driven = np.linalg.norm(np.diff(w.route().positions(s), axis=0), axis=1).sum()
    assert driven == pytest.approx(wanted, abs=tolerance)
    assert w.meta["length"] == pytest.approx(driven, rel=1e-4)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_robot_hits_nothing_on_its_way(name: str, seed: int) -> None:
    assert clearance(name, seed) >= 0.35


@pytest.mark.parametrize("name", NAMES)
def test_robot_would_hit_something_beside_its_way(name: str) -> None:
    """The test above can fail: a few metres to one side it does."""
    assert min(clearance(name, shift=d) for d in (-3.0, 3.0)) < 0.2


@pytest.mark.parametrize("name", NAMES)
def test_floor_lies_at_the_stated_height(name: str) -> None:
    route = world(name).route()
    p = route.positions(route.every(0.1))
    down = solid(name).cast(p + [0.0, 0.0, 0.5], np.broadcast_to([0.0, 0.0, -1.0], p.shape))
    assert np.abs(down - 0.5).max() < (0.03 if name == "mine" else 0.005)


@pytest.mark.parametrize("name", NAMES)
def test_no_beam_leaves_through_a_slit(name: str) -> None:
    """Rays downwards from the robot, and steeply, always end: floors and walls join."""
    route = world(name).route()
    p = route.positions(route.every(0.5)) + [0.0, 0.0, 0.6]
    azimuth = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False) + 0.013
    d = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(36, -0.15)])
    t = solid(name).cast(np.repeat(p, 36, axis=0), np.tile(d, (len(p), 1)))
    assert np.isfinite(t).all()


@pytest.mark.parametrize("name", NAMES)
def test_loops_are_places_seen_before(name: str) -> None:
    w = world(name)
    route = w.route()
    loops = np.array(w.meta["loops"])
    assert len(loops) >= 1
    a, b = route.positions(loops[:, 0]), route.positions(loops[:, 1])
    assert np.linalg.norm(a - b, axis=1).max() <= 1.0
    assert np.all(loops[:, 1] - loops[:, 0] > 19.9)
    # and none is missing: by brute force, every revisited point lies in a stated stretch
    s = route.every(1.0)
    p = route.positions(s)
    near = (np.linalg.norm(p[:, None] - p[None], axis=2) < 0.8) & (s[:, None] - s[None] > 21.0)
    again = s[near.any(axis=1)]
    stretches = np.array([r["again"] for r in find_revisits(route)])
    inside = (again[:, None] >= stretches[:, 0] - 1.0) & (again[:, None] <= stretches[:, 1] + 1.0)
    assert inside.any(axis=1).all()


@pytest.mark.parametrize("name", NAMES)
def test_slopes_can_be_driven_and_corners_are_level(name: str) -> None:
    route = world(name).route()
    assert np.abs(np.rad2deg(np.arctan(route.slopes(route.starts[:-1])))).max() < 9.0
    sharp = np.abs(route.curvature * route.plan) > np.deg2rad(25.0)
    assert sharp.any()
    assert np.abs(np.diff(route.points[:, 2])[sharp]).max() < 1e-9


def walls(w: World) -> set[bytes]:
    """Every triangle as bytes."""
    return {t.tobytes() for t in np.round(w.vertices[w.triangles], 6)}


@pytest.mark.parametrize("name", NAMES)
def test_seeds_move_clutter_not_walls(name: str) -> None:
    a, same, b, c = world(name, 0), world.__wrapped__(name, 0), world(name, 1), world(name, 2)
    assert np.array_equal(a.vertices, same.vertices)
    assert np.array_equal(a.triangles, same.triangles)
    assert np.array_equal(a.waypoints, b.waypoints)
    common, only = walls(a) & walls(b), walls(a) - walls(b)
    assert only  # something moved
    assert len(common & walls(c)) == len(common)  # what two seeds share, all share: the walls


def test_garage_layouts_differ() -> None:
    a, b, c = (world(n) for n in ("garage-A", "garage-B", "garage-C"))
    assert len({w.meta["pillar_period"] for w in (a, b, c)}) == 3
    turned = [np.sign(w.route().curvature).sum() for w in (a, b, c)]
    assert turned[0] * turned[1] < 0  # mirrored: left turns for right ones
    assert len({round(np.ptp(w.waypoints[:, 0])) for w in (a, b, c)}) == 3


@pytest.mark.parametrize("number", [1, 7, 22])
def test_garages_that_are_drawn_are_garages(number: int) -> None:
    name = f"garage-drawn-{number}"
    w, route = world(name), world(name).route()
    assert 270.0 < route.length < 400.0
    assert np.abs(np.rad2deg(np.arctan(route.slopes(route.starts[:-1])))).max() < 9.0
    assert clearance(name) >= 0.35
    assert len(w.meta["revisits"]) == 1
    assert w.meta["cars"] > 20
    assert np.array_equal(w.vertices, world.__wrapped__(name).vertices)
    assert np.array_equal(w.waypoints, world(name, 1).waypoints)


def test_layouts_are_drawn_by_their_number() -> None:
    numbers = range(1, 25)
    plans = [garage_layout(f"drawn-{n}") for n in numbers]
    assert len({(p.length, p.width, p.pitch) for p in plans}) == len(plans)
    assert {p.mirrored for p in plans} == {p.turned for p in plans} == {False, True}
    assert garage_layout("drawn-3") == plans[2]
    for name in ("drawn-0", "drawn--1", "drawn-x", "E"):
        with pytest.raises(UnknownNameError, match="layout"):
            mesh_world("garage", layout=name)
    for kind in ("mine", "building"):  # other walls along the same way
        usual, drawn = mesh_world(kind), mesh_world(kind, layout="drawn-2")
        assert np.array_equal(usual.waypoints, drawn.waypoints)
        assert len(walls(usual) & walls(drawn)) < 0.9 * len(walls(usual))


def test_garage_drives_through_both_levels_and_retraces_its_start() -> None:
    for name in GARAGES:
        w = world(name)
        route = w.route()
        p = route.positions(route.every(0.1))
        assert p[:, 2].max() == pytest.approx(3.2)
        [stretch] = w.meta["revisits"]
        assert stretch["first"][0] == 0.0
        assert stretch["first"][1] == pytest.approx(28.0, abs=1.0)
        assert stretch["same_heading"]
        centroid = p.mean(axis=0)
        assert np.linalg.norm(p[0] - centroid) > 18.0
        assert np.linalg.norm(p[-1] - centroid) > 12.0


def test_garage_levels_look_alike() -> None:
    """Pillars of both levels stand above one another at one period: what makes a false match."""
    w = world("garage-A")
    s = solid("garage-A")
    x = np.arange(10.5, 50.0, 0.1)
    sight = {}
    for level, floor in enumerate(w.meta["levels"]):
        origins = np.column_stack([x, np.full(len(x), 9.0), np.full(len(x), floor + 2.2)])
        t = s.cast(origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape))
        pillar = t < 2.0
        sight[level] = pillar
        starts = x[1:][pillar[1:] & ~pillar[:-1]]
        assert np.allclose(np.diff(starts), 8.0, atol=0.11)
    assert np.array_equal(sight[0], sight[1])


def test_parallel_galleries_are_apart_and_see_each_other_at_cross_cuts_only() -> None:
    w, route = world("mine"), world("mine").route()
    assert len(w.meta["parallel"]) >= 3
    total = 0.0
    for (a0, a1), (b0, b1) in w.meta["parallel"]:
        a = route.positions(np.arange(a0, a1, 1.0))
        b = route.positions(np.arange(b0, b1, 1.0))
        gap = np.linalg.norm(a[:, None] - b[None], axis=2)
        assert gap.min() > 5.0
        assert gap.min(axis=1).max() < 9.5  # side by side all along
        total = max(total, a1 - a0)
        i, j = np.nonzero(gap < 25.0)
        seen = solid("mine").sees(a[i] + [0.0, 0.0, 1.0], b[j] + [0.0, 0.0, 1.0])
        assert not seen.any()
    assert total > 50.0
    # they do see each other through the cross-cut
    m, other = np.array([[100.0, 0.0, 2.6]]), np.array([[100.0, 8.0, 2.6]])
    assert solid("mine").sees(m, other).all()


@pytest.mark.parametrize("name", ["mine", "building"])
def test_closed_worlds_leak_no_beam(name: str) -> None:
    route = world(name).route()
    p = route.positions(route.every(2.0)) + [0.0, 0.0, 0.8]
    d = np.random.default_rng(5).normal(size=(len(p), 300, 3))
    t = solid(name).cast(np.repeat(p, 300, axis=0), d.reshape(-1, 3))
    assert np.isfinite(t).all()


def test_the_mine_twice_round_is_twice_as_long_and_stands_still() -> None:
    once, twice = mine("once"), mine("twice")
    assert twice.meta["length"] > 1.9 * once.meta["length"]
    assert np.array_equal(once.vertices[:1000], twice.vertices[:1000])
    assert twice.meta["tour"].startswith(once.meta["tour"])


def test_walls_of_the_mine_are_rough_and_differ_from_place_to_place() -> None:
    w, route = world("mine"), world("mine").route()
    profiles = []
    for a, b in w.meta["parallel"][0]:
        s = a + np.arange(0.0, 50.0, 0.25)
        assert s[-1] <= b
        p, h = route.positions(s) + [0.0, 0.0, 1.2], route.headings(s)
        for side in (1.0, -1.0):
            t = solid("mine").cast(p, side * np.column_stack([-np.sin(h), np.cos(h), np.zeros(len(s))]))
            t = np.minimum(t, 3.0)  # into a blind heading
            assert 0.1 < np.std(t[t < 3.0]) < 0.45
            profiles.append(t - t.mean())
    alike = np.corrcoef(profiles)[np.triu_indices(4, 1)]
    assert np.abs(alike).max() < 0.5


def test_mine_has_loops_within_loops() -> None:
    w = world("mine")
    loops = np.array(w.meta["loops"])
    assert len(loops) >= 5
    # interlocking: some loop begins inside another and ends outside it
    a, b = loops[:, None], loops[None]
    assert ((a[..., 0] < b[..., 0]) & (b[..., 0] < a[..., 1]) & (a[..., 1] < b[..., 1])).any()
    assert np.ptp(w.waypoints[:, 2]) > 5.0


def test_building_is_a_star_of_out_and_back_legs_on_three_levels() -> None:
    w = world("building")
    route = w.route()
    p = route.positions(route.every(0.1))
    assert [round(z, 6) for z in w.meta["levels"]] == [0.0, 3.6, 7.2]
    for z in w.meta["levels"]:
        assert (np.abs(p[:, 2] - z) < 0.01).mean() > 0.15
    legs = [r for r in w.meta["revisits"] if not r["same_heading"] and r["again"][0] - r["first"][0] < 30.0]
    assert len(legs) == 9  # three corridors on each level, each come back along
    levels = sorted(round(float(route.positions(r["again"][0])[2] / 3.6)) for r in legs)
    assert levels == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    last = w.meta["revisits"][-1]
    assert last["same_heading"]
    assert last["again"][0] > 0.9 * route.length


def test_building_rooms_are_seen_through_open_doors_only() -> None:
    """Sideways from the middle of the corridors: some looks end at the wall, some go through a door, none beyond."""
    w = world("building")
    s = solid("building")
    u = np.arange(7.6, 32.4, 0.05)
    origins = np.column_stack([u, np.zeros(len(u)), np.full(len(u), 2.0)])
    for side in (-1.0, 1.0):
        t = s.cast(origins, np.broadcast_to([0.0, side, 0.0], origins.shape))
        assert t.max() < 6.4 + 1e-3
        through = t > 1.6
        assert 0.05 < through.mean() < 0.4
    high = s.cast(origins + [0.0, 0.0, 0.5], np.broadcast_to([0.0, 1.0, 0.0], origins.shape))
    assert np.allclose(high, 1.4 - 0.075, atol=1e-3)  # above the lintels
    assert w.meta["things"] > 100


def test_surface_nets_keep_planes_and_balls() -> None:
    low, cell = np.array([-2.0, -2.0, -2.0]), 0.2
    p = np.stack(np.meshgrid(*[low[0] + cell * np.arange(21)] * 3, indexing="ij"), -1)
    ball = (np.linalg.norm(p, axis=-1) - 1.5).astype(np.float32)
    v, t = surface_nets(ball, low, cell)
    assert np.abs(np.linalg.norm(v, axis=1) - 1.5).max() < 0.03
    # closed: every edge belongs to two triangles
    edges = np.sort(t[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    normal = np.array([0.1, -0.05, 1.0])
    v, _ = surface_nets((p @ normal - 0.03).astype(np.float32), low, cell)
    assert np.abs(v @ normal - 0.03).max() < 1e-5


def test_route_is_smooth_and_measures_itself() -> None:
    waypoints = [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (10.0, 8.0, 0.0), (10.0, 20.0, 1.0), (2.0, 26.0, 1.0)]
    route = plan_route(waypoints, 2.0)
    s = np.linspace(0.0, route.length, 20001)
    p, h = route.positions(s), route.headings(s)
    step = np.linalg.norm(np.diff(p, axis=0), axis=1)
    assert np.sum(np.abs(step / s[1] - 1.0) > 1e-5) <= 3  # arc length; three steps span a kink in slope
    d = np.diff(p, axis=0)
    middle = route.headings(0.5 * (s[1:] + s[:-1]))
    assert np.allclose(
        np.column_stack([np.cos(middle), np.sin(middle)]),
        d[:, :2] / np.linalg.norm(d[:, :2], axis=1)[:, None],
        atol=2e-3,
    )
    assert np.abs(np.diff(np.unwrap(h))).max() <= s[1] / 2.0 * 1.001  # no turn tighter than the radius
    straight = 10.0 + 8.0 + np.hypot(12.0, 1.0) + 10.0
    turned = np.arctan2(6.0, -8.0) - np.pi / 2
    saved = 2.0 * (2.0 * np.tan(np.pi / 4) - np.pi / 2) + 2.0 * (2.0 * np.tan(turned / 2) - turned)
    assert route.length == pytest.approx(straight - saved, abs=0.02)  # the last corner cuts a little of the slope
    assert np.allclose(p[[0, -1]], [waypoints[0], waypoints[-1]])
    for bad, words in (
        ([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)], "same place"),
        ([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, 0.01, 0.0)], "back on itself"),
        ([(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 3.0, 0.0), (6.0, 3.0, 0.0)], "do not fit"),
        ([(0.0, 0.0, np.nan), (3.0, 0.0, 0.0)], "impossible"),
    ):
        with pytest.raises(GeometryError, match=words):
            plan_route(bad, 2.0)
    with pytest.raises(GeometryError, match="outside the way"):
        route.positions(route.length + 1.0)


def test_unknown_layout_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="garage layout"):
        garage("Z")


def test_impossible_world_is_refused() -> None:
    w = world("garage-A")
    parts = {k: getattr(w, k) for k in ("name", "vertices", "triangles", "waypoints", "corner_radius", "speed", "meta")}
    with pytest.raises(GeometryError, match="names a vertex"):
        World(**{**parts, "triangles": w.triangles + len(w.vertices)})
    with pytest.raises(GeometryError, match="not finite"):
        World(**{**parts, "vertices": np.where(w.vertices == w.vertices[5], np.nan, w.vertices)})
    with pytest.raises(GeometryError, match="do not fit"):
        World(**{**parts, "corner_radius": 30.0})
    with pytest.raises(GeometryError, match="speed"):
        World(**{**parts, "speed": 0.0})
