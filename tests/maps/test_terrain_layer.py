"""Terrain that moves with the graph: bit for bit what is made anew at the same poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError, GridError
from graphslam.core.geometry import Array
from graphslam.maps.terrain.ground import common_up, ground_plane, level_rotation
from graphslam.maps.terrain.layer import TerrainLayer
from graphslam.maps.terrain.lines import ScanLines
from graphslam.maps.terrain.pyramid import Pyramid
from graphslam.maps.terrain.tables import read_tables
from graphslam.maps.terrain.vehicle import LineSensor, Vehicle

TABLES, VEHICLE, SENSOR = read_tables(), Vehicle(), LineSensor()


def pose(x: float, y: float, yaw: float, z: float = 0.0, pitch: float = 0.0) -> Array:
    turn = se3.quat_multiply(se3.so3_exp(np.array([0.0, 0.0, yaw])), se3.so3_exp(np.array([0.0, pitch, 0.0])))
    return np.array([x, y, z, *turn])


def fans(seed: int, x: float, y: float) -> ScanLines:
    """Noisy lines over level ground with a curb 3 m ahead, all round a place."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    r = np.linspace(0.8, 9.0, 60)
    points = np.stack(
        [
            np.column_stack(
                [x + r * np.cos(a), y + r * np.sin(a), 0.12 * (r * np.cos(a) > 3.0) + 0.004 * rng.standard_normal(60)]
            )
            for a in azimuth
        ]
    )
    return ScanLines(points, np.tile([x, y, 1.1], (40, 1)), np.zeros(40))


def layer_at(poses: dict[int, Array]) -> TerrainLayer:
    layer = TerrainLayer(TABLES, VEHICLE, SENSOR)
    for k in range(4):
        layer.read(k, [fans(k, 2.0 * k, 0.3 * k)], pose(2.0 * k, 0.3 * k, 0.2 * k))
    layer.move(poses)
    return layer


def same(a: Pyramid, b: Pyramid) -> bool:
    return all(
        np.array_equal(getattr(a, k), getattr(b, k))
        for k in ("first", "shapes", "ratios", "counts", "heights", "votes")
    )


def test_moved_pieces_make_the_map_that_is_made_anew() -> None:
    moved = layer_at({})
    before = moved.pyramid().counts.copy()
    to = {2: pose(4.3, 0.5, 0.47, 0.1), 3: pose(6.1, 1.4, 0.63, 0.04)}
    assert moved.move(to) == 2
    assert moved.move(to) == 0
    anew = layer_at({})
    anew.pyramid()
    anew.move(dict.fromkeys(range(4), pose(0.0, 0.0, 0.0)))  # there and back
    anew.move({k: moved.poses[k] for k in range(4)})
    assert same(moved.pyramid(), anew.pyramid())
    assert not np.array_equal(moved.pyramid().counts, before)
    fresh = layer_at(to)  # moved before any map was made of it
    a, b = moved.classify(), fresh.classify()
    x, y = np.meshgrid(*b.centres())
    ix, iy = (np.floor((v - o) / 0.1 + 1e-6).astype(int) for v, o in ((x, a.origin[0]), (y, a.origin[1])))
    inside = (ix >= 0) & (iy >= 0) & (ix < a.classes.shape[1]) & (iy < a.classes.shape[0])
    for name in ("classes", "probability", "ground", "roughness"):
        mine = getattr(a, name)[iy[inside], ix[inside]]
        assert np.array_equal(mine, getattr(b, name)[inside], equal_nan=True)


def test_a_piece_where_it_was_read_is_what_the_lines_say() -> None:
    layer = TerrainLayer(TABLES, VEHICLE, SENSOR)
    layer.read("a", [fans(1, 0.8, 1.6)], pose(0.8, 1.6, 0.0))
    made = layer.pyramid()
    low = made.first[0] * 0.1
    high = low + made.shapes[0][::-1] * 0.1
    plain = Pyramid((*low, *high), TABLES, VEHICLE, SENSOR)
    plain.insert(fans(1, 0.8, 1.6))
    assert np.mean(made.counts != plain.counts) < 1e-4  # points on the border of two cells
    assert made.counts.sum() == plain.counts.sum()


def test_what_one_piece_of_four_saw_has_moved_away() -> None:
    layer = TerrainLayer(TABLES, VEHICLE, SENSOR)
    post = fans(0, 0.0, 0.0).points.copy()
    post[10, 20] = 0.0, 2.05, 1.0  # one point 1 m above the ground

    def at_post() -> float:
        found = layer.classify()
        return float(found.probability[math.floor((2.05 - found.origin[1]) / 0.1), math.floor(-found.origin[0] / 0.1)])

    for k in range(4):
        points = post if k == 0 else fans(k, 0.0, 0.0).points
        layer.read(k, [ScanLines(points, np.tile([0.0, 0.0, 1.1], (40, 1)), np.zeros(40))], pose(0.0, 0.0, 0.0))
        if k == 1:
            assert at_post() > 0.8
    assert at_post() < 0.2


def test_what_was_seen_far_away_has_moved_where_others_saw_ground_from_near() -> None:
    layer = TerrainLayer(TABLES, VEHICLE, SENSOR)
    car = fans(0, 8.0, 0.0).points.copy()
    car[20, 55] = 0.05, 0.05, 1.0  # 8 m behind a scanner: in the coarsest band
    layer.read("far", [ScanLines(car, np.tile([8.0, 0.0, 1.1], (40, 1)), np.zeros(40))], pose(8.0, 0.0, 0.0))

    def hazard() -> float:
        found = layer.classify()
        iy, ix = math.floor((0.05 - found.origin[1]) / 0.1), math.floor((0.05 - found.origin[0]) / 0.1)
        return float(found.probability[iy, ix])

    assert hazard() > 0.8
    for k in range(3):
        layer.read(k, [fans(k, -2.0, 0.0)], pose(-2.0, 0.0, 0.0))
    assert hazard() < 0.25


def test_a_piece_turns_and_rises_with_its_node() -> None:
    layer = TerrainLayer(TABLES, VEHICLE, SENSOR)
    layer.read("a", [fans(1, 0.0, 0.0)], pose(0.0, 0.0, 0.0))

    def ground(x: float, y: float) -> float:
        found = layer.classify()
        iy, ix = math.floor((y - found.origin[1]) / 0.1), math.floor((x - found.origin[0]) / 0.1)
        return float(np.nanmedian(found.ground[iy - 2 : iy + 3, ix - 2 : ix + 3]))

    assert ground(3.6, 0.0) == pytest.approx(0.12, abs=0.02)
    assert ground(0.0, 3.6) == pytest.approx(0.0, abs=0.02)
    layer.move({"a": pose(0.0, 0.0, 0.5 * np.pi, 0.2)})
    assert ground(0.0, 3.6) == pytest.approx(0.32, abs=0.02)
    assert ground(3.6, 0.0) == pytest.approx(0.2, abs=0.02)


def test_strange_nodes_are_refused() -> None:
    layer = layer_at({})
    with pytest.raises(DataError, match="no terrain was read"):
        layer.move({9: pose(0, 0, 0)})
    with pytest.raises(DataError, match="is there already"):
        layer.read(1, [], pose(0, 0, 0))
    with pytest.raises(GridError, match="without any piece"):
        TerrainLayer(TABLES, VEHICLE, SENSOR).pyramid()


def tilted_scan(rng: np.random.Generator, tilt: float, height: float) -> tuple[Array, Array]:
    """A level floor with walls and a box, seen in a frame that leans; and where up is there."""
    n = 3000
    floor = np.column_stack([rng.uniform(-10, 10, (n, 2)), np.full(n, -height)])
    wall = np.column_stack([np.full(n // 3, 8.0), rng.uniform(-10, 10, n // 3), rng.uniform(-height, 3.0, n // 3)])
    box = np.column_stack([rng.uniform(2, 4, (n // 5, 2)), np.full(n // 5, 0.8 - height)])
    points = np.concatenate([floor, wall, box]) + 0.01 * rng.standard_normal((n + n // 3 + n // 5, 3))
    R = se3.quat_to_matrix(se3.so3_exp(np.array([tilt, -0.5 * tilt, 0.0])))
    return points @ R.T, R[:, 2]


def test_up_and_height_are_found_from_the_ground() -> None:
    rng = np.random.default_rng(3)
    planes = []
    for _ in range(6):
        points, up = tilted_scan(rng, 0.15, 1.6)
        found = ground_plane(points, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        assert found is not None
        assert math.acos(min(float(found.up @ up), 1.0)) < 0.01
        assert found.below == pytest.approx(1.6, abs=0.03)
        planes.append(found)
    assert np.allclose(level_rotation(common_up(planes)) @ up, [0, 0, 1], atol=0.01)
    sky = np.abs(rng.standard_normal((100, 3)))
    nothing = ground_plane(sky, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert nothing is None
    with pytest.raises(DataError, match="where up is"):
        common_up([nothing, planes[0]])
