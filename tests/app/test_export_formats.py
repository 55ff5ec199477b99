"""What other programs read of a run: read here by readers that are not ours, or by the format's own words."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.export import export, map_points
from graphslam.app.run.run import Run
from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.io.autoware import write_autoware
from graphslam.io.cloud_files import read_cloud
from graphslam.io.cloud_writers import write_las
from graphslam.io.tum import read_tum
from tests.reference.map_server import read_map_server


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Run:
    log = gs.simulate("court", preset="light", seed=1, progress=False).slice(0.0, 25.0)
    return gs.run(log, frontend="scan-window", out=tmp_path_factory.mktemp("export") / "run", progress=False)


def test_tum_and_kitti_hold_the_path(hall: Run) -> None:
    path = hall.map.trajectory
    back = read_tum(export(hall, format="tum"), dim=3)
    np.testing.assert_array_equal(back.poses[:, :3], path.poses[:, :3])
    rows = np.loadtxt(export(hall, format="kitti")).reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, se3.pose_to_matrix(path.poses)[:, :3], atol=1e-12)
    if find_spec("evo"):
        from evo.tools import file_interface

        assert file_interface.read_kitti_poses_file(str(hall.folder / "path.kitti.txt")).num_poses == len(path)
        assert file_interface.read_tum_trajectory_file(str(hall.folder / "path.tum")).num_poses == len(path)


def test_nav2_reads_the_floor_plans(hall: Run, tmp_path: Path) -> None:
    """By the rules of its map server, every cell is what the floor plan says."""
    export(hall, format="nav2", out=tmp_path / "nav")
    found = sorted((tmp_path / "nav").glob("*.yaml"))
    assert found
    for file in found:
        cells, info = read_map_server(file)
        assert info["mode"] == "trinary"
        assert set(np.unique(cells)) == {-1, 0, 100}
        at = np.floor((hall.map.trajectory.poses[:, :2] - info["origin"][:2]) / info["resolution"]).astype(int)
        # where it drove it is free, as far as the plan goes
        driven = at[np.all((at >= 0) & (at < cells.shape[::-1]), axis=1)]
        assert len(driven) > 0.9 * len(at)
        assert np.all(cells[driven[:, 1], driven[:, 0]] == 0)


def test_autoware_reads_tiles_that_hold_every_point_once(hall: Run, tmp_path: Path) -> None:
    root = export(hall, (35.68, 139.76), heading=90.0, format="autoware", out=tmp_path / "aw")
    info = yaml.safe_load((root / "map_projector_info.yaml").read_text())
    assert info == {
        "projector_type": "LocalCartesian",
        "vertical_datum": "WGS84",
        "map_origin": {"latitude": 35.68, "longitude": 139.76, "altitude": 0.0},
    }
    tiles = yaml.safe_load((root / "pointcloud_map_metadata.yaml").read_text())
    size = tiles.pop("x_resolution"), tiles.pop("y_resolution")
    assert set(tiles) == {p.name for p in (root / "pointcloud_map.pcd").iterdir()}
    points = []
    for name, corner in tiles.items():
        file = root / "pointcloud_map.pcd" / name
        entries = [line.split()[0] for line in file.read_bytes().partition(b"DATA")[0].decode().splitlines()[1:]]
        assert entries == ["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"]
        cloud = read_cloud(file).points
        assert np.all((cloud[:, :2] >= np.array(corner) - 1e-4) & (cloud[:, :2] <= np.add(corner, size) + 1e-4))
        points.append(cloud)
    # a heading of 90°: the first base looks east, so x is east already
    wanted = map_points(hall)
    got = np.concatenate(points)
    order = [np.lexsort(np.round(p, 3).T) for p in (got, wanted)]
    np.testing.assert_allclose(got[order[0]], wanted[order[1]], atol=1e-3)
    north = export(hall, (35.68, 139.76), heading=0.0, format="autoware", out=tmp_path / "aw")  # the same folder again
    turned = np.concatenate([read_cloud(p).points for p in (north / "pointcloud_map.pcd").iterdir()])
    assert len(turned) == len(wanted)
    np.testing.assert_allclose(np.sort(turned[:, 1]), np.sort(wanted[:, 0]), atol=1e-3)
    export(hall, format="autoware", out=tmp_path / "own")
    assert yaml.safe_load((tmp_path / "own" / "map_projector_info.yaml").read_text()) == {"projector_type": "Local"}


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_has_every_point_to_half_a_millimetre(hall: Run, tmp_path: Path, ending: str) -> None:
    laspy = pytest.importorskip("laspy")
    file = export(hall, (35.68, 139.76), heading=0.0, format="las", out=tmp_path / f"map.{ending}")
    las = laspy.read(file)
    assert (las.header.version.minor, las.header.are_points_compressed) == (4, ending == "laz")
    wanted = map_points(hall) @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # a heading of 0°: x is north
    np.testing.assert_allclose(las.xyz, wanted, atol=0.00051)
    np.testing.assert_allclose(read_cloud(file).points, wanted, atol=0.00051)
    kept = file.read_bytes()
    export(hall, (35.68, 139.76), heading=0.0, format="las", out=file)
    assert file.read_bytes() == kept
    with pytest.raises(DataError, match="without a point"):
        write_las(tmp_path / "empty.las", np.zeros((0, 3)))


def test_pandas_and_open3d(hall: Run) -> None:
    table = hall.to_pandas()
    np.testing.assert_array_equal(table[["x", "y", "z"]], hall.map.trajectory.poses[:, :3])
    assert {"sigma_x", "sigma_yaw"} <= set(table.columns)
    if find_spec("open3d"):
        np.testing.assert_allclose(np.asarray(gs.to_open3d(hall).points), map_points(hall))


def test_what_is_missing_is_reported(hall: Run, tmp_path: Path) -> None:
    for format in ("kml", "geojson"):
        with pytest.raises(ConfigError, match="needs a datum"):
            export(hall, format=format)
    for format in ("nav2", "autoware"):
        with pytest.raises(ConfigError, match="writes a folder"):
            export(hall, format=format)
    plain = gs.run(gs.simulate("landmark-field", preset="quick"), progress=False)
    with pytest.raises(MissingDataError, match="no dense map"):
        export(plain, format="autoware", out=tmp_path / "x")
    with pytest.raises(DataError, match="without a point"):
        write_autoware(tmp_path / "y", np.zeros((0, 3)))


def test_command_line_needs_no_datum_for_a_path(hall: Run) -> None:
    done = CliRunner().invoke(app, ["export", str(hall.folder), "--format", "tum", "--json"])
    assert Path(json.loads(done.stdout)["file"]).name == "path.tum"
