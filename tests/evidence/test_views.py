"""One view of a submap's dense map, whatever it is made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core.dense import CloudMap
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.views import CloudView, GridView, dense_view, has_dense_view
from tests.reference.small_maps import same_map


def scans(dim: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins, points in one frame, and from which origin each was seen, not in order."""
    origins = rng.uniform(-1.0, 1.0, (4, dim))
    scan = rng.integers(0, 4, 300)
    ray = rng.standard_normal((300, dim))
    points = origins[scan] + ray / np.linalg.norm(ray, axis=1, keepdims=True) * rng.uniform(2.0, 6.0, (300, 1))
    return origins, points, scan


@pytest.mark.parametrize("dim", [2, 3])
def test_beams_of_a_cloud_are_those_of_its_scans(dim: int) -> None:
    rng = np.random.default_rng(1)
    origins, points, scan = scans(dim, rng)
    grid = EvidenceGrid(0.25, dim=dim)
    for k, origin in enumerate(origins):
        grid.insert_scan(points[scan == k], origin)
    view = CloudView(CloudMap(points=points, origins=origins, scan=scan, cell=0.25))
    assert same_map(view.evidence(), grid)
    asked = rng.uniform(-6.0, 6.0, (500, dim))
    np.testing.assert_array_equal(view.known_at(asked), grid.known_at(asked))
    np.testing.assert_array_equal(view.log_odds_at(asked), GridView(grid).log_odds_at(asked))
    assert view.knows_space
    assert view.dim == GridView(grid).dim == dim


def test_points_are_gathered_in_cells() -> None:
    rng = np.random.default_rng(2)
    cloud = CloudMap(points=rng.uniform(-3.0, 3.0, (4000, 3)), cell=0.2)
    for level in (0, 1, 2):
        p = CloudView(cloud).points(level)
        cells = np.floor(p / (0.2 * 2**level))
        assert len(np.unique(cells, axis=0)) == len(p)
    grid = EvidenceGrid(0.2)
    grid.insert_scan(cloud.points)
    view = GridView(grid)
    np.testing.assert_array_equal(view.points(), grid.occupied_cloud())
    np.testing.assert_array_equal(view.points(2), grid.binned_cloud(2).points)


@pytest.mark.parametrize("dim", [2, 3])
def test_without_origins_nothing_is_free(dim: int) -> None:
    """Known is the column of a point; occupied is its voxel, the more the more points lie in it; free is nothing."""
    points = np.concatenate([np.full((3, dim), -2.05), np.random.default_rng(3).uniform(-4, 4, (200, dim))])
    view = CloudView(CloudMap(points=points))
    values = view.log_odds_at(points)
    assert np.all(values > 0)
    assert values[0] > values[3:].min()
    assert not view.knows_space
    grid = view.evidence()
    assert grid.voxel_counts().known == len(np.unique(np.floor(points / 0.2), axis=0))
    assert np.all(view.known_at(points))
    beside = points.copy()
    beside[:, 0] += 20.0
    assert not np.any(view.known_at(beside))
    assert np.all(np.isnan(view.log_odds_at(beside)))


def submap(**payload: object) -> Submap:
    return Submap(
        key=4, interval=(0.0, 1.0), exit_pose=np.array([1.0, 0, 0, 0, 0, 0, 1]), exit_covariance=np.eye(6), **payload
    )


def test_of_a_grid_and_a_cloud_the_points_are_the_clouds_and_the_space_the_grids() -> None:
    points = np.random.default_rng(4).uniform(-4, 4, (200, 3))
    grid = EvidenceGrid(0.5)
    grid.insert_scan(points)
    view = dense_view(submap(cloud=points, grid=grid))
    assert view.knows_space
    assert view.evidence() is grid
    assert len(view.points()) > len(GridView(grid).points())
    assert view.cloud is not None
    assert dense_view(submap(grid=grid)).cloud is None
    with pytest.raises(DataError, match="submap 4 has no map"):
        dense_view(submap())
    assert [has_dense_view(submap(**p)) for p in ({}, {"grid": grid}, {"cloud": points})] == [False, True, True]


def test_impossible_clouds_are_refused() -> None:
    p, o = np.zeros((3, 3)), np.zeros((2, 3))
    for bad in (
        {"points": np.zeros(3)},
        {"points": np.full((2, 3), np.nan)},
        {"points": p, "origins": o},
        {"points": p, "scan": np.zeros(3)},
        {"points": p, "origins": o, "scan": np.array([0, 1, 2])},
        {"points": p, "origins": o, "scan": np.zeros(2)},
        {"points": p, "origins": np.zeros((2, 2)), "scan": np.zeros(3)},
        {"points": p, "cell": 0.0},
    ):
        with pytest.raises(GeometryError):
            CloudMap(**bad)
    with pytest.raises(GeometryError, match="2-D"):
        submap(cloud=np.zeros((3, 2)))


def test_bad_clouds_in_files_are_refused_by_name(tmp_path: Path) -> None:
    from graphslam.core.atomic import read_npz, write_npz
    from graphslam.core.errors import FormatError
    from graphslam.io.submap_file import SUBMAP_FORMAT
    from graphslam.io.submap_store import read_submaps, write_submaps

    write_submaps(tmp_path, [submap(cloud=CloudMap(points=np.ones((3, 3)), origins=np.zeros((1, 3)), scan=[0, 0, 0]))])
    file = tmp_path / "submaps" / "000004.npz"
    (back,) = read_submaps(tmp_path)
    assert back.cloud is not None
    assert back.cloud.origins is not None
    arrays = read_npz(file, fmt=SUBMAP_FORMAT)
    for bad in ({"cloud_scan": np.array([0, 0, 1])}, {"cloud_scan": np.array([0])}, {"cloud": np.full((3, 3), np.nan)}):
        write_npz(file, {"format": SUBMAP_FORMAT, **arrays, **bad})
        with pytest.raises((DataError, FormatError), match="000004"):
            read_submaps(tmp_path)
