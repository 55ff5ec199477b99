"""Terrain along a path: of clouds whose frame is not level, and what it cannot be made of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.source import log_of_run
from graphslam.app.run.terrain import RunTerrain, Terrain, read_terrain, read_terrain_file, write_terrain
from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, GraphSlamError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.point_clouds import PointClouds
from graphslam.core.trajectory import Trajectory
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.terrain.pyramid import TerrainClass
from graphslam.plots.terrain import class_colours
from tests.pictures import full_pictures

HEIGHT, CURB_Y = 1.6, 4.0
LEAN = se3.so3_exp(np.array([0.06, -0.04, 0.0]))


def scan_from(x: float, rng: np.random.Generator) -> Array:
    """A street along x: a curb of 15 cm on the left, a box on the right; 40 rings from −30° to 2°."""
    azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(0.0, 360.0, 0.8)), np.deg2rad(np.linspace(-30.0, -4.0, 40)))
    d = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    d = d.reshape(-1, 3)
    r = -HEIGHT / d[:, 2]
    raised = r * d[:, 1] > CURB_Y
    r = np.where(raised, np.maximum(-(HEIGHT - 0.15) / d[:, 2], CURB_Y / np.where(raised, d[:, 1], 1.0)), r)
    box_x = 6.0 - x
    with np.errstate(divide="ignore"):
        side = np.where(d[:, 1] < 0, -2.5 / d[:, 1], np.inf)  # its wall towards the street, 1 m high
    met = (side < r) & (np.abs(side * d[:, 0] - box_x) < 1.0) & (side * d[:, 2] > -HEIGHT)
    r = np.where(met, side, r) + 0.005 * rng.standard_normal(len(r))
    return (r[:, None] * d)[r < 20.0]


def solved(path: Trajectory) -> GlobalMap:
    """A map with a node at every third pose of a path, and no landmarks."""
    none = np.zeros(0, np.int64)
    covariances = np.zeros((len(path.times[::3]), 6, 6))
    return GlobalMap(
        path, path.times[::3], path.poses[::3], covariances, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), none
    )  # fmt: skip


@pytest.fixture(scope="module")
def made() -> tuple[RunTerrain, PointClouds, Trajectory]:
    rng = np.random.default_rng(1)
    x = np.arange(0.0, 6.0, 0.75)
    times = 0.5 * np.arange(len(x))
    clouds = [scan_from(v, rng) for v in x]
    scans = PointClouds.from_arrays(times, np.concatenate(clouds), np.cumsum([0, *map(len, clouds)]))
    level = np.column_stack([x, np.zeros((len(x), 2)), np.tile([0.0, 0, 0, 1], (len(x), 1))])
    poses = se3.se3_compose(np.broadcast_to([0.0, 0, 0, *LEAN], level.shape), level)  # the world's z is not up
    path = Trajectory(times, poses)
    return read_terrain(scans, solved(path), progress=False), scans, path


def classes_at(found: RunTerrain, x: float, y: float) -> set[TerrainClass]:
    m = found.map
    iy, ix = (int(np.floor((v - o) / m.cell)) for v, o in ((y, m.origin[1]), (x, m.origin[0])))
    return {TerrainClass(int(k)) for k in m.classes[iy - 2 : iy + 3, ix - 2 : ix + 3].ravel()}


def test_curb_box_and_street_in_a_frame_that_leans(made: tuple[RunTerrain, PointClouds, Trajectory]) -> None:
    found = made[0]
    up = se3.quat_rotate(LEAN, np.array([0.0, 0.0, 1.0]))
    assert np.allclose(found.rotation @ up, [0, 0, 1], atol=0.02)  # the pavement lifts one side
    assert found.layer.sensor.height == pytest.approx(HEIGHT, abs=0.03)
    assert len(found.layer.pieces) == 3
    assert found.missing == 0
    for x in (4.0, 7.0):
        assert TerrainClass.STEP in classes_at(found, x, CURB_Y)
    assert classes_at(found, 6.0, 0.0) == {TerrainClass.FREE}
    assert TerrainClass.OBSTACLE in classes_at(found, 6.0, -2.5)
    assert TerrainClass.HOLE not in classes_at(found, 6.0, -4.0)  # behind the box


def test_what_moved_is_left_out_of_the_scans_that_saw_it_there(
    made: tuple[RunTerrain, PointClouds, Trajectory],
) -> None:
    still, scans, path = made
    x, y = np.meshgrid(np.arange(5.0, 7.1, 0.3), np.arange(-3.5, -1.4, 0.3))
    box = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)])
    box = se3.se3_move(np.concatenate([np.zeros(3), se3.matrix_to_quat(still.rotation.T)]), box)  # frame of the path
    for nodes in ((0,), (0, 1, 2)):
        moved = dict.fromkeys(nodes, box)
        found = read_terrain(scans, solved(path), moved=moved, progress=False)
        classes = classes_at(found, 6.0, -2.5)
        assert (TerrainClass.OBSTACLE in classes) is (len(nodes) == 1)
        assert found.moved > 0
        assert found.facts()["points_moved"] == found.moved
        for at in (4.0, 7.0):
            assert TerrainClass.STEP in classes_at(found, at, CURB_Y)  # the rest is as it was
    assert still.moved == 0


def test_clouds_are_decoded_once_and_those_that_tell_where_up_is_twice(
    made: tuple[RunTerrain, PointClouds, Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, scans, path = made
    decoded: list[int] = []
    cloud = PointClouds.cloud
    monkeypatch.setattr(PointClouds, "cloud", lambda self, k: decoded.append(k) or cloud(self, k))
    monkeypatch.setattr("graphslam.app.run.terrain._SAMPLE", 3)
    again = read_terrain(scans, solved(path), progress=False)
    assert sorted(decoded) == sorted([*range(len(scans)), 0, 3, 7])
    assert again.scans == len(scans)


def test_what_is_written(made: tuple[RunTerrain, PointClouds, Trajectory], tmp_path: Path) -> None:
    folder = OutputFiles(tmp_path)
    files = write_terrain(folder, made[0])
    assert {p.name for p in files} == {"terrain.npz", "terrain.json", "terrain_cost.yaml", "terrain_cost.pgm"}
    facts = json.loads((tmp_path / "terrain.json").read_text())
    assert facts["cells"]["free"] > 1000
    assert facts["scans"] == 8
    with np.load(tmp_path / "terrain.npz") as arrays:
        assert np.array_equal(arrays["classes"], made[0].map.classes)
    with full_pictures():
        drawn = Terrain().draw(made[0], folder.figures, name="street")
    assert [p.name for p in drawn] == ["terrain.png", "terrain_plain.png"]
    assert all(p.stat().st_size > 5_000 for p in drawn)


def test_it_moves_with_the_nodes(made: tuple[RunTerrain, PointClouds, Trajectory]) -> None:
    layer = made[0].layer
    poses = dict(layer.poses)
    before = layer.pyramid().counts.copy()
    assert layer.move({2: poses[2] + np.array([0.3, 0.1, 0, 0, 0, 0, 0])}) == 1
    assert not np.array_equal(before, layer.pyramid().counts)
    layer.move(poses)
    assert np.array_equal(before, layer.pyramid().counts)


def test_no_scan_on_the_path(made: tuple[RunTerrain, PointClouds, Trajectory]) -> None:
    _, scans, path = made
    late = Trajectory(path.times + 100.0, path.poses)
    with pytest.raises(DataError, match="within the solved path"):
        read_terrain(scans, solved(late), progress=False)


def test_terrain_is_made_alone(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["map", str(tmp_path / "none"), "--terrain", "--grid"])
    assert done.exit_code != 0
    assert isinstance(done.exception, ConfigError)
    assert "only the terrain" in str(done.exception)


def test_a_surface_is_coloured_by_what_was_written(
    made: tuple[RunTerrain, PointClouds, Trajectory], tmp_path: Path
) -> None:
    write_terrain(OutputFiles(tmp_path), made[0])
    again = read_terrain_file(tmp_path)
    found = made[0].map
    iy, ix = np.nonzero(found.classes == TerrainClass.FREE)
    level = np.column_stack(
        [found.origin + found.cell * (np.column_stack([ix, iy]) + 0.5), np.zeros(len(ix))]
    )  # fmt: skip
    in_run = level @ made[0].rotation
    assert np.all(again.at(in_run) == TerrainClass.FREE)
    assert np.all(again.at(in_run + 1e4) == TerrainClass.UNKNOWN)
    colours = class_colours(again.at(np.vstack([in_run[:1], in_run[:1] + 1e4])))
    assert colours.shape == (2, 4)
    assert not np.array_equal(*colours)
    (tmp_path / "terrain.json").unlink()
    with pytest.raises(MissingDataError):
        read_terrain_file(tmp_path)


def test_points_are_moved_by_a_matrix_as_by_the_quaternion() -> None:
    rng = np.random.default_rng(0)
    T = se3.se3_exp(rng.standard_normal(6))
    points = rng.standard_normal((50, 3))
    assert np.allclose(se3.se3_move(T, points), se3.se3_transform(T[None], points), atol=1e-12)


def test_a_log_that_is_not_where_it_was_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"drive.*cannot be read from this folder.*the folder in which the run"):
        log_of_run({"source": "drive/of/somebody"})
    (tmp_path / "empty.log").write_text("")
    with pytest.raises(GraphSlamError) as caught:
        log_of_run({"source": str(tmp_path / "empty.log")})
    assert "cannot be read from this folder" not in str(caught.value)  # what is there has an error of its own
