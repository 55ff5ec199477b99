"""The surface of a run: of clouds along a path, what is written of it, and the quick study."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.surface import RunSurface, ScannedPath, draw_surface, read_surface, write_surface
from graphslam.core.errors import ConfigError, DataError, MissingDataError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.point_clouds import PointClouds
from graphslam.core.trajectory import Trajectory
from graphslam.maps.surface.piece import SurfaceConfig
from tests.pictures import full_pictures


def room_from(x: float, rng: np.random.Generator) -> Array:
    """Beams all round into a room of 6 × 4 × 2.4 m, the scanner at height 1.2."""
    d = rng.standard_normal((6000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    at, low, high = np.array([x, 0.0, 0.0]), np.array([-1.0, -2.0, -1.2]), np.array([5.0, 2.0, 1.2])
    with np.errstate(divide="ignore"):
        r = np.min(np.where(d > 0, (high - at) / d, (low - at) / d), axis=1)
    return (r + 0.005 * rng.standard_normal(len(r)))[:, None] * d


@pytest.fixture(scope="module")
def made() -> tuple[RunSurface, PointClouds, Trajectory]:
    rng = np.random.default_rng(1)
    x = np.arange(0.0, 4.0, 0.5)
    clouds = [room_from(v, rng) for v in x]
    times = 0.5 * np.arange(len(x))
    scans = PointClouds.from_arrays(times, np.concatenate(clouds), np.cumsum([0, *map(len, clouds)]))
    poses = np.column_stack([x, np.zeros((len(x), 2)), np.tile([0.0, 0, 0, 1], (len(x), 1))])
    path = Trajectory(times, poses)
    S = np.stack([k * 1e-6 * np.eye(6) for k in (1.0, 4.0, 9.0)])
    config = SurfaceConfig(voxel=0.1)
    p = ScannedPath(scans=scans, path=path, node_times=times[::3], node_poses=poses[::3], node_covariances=S)
    return read_surface([p], config=config, progress=False), scans, path


def test_a_room_has_its_walls(made: tuple[RunSurface, PointClouds, Trajectory]) -> None:
    v = made[0].mesh.vertices
    off = np.min(np.abs(v[:, None, [0, 0, 1, 1, 2, 2]] - [[-1.0, 5.0, -2.0, 2.0, -1.2, 1.2]])[:, 0], axis=1)
    assert np.quantile(off, 0.95) < 0.03
    assert made[0].mesh.area() == pytest.approx(2 * (6 * 4 + 6 * 2.4 + 4 * 2.4), rel=0.12)
    assert len(made[0].layer.pieces) == 3


def test_vertices_are_surer_where_their_node_is(made: tuple[RunSurface, PointClouds, Trajectory]) -> None:
    found = made[0]
    means = [float(np.nanmean(found.sigma[found.owner == k])) for k in range(3)]
    assert means[0] < means[1] < means[2]
    assert means[0] > 1e-3 * np.sqrt(3.0)  # the place alone; turns add to it


def test_what_is_written(made: tuple[RunSurface, PointClouds, Trajectory], tmp_path: Path) -> None:
    folder = OutputFiles(tmp_path)
    for colour in ("height", "piece", "sigma"):
        files = write_surface(folder, made[0], colour=colour)
        assert [p.name for p in files] == ["surface.ply", "surface.glb", "surface.obj", "surface.json"]
        colours = trimesh.load(files[0]).visual.vertex_colors
        assert len(np.unique(colours, axis=0)) >= 3
    facts = json.loads((tmp_path / "surface.json").read_text())
    assert facts["pieces"] == 3
    assert facts["triangles"] == len(trimesh.load(tmp_path / "surface.glb", force="mesh").faces)
    with full_pictures():
        drawn = draw_surface(made[0], folder.figures, name="room")
    assert [p.name for p in drawn] == ["surface.png", "surface_sigma.png"]
    assert all(p.stat().st_size > 10_000 for p in drawn)
    with pytest.raises(UnknownNameError, match="colour"):
        made[0].colours("taste")
    with pytest.raises(MissingDataError, match="needs the terrain"):
        made[0].colours("terrain")


def test_no_scan_on_the_path(made: tuple[RunSurface, PointClouds, Trajectory]) -> None:
    _, scans, path = made
    late = Trajectory(path.times + 100.0, path.poses)
    none = ScannedPath(scans=scans, path=late, node_times=late.times[:1], node_poses=late.poses[:1])
    with pytest.raises(DataError, match="within the solved path"):
        read_surface([none], progress=False)


def test_sessions_in_one_frame_make_one_surface(made: tuple[RunSurface, PointClouds, Trajectory]) -> None:
    alone, scans, path = made
    here = ScannedPath(scans=scans, path=path, node_times=path.times[::3], node_poses=path.poses[::3])
    split = [
        ScannedPath(
            scans=scans, path=path.take(part), node_times=path.times[part][::3], node_poses=path.poses[part][::3]
        )
        for part in (slice(0, 3), slice(3, None))
    ]
    two = read_surface(split, config=alone.layer.config, progress=False)
    assert two.facts()["sessions"] == 2
    assert read_surface([here], config=alone.layer.config, progress=False).facts()["sessions"] == 1
    assert set(two.session.tolist()) <= {-1, 0, 1}
    assert np.array_equal(two.mesh.vertices, alone.mesh.vertices)  # the same pieces at the same poses
    assert np.array_equal(two.session[two.owner >= 0], np.minimum(two.owner[two.owner >= 0], 1))
    colours = two.colours("session")
    assert len(np.unique(colours[two.session >= 0], axis=0)) == 2


def test_a_surface_is_made_alone(tmp_path: Path) -> None:
    for other in ("--grid", "--terrain"):
        done = CliRunner().invoke(app, ["map", str(tmp_path / "none"), "--surface", other])
        assert isinstance(done.exception, ConfigError)


def test_the_quick_study(tmp_path: Path) -> None:
    out = tmp_path / "study"
    done = CliRunner().invoke(app, ["study", "surface", "--quick", "--trials", "1", "--out", str(out)])
    assert done.exit_code == 0, done.output
    table = pd.read_csv(out / "table.csv").set_index(["algorithm", "quantity"])["value"]
    assert table["level-set 0.1", "follow_same"] == 1.0
    assert 0.5 < table["level-set 0.1", "f_5cm"] < 1.0
    assert table["level-set 0.1", "f_5cm"] > table["ray tsdf", "f_5cm"] > 0.0
    assert {"poisson", "log-odds", "planes, no carving"} <= set(table.index.get_level_values(0))
