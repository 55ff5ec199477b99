"""Dense arrays and npz: to the last bit there and back."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import FormatError, GridError
from graphslam.core.submap import Submap
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.formats import known_bounds, load_npz, to_dense
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import STEP, UNKNOWN
from graphslam.evidence.map_server import save_map_server
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_maps import Map, cube, grid_of_map, map_of_grid, random_map, scanned_grid
from tests.reference.evidence_pool import check_pool
from tests.reference.map_server import read_map_server


def near(rng: np.random.Generator) -> Map:
    """A random map that fits an array."""
    return random_map(rng, 90)


# --- dense -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_dense_array_holds_every_voxel(rng: np.random.Generator, dtype: Any) -> None:
    voxels = near(rng)
    grid = grid_of_map(voxels)
    dense = to_dense(grid, dtype=dtype)
    assert dense.values.dtype == dtype
    assert dense.voxel_size == 0.1
    keys = np.array(list(voxels))
    assert dense.first_voxel.tolist() == keys.min(axis=0).tolist()
    assert dense.values.shape == tuple(keys.max(axis=0) + 1 - keys.min(axis=0))
    wanted = np.full(dense.values.shape, UNKNOWN)
    wanted[tuple((keys - dense.first_voxel).T)] = list(voxels.values())
    if dtype == np.float32:
        assert np.array_equal(dense.values, np.where(wanted == UNKNOWN, np.nan, wanted * STEP), equal_nan=True)
    else:
        assert np.array_equal(dense.values, wanted)


def test_dense_of_any_box(rng: np.random.Generator) -> None:
    """Boxes inside, across and outside the map, and beyond the addressable cube (±64 voxels)."""
    grid = grid_of_map({v: x for v, x in near(rng).items() if max(v) < 64 and min(v) >= -64}, levels=2)
    voxels = map_of_grid(grid)
    for _ in range(40):
        low = rng.integers(-80, 70, 3)
        high = low + rng.integers(0, 30, 3)
        dense = to_dense(grid, bounds=[low, high])
        assert dense.values.shape == tuple(high - low)
        for at, value in np.ndenumerate(dense.values):
            assert value == voxels.get(tuple((low + at).tolist()), UNKNOWN)
    for low in ([1 << 40, 0, 0], [-(1 << 62), 5, 5]):
        dense = to_dense(grid, bounds=[low, [a + 9 for a in low]])
        assert (dense.values == UNKNOWN).all()


def test_dense_of_nothing() -> None:
    for dim in (2, 3):
        dense = to_dense(EvidenceGrid(0.5, dim=dim))
        assert dense.values.shape == (0,) * dim


def test_bounds_of_a_cube_are_found_without_its_bricks() -> None:
    grid = grid_of_map(cube((-16, 0, 8), 16, 5) | {(40, -3, 2): 7})
    assert [b.tolist() for b in known_bounds(grid)] == [[-16, -3, 2], [41, 16, 24]]


def test_impossible_dense_wishes_are_refused(rng: np.random.Generator) -> None:
    grid = scanned_grid(rng)
    for bounds in ([[0, 0, 0]], [[0, 0], [1, 1]], [[0.5, 0, 0], [1, 1, 1]], [[2, 0, 0], [1, 1, 1]]):
        with pytest.raises(GridError, match="impossible bounds"):
            to_dense(grid, bounds=bounds)
    with pytest.raises(GridError, match=r"takes \d+ GB; wanted narrower bounds"):
        to_dense(grid, bounds=[[-4000] * 3, [4000] * 3])
    with pytest.raises(GridError, match="impossible type"):
        to_dense(grid, dtype=np.int32)


@pytest.mark.parametrize("levels", [2, 5, 7])
def test_npz_gives_the_same_map(rng: np.random.Generator, tmp_path: Path, levels: int) -> None:
    model = BeamModel(hit=0.8, miss=0.3, clamp=(0.1, 0.9), threshold=0.7)
    voxels = random_map(rng, 4 * 4**levels)
    grid = grid_of_map(voxels, voxel_size=1 / 3, levels=levels, model=model)
    path = tmp_path / "map.npz"
    grid.save(path)
    back = load_npz(path)
    check_pool(back.pool, [back])
    assert map_of_grid(back) == voxels
    assert (back.voxel_size, back.model, back.dim, back.pool.levels) == (1 / 3, model, 3, levels)
    # into a pool that holds something already, of other levels
    pool = GridPool(7)
    first = grid_of_map({(1, 2, 3): 4}, pool=pool)
    second = load_npz(path, pool=pool)
    check_pool(pool, [first, second])
    assert map_of_grid(second) == voxels
    assert map_of_grid(first) == {(1, 2, 3): 4}
    if levels > 2:
        small = GridPool(2)
        with pytest.raises(GridError, match=rf"map\.npz.*levels={levels}"):
            load_npz(path, pool=small)
        assert small.used_nodes == 0


def test_npz_of_a_scanned_2d_grid(rng: np.random.Generator, tmp_path: Path) -> None:
    grid = scanned_grid(rng, dim=2)
    grid.save(tmp_path / "flat.npz")
    back = load_npz(tmp_path / "flat.npz")
    assert back.dim == 2
    assert map_of_grid(back) == map_of_grid(grid)
    EvidenceGrid(0.1).save(tmp_path / "empty.npz")
    assert map_of_grid(load_npz(tmp_path / "empty.npz")) == {}


def test_equal_maps_give_equal_bytes(rng: np.random.Generator, tmp_path: Path) -> None:
    """Whatever happened to them: other pools, copies, bricks cleared again, compaction by a round trip."""
    voxels = random_map(rng, 300)
    one = grid_of_map(voxels)
    pool = GridPool()
    other = grid_of_map({(100, 100, 100): 3, (-9, 0, 0): 4}, pool=pool)
    held = other.copy()
    for b in other.brick_coordinates():
        other.write_bricks(b[None], np.full((1, 512), UNKNOWN, np.int16))
    two = other.copy()
    order = rng.permutation(len(one.brick_coordinates()))
    two.write_bricks(one.brick_coordinates()[order], one.brick_values()[order])
    for name, grid in (("a", one), ("b", two), ("c", load_npz_of(one, tmp_path))):
        grid.save(tmp_path / name)
    data = (tmp_path / "a").read_bytes()
    assert data == (tmp_path / "b").read_bytes() == (tmp_path / "c").read_bytes()
    del voxels[next(iter(voxels))]
    grid_of_map(voxels).save(tmp_path / "d")
    assert data != (tmp_path / "d").read_bytes()
    assert len(map_of_grid(held)) == 2


def load_npz_of(grid: EvidenceGrid, folder: Path) -> EvidenceGrid:
    grid.save(folder / "through.npz")
    return load_npz(folder / "through.npz")


def test_cubes_are_written_once(tmp_path: Path) -> None:
    """64³ equal voxels are one entry, not 512 bricks."""
    grid_of_map(cube((0, 0, 0), 32, 9) | {(-1, 0, 0): 2}).save(tmp_path / "cube.npz")
    with np.load(tmp_path / "cube.npz") as archive:
        assert archive["cubes"].tolist() == [[0, 0, 0]]
        assert archive["cube_log_edges"].tolist() == [5]
        assert archive["cube_values"].tolist() == [9]
        assert archive["bricks"].tolist() == [[-1, 0, 0]]
    back = load_npz(tmp_path / "cube.npz")
    assert back.pool.used_bricks == 2
    assert len(map_of_grid(back)) == 32**3 + 1


def test_a_submap_takes_a_grid_as_payload(rng: np.random.Generator, tmp_path: Path) -> None:
    grid = scanned_grid(rng)
    submap = Submap(key=1, interval=(0.0, 1.0), exit_pose=np.zeros(3), exit_covariance=np.eye(3), grid=grid)
    assert submap.grid is not None
    submap.grid.save(tmp_path / "payload.npz")
    assert map_of_grid(load_npz(tmp_path / "payload.npz")) == map_of_grid(grid)


def test_a_failed_write_leaves_the_old_file(rng: np.random.Generator, tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "map.npz"
    grid = scanned_grid(rng)
    grid.save(path)
    before = path.read_bytes()

    def fail(*_: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space"):
        grid.empty().save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map.npz"]


# --- map server --------------------------------------------------------------------------------------------------


def test_map_server_pair_says_what_the_grid_says(rng: np.random.Generator, tmp_path: Path) -> None:
    grid = scanned_grid(rng, dim=2)
    yaml, image = save_map_server(grid, tmp_path / "floor's plan.yaml")
    cell, info = read_map_server(yaml)
    assert info["image"] == "floor's plan.pgm"
    assert image.name == "floor's plan.pgm"
    assert image.read_bytes().startswith(b"P5\n%d %d\n255\n" % cell.shape[::-1])
    assert info["mode"] == "trinary"
    assert info["origin"][2] == 0.0
    low, step = np.array(info["origin"][:2]), info["resolution"]
    rows, columns = np.indices(cell.shape)
    points = np.stack([low[0] + (columns + 0.5) * step, low[1] + (rows + 0.5) * step], axis=-1)
    values = grid.values_at(points.reshape(-1, 2)).reshape(cell.shape)
    np.testing.assert_array_equal(cell, np.where(values == UNKNOWN, -1, np.where(values >= 0, 100, 0)))
    assert set(np.unique(cell)) == {-1, 0, 100}


def test_map_server_refuses_what_is_no_image(tmp_path: Path) -> None:
    with pytest.raises(GridError, match="only a 2-D grid"):
        save_map_server(EvidenceGrid(0.1), tmp_path / "map.yaml")
    with pytest.raises(GridError, match="nothing is known"):
        save_map_server(EvidenceGrid(0.1, dim=2), tmp_path / "map.yaml")
    with pytest.raises(FormatError, match=r"wanted \.yaml"):
        save_map_server(EvidenceGrid(0.1, dim=2), tmp_path / "map.pgm")
    assert not list(tmp_path.iterdir())


# --- compiled or not ---------------------------------------------------------------------------------------------

SCRIPT = """
import sys
import numpy as np
from pathlib import Path
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.formats import load_npz, to_dense
from graphslam.evidence.octomap import read_octomap, write_octomap
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_maps import cube, grid_of_map
folder = Path(sys.argv[1])
voxels = cube((0, 0, 0), 16, 7) | cube((16, 0, 0), 16, 7) | {(-30, 5, 8): -4, (63, -64, 0): 5}
grid = grid_of_map(voxels, levels=2)
freed = compact_grids(grid)
grid.save(folder / "map.npz")
for suffix in (".bt", ".ot"):
    write_octomap(grid, folder / f"map{suffix}")
    read_octomap(folder / f"map{suffix}", pool=GridPool(2)).save(folder / f"back{suffix}")
load_npz(folder / "map.npz").save(folder / "back.npz")
np.save(folder / "dense.npy", to_dense(grid, dtype=np.float32).values)
print(freed)
"""


def test_kernels_do_the_same_uncompiled(tmp_path: Path) -> None:
    outputs = []
    for flag in ("0", "1"):
        folder = tmp_path / flag
        folder.mkdir()
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(folder)],
            env={**os.environ, "NUMBA_DISABLE_JIT": flag, "PYTHONPATH": str(Path(__file__).parents[2])},
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr
        assert "Warning" not in run.stderr
        outputs.append((run.stdout, {p.name: p.read_bytes() for p in folder.iterdir()}))
    assert outputs[0] == outputs[1]
    assert len(outputs[0][1]) == 7
    assert "bricks=15" in outputs[0][0]  # of sixteen equal ones
