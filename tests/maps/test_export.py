"""Fused maps as files: read again by our readers, or by a plain one here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import FormatError, GridError
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.octomap import read_octomap
from graphslam.maps.export import floor_plan, save_maps, save_ply, storeys
from graphslam.maps.fuse import fuse_pieces
from graphslam.maps.pieces import piece_of_grid
from tests.reference.plain_fuse import voxels_of_grid
from tests.reference.small_maps import room, scanned


def read_ply(path: Path) -> np.ndarray:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    n = next(int(line.split()[-1]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    assert names == ["x", "y", "z", "log_odds"]
    return np.frombuffer(body, "<f4").reshape(n, 4)


@pytest.mark.parametrize("dim", [2, 3])
def test_points_are_the_occupied_voxels(dim: int, tmp_path: Path) -> None:
    grid = room((SE3 if dim == 3 else SE2).identity, dim=dim)
    rows = read_ply(save_ply(grid, tmp_path / "map.ply"))
    points, log_odds = grid.occupied_cloud(with_log_odds=True)
    assert np.allclose(rows[:, :dim], points, atol=1e-6)
    assert np.array_equal(rows[:, 3], log_odds)
    assert np.all(rows[:, dim:3] == 0)
    assert len(rows) > 80
    with pytest.raises(FormatError):
        save_ply(grid, tmp_path / "map.pcd")


def test_floor_plan_is_the_largest_of_each_column(rng: np.random.Generator) -> None:
    grid = scanned(rng, 3)
    low, high = -0.5, 1.0
    wanted: dict[tuple[int, int, int], int] = {}
    for (x, y, z), value in voxels_of_grid(grid).items():
        if low <= (z + 0.5) * grid.voxel_size < high:
            wanted[x, y, 0] = max(wanted.get((x, y, 0), -32768), value)
    assert voxels_of_grid(floor_plan(grid, low, high)) == wanted
    assert len(wanted) > 100
    assert floor_plan(grid, 90.0, 91.0).voxel_counts().known == 0
    for wrong in ((1.0, 0.0), (0.13, 0.2), (0.0, np.nan)):
        with pytest.raises(GridError):
            floor_plan(grid, *wrong)
    with pytest.raises(GridError):
        floor_plan(EvidenceGrid(0.2, dim=2), 0.0, 1.0)


def test_a_map_is_written_in_every_form(tmp_path: Path) -> None:
    fused = fuse_pieces({0: piece_of_grid(room(SE3.identity))}, {0: SE3.identity})
    made = save_maps(fused.grid, tmp_path / "out", name="a", bands={"low": (-1.0, 1.0), "none": (50.0, 51.0)})
    assert [p.name for p in made] == ["a.ply", "a.bt", "a-low.yaml", "a-low.pgm"]
    assert all(p.is_file() for p in made)
    again = read_octomap(tmp_path / "out" / "a.bt")
    assert again.voxel_counts() == fused.grid.voxel_counts()
    pixels = (tmp_path / "out" / "a-low.pgm").read_bytes()
    plan = floor_plan(fused.grid, -1.0, 1.0).voxel_counts()
    assert pixels.partition(b"255\n")[2].count(0) == plan.occupied
    flat = save_maps(room(SE2.identity, dim=2), tmp_path / "flat")
    assert [p.name for p in flat] == ["map.ply", "map.yaml", "map.pgm"]
    with pytest.raises(GridError):
        save_maps(EvidenceGrid(0.2), tmp_path / "empty")
    assert not (tmp_path / "empty").exists()


def test_storeys_are_the_heights_that_a_path_keeps_to() -> None:
    ramp = np.linspace(0.0, 3.2, 100)
    z = np.r_[np.zeros(200), ramp, np.full(150, 3.2), np.linspace(3.2, 6.4, 100), np.full(10, 6.4)]
    p = np.zeros((len(z), 3))
    p[:, 0], p[:, 2] = 0.25 * np.arange(len(z)), z
    found = storeys(p)
    assert np.allclose(found, [0.0, 3.2], atol=0.05)  # 2.5 m on the third are no storey
    assert np.allclose(storeys(p, shortest=1.0), [0.0, 3.2, 6.4], atol=0.05)
    standing = np.concatenate([p, np.repeat(p[-1:], 5000, axis=0)])
    assert np.allclose(storeys(standing), found)
    assert storeys(p[:1]) == []
    assert storeys(np.zeros((5, 3))) == []
    with pytest.raises(GridError):
        storeys(np.zeros((5, 2)))
