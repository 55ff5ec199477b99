"""Maps that are wider than their lattice, OctoMap's files or a picture: more levels, or larger voxels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core.poses import SE2, SE3
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import half_edge
from graphslam.evidence.octomap import read_octomap
from graphslam.evidence.pool import GridPool
from graphslam.maps.coarse import coarse_grid, drawable_map, pool_levels
from graphslam.maps.export import save_maps
from graphslam.maps.fuse import FusedMap
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.pieces import piece_of_grid
from graphslam.maps.run_map import make_run_map
from tests.reference.plain_fuse import voxels_of_grid
from tests.reference.small_maps import room, same_map, scanned, straight


@pytest.mark.parametrize("dim", [2, 3])
def test_a_coarser_voxel_is_the_largest_of_those_under_it(dim: int, rng: np.random.Generator) -> None:
    grid = scanned(rng, dim)
    wanted: dict[tuple[int, int, int], int] = {}
    for (x, y, z), value in voxels_of_grid(grid).items():
        at = (x >> 1, y >> 1, z >> 1 if dim == 3 else z)
        wanted[at] = max(wanted.get(at, -32768), value)
    coarser = coarse_grid(grid)
    assert voxels_of_grid(coarser) == wanted
    assert coarser.voxel_size == 2 * grid.voxel_size


@pytest.mark.parametrize("dim", [2, 3])
def test_a_fused_map_takes_levels_as_it_grows(dim: int) -> None:
    piece = piece_of_grid(room((SE3 if dim == 3 else SE2).identity, dim=dim, beams=500))
    far = np.array([3000.0, -40.0, 0.3] if dim == 2 else [3000.0, -40.0, 5.0, 0, 0, np.sin(0.15), np.cos(0.15)])
    near = (SE3 if dim == 3 else SE2).identity
    grown = FusedMap(0.2, dim=dim)
    grown.add({"near": piece}, {"near": near})
    assert grown.grid.pool.levels == 5
    before = grown.copy()
    grown.add({"far": piece}, {"far": far})
    wide = FusedMap(0.2, dim=dim, pool=GridPool(7))
    wide.add({"near": piece, "far": piece}, {"near": near, "far": far})
    assert grown.grid.pool.levels == 6 == pool_levels(15_100)
    assert same_map(grown.grid, wide.grid)
    assert grown.entropy() == wide.entropy()
    assert len(before) == 1
    assert before.entropy() == pytest.approx(0.5 * grown.entropy(), rel=0.1)
    assert grown.remove(["far"]).removed == 1
    assert same_map(grown.grid, before.grid)


@pytest.mark.parametrize(("way", "coarsened", "levels"), [(2400.0, 1, 6), (40_000.0, 4, 7)])
def test_a_long_straight_drive_has_a_map(way: float, coarsened: int, levels: int, tmp_path: Path) -> None:
    n, grid = 5, room(SE3.identity, beams=500)
    step = np.array([way / n, 0, 0, 0, 0, 0, 1.0])
    submaps = [
        Submap(
            key=k,
            interval=(10.0 * k, 10.0 * k + 10.0),
            exit_pose=step,
            exit_covariance=1e-4 * np.eye(6),
            trajectory=straight(3, way / n),
            grid=grid,
        )
        for k in range(n)
    ]
    poses = np.tile(step, (n + 1, 1))
    poses[:, 0] *= np.arange(n + 1)
    times, none = 10.0 * np.arange(n + 1), np.zeros(0, np.int64)
    solved = GlobalMap(
        Trajectory(times, poses), times, poses, np.zeros((n + 1, 6, 6)), none, np.zeros((0, 2)), np.zeros((0, 2, 2)),
        none,
    )  # fmt: skip
    made = make_run_map(submaps, solved)
    fused = made.fused.grid
    assert (made.coarsened, fused.pool.levels) == (coarsened, levels)
    assert (f"{0.2 * coarsened:g} m" in made.coarse_note()) == (coarsened > 1)
    points = fused.occupied_cloud()
    for k in range(n):
        assert np.sum(np.abs(points[:, 0] - k * way / n) < 4.0) > 50
    files = save_maps(fused, tmp_path, bands={"level0": (-0.5, 0.5)})
    assert read_octomap(tmp_path / "map.bt").voxel_counts().occupied > 100
    pixels = next(f for f in files if f.suffix == ".pgm").read_bytes().split(b"\n")[1].split()
    assert 0.2 * coarsened * int(pixels[0]) == pytest.approx(way * (n - 1) / n, rel=0.01)


def test_pictures_are_bounded() -> None:
    ends = np.array([[0.0, 0.0], [3000.0, 3000.0]])
    grid = EvidenceGrid(0.2, dim=2, pool=GridPool(7))
    grid.insert_scan(ends + 0.1, [0.05, 0.05])
    drawn = drawable_map(grid)
    assert drawn.voxel_size == 0.8
    assert drawn.values_at(ends + 0.1).min() > -32768
    assert drawable_map(drawn) is drawn
    assert half_edge(7) > 15_000
