"""OctoMap's files, against OctoMap itself and against a recursion over a dictionary."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import octomap
import pytest

from graphslam.core.errors import FormatError, GridError, MissingDataError
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.formats import known_bounds, to_dense
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import STEP, UNKNOWN
from graphslam.evidence.octomap import read_octomap, write_octomap
from graphslam.evidence.pool import GridPool
from tests.reference import octomap_tree
from tests.reference.evidence_maps import cube, grid_of_map, map_of_grid, random_map, scanned_grid
from tests.reference.evidence_pool import check_pool


def open_tree(path: Path) -> Any:
    """What OctoMap makes of a file; it must accept it."""
    if path.suffix == ".bt":
        tree = octomap.OcTree(1.0)
        assert tree.readBinary(str(path).encode())
        return tree
    tree = octomap.OcTree.read(str(path).encode())
    assert tree is not None
    return tree


def leaves(tree: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (n, 3) of OctoMap's leaves in voxels, their edges and log-odds."""
    rows = [
        (*(leaf.getIndexKey()[a] for a in range(3)), leaf.getDepth(), leaf.getValue()) for leaf in tree.begin_leafs()
    ]
    table = np.array(rows, float).reshape(-1, 5)
    return (table[:, :3] - 32768).astype(int), 2 ** (16 - table[:, 3].astype(int)), table[:, 4]


def dense_of(tree: Any, low: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Log-odds of OctoMap's leaves as an array, NaN where it has none; every leaf lies inside."""
    out = np.full(shape, np.nan)
    for corner, edge, value in zip(*leaves(tree)):
        a = corner - low
        assert (a >= 0).all()
        assert (a + edge <= np.array(shape)).all()
        out[a[0] : a[0] + edge, a[1] : a[1] + edge, a[2] : a[2] + edge] = value
    return out


# --- against OctoMap ---------------------------------------------------------------------------------------------


def test_recorded_building_is_read_as_octomap_reads_it(data_dir: Path, tmp_path: Path) -> None:
    source = data_dir / "octomap_samples" / "geb079.bt"
    tree = open_tree(source)
    grid = read_octomap(source)
    check_pool(grid.pool, [grid])
    assert grid.voxel_size == tree.getResolution() == 0.08

    # every voxel of the box: classes and values equal, so the numbers of known voxels are too
    dense = to_dense(grid)
    theirs = dense_of(tree, dense.first_voxel, dense.values.shape)
    known = ~np.isnan(theirs)
    assert np.array_equal(known, dense.values != UNKNOWN)
    _, edges, values = leaves(tree)
    assert grid.voxel_counts().known == int((edges**3).sum())
    assert grid.voxel_counts().occupied == int((edges**3)[values >= 0].sum())
    assert np.abs(theirs - dense.values * STEP)[known].max() <= STEP / 2

    # and we write what it wrote
    again = tmp_path / "again.bt"
    write_octomap(grid, again)
    assert again.read_bytes() == source.read_bytes()
    # log-odds out of OctoMap, and out of us, and back
    full = tmp_path / "full.ot"
    assert tree.write(str(full).encode())
    assert np.array_equal(to_dense(read_octomap(full)).values, dense.values)
    ours = tmp_path / "ours.ot"
    write_octomap(grid, ours)
    assert open_tree(ours).size() == tree.size()
    assert np.array_equal(to_dense(read_octomap(ours)).values, dense.values)


@pytest.mark.parametrize("dim", [2, 3])
def test_our_map_passes_through_octomap(rng: np.random.Generator, tmp_path: Path, dim: int) -> None:
    grid = scanned_grid(rng, dim=dim)
    full, binary = tmp_path / "map.ot", tmp_path / "map.bt"
    write_octomap(grid, full)
    write_octomap(grid, binary)
    tree = open_tree(full)
    low, high = known_bounds(grid)
    values = to_dense(read_octomap(full)).values
    theirs = dense_of(tree, low, tuple(high - low))
    assert np.array_equal(np.isnan(theirs), values == UNKNOWN)
    assert np.array_equal(theirs[values != UNKNOWN], (values * STEP)[values != UNKNOWN])  # exact
    first = [grid.values_at((low + at)[None, :dim] * 0.2 + 0.1)[0] for at in np.argwhere(values != UNKNOWN)[:200]]
    assert first == values[values != UNKNOWN][:200].tolist()

    # OctoMap finds nothing to prune, and its own inner nodes and classes are ours
    tree.updateInnerOccupancy()
    copy = tmp_path / "copy"
    assert tree.write(str(copy).encode())
    assert copy.read_bytes() == full.read_bytes()
    assert tree.writeBinary(str(copy).encode())
    assert copy.read_bytes() == binary.read_bytes()


def test_octomaps_map_passes_through_us(rng: np.random.Generator, tmp_path: Path) -> None:
    tree = octomap.OcTree(0.1)
    for _ in range(5):
        tree.insertPointCloud(rng.normal(0, 2, (200, 3)), rng.normal(0, 0.5, 3))
    source, ours = tmp_path / "theirs.ot", tmp_path / "ours.ot"
    assert tree.write(str(source).encode())
    grid = read_octomap(source)
    low, high = known_bounds(grid)
    theirs, values = dense_of(tree, low, tuple(high - low)), to_dense(grid).values
    known = values != UNKNOWN
    assert known.sum() > 10_000
    assert np.array_equal(known, ~np.isnan(theirs))
    assert np.abs(theirs - values * STEP)[known].max() <= 1 / 4096 + 1e-6
    write_octomap(grid, ours)
    assert np.abs(dense_of(open_tree(ours), low, tuple(high - low)) - theirs)[known].max() <= 1 / 4096 + 1e-6


def test_same_scan_same_map_file(tmp_path: Path) -> None:
    """One beam: OctoMap's tree and ours agree as files, but for OctoMap's own log-odds (0.7 is not a step)."""
    tree = octomap.OcTree(0.1)
    tree.insertPointCloud(np.array([[1.23, 0.41, -0.32]]), np.array([0.05, 0.05, 0.05]))
    grid = EvidenceGrid(0.1)
    grid.insert_scan([[1.23, 0.41, -0.32]], [0.05, 0.05, 0.05])
    assert tree.writeBinary(str(tmp_path / "theirs.bt").encode())
    write_octomap(grid, tmp_path / "ours.bt")
    assert (tmp_path / "theirs.bt").read_bytes() == (tmp_path / "ours.bt").read_bytes()


# --- against a dictionary ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("levels", [2, 3, 5, 6, 7])
@pytest.mark.parametrize("kind", ["bt", "ot"])
def test_files_are_those_of_the_twin(rng: np.random.Generator, tmp_path: Path, levels: int, kind: str) -> None:
    voxels = random_map(rng, min(4 * 4**levels, 32768))
    model = BeamModel(threshold=0.6)
    grid = grid_of_map(voxels, levels=levels, model=model)
    path = tmp_path / f"map.{kind}"
    write_octomap(grid, path)
    wanted = octomap_tree.write(voxels, kind, 0.1, model.threshold_step)
    assert path.read_bytes() == wanted
    assert open_tree(path).size() == int(wanted.split(b"size ")[1].split()[0])

    low, high = model.clamp_steps
    back = read_octomap(path, model=model)
    check_pool(back.pool, [back])
    assert map_of_grid(back) == octomap_tree.read(wanted, low, high)
    if kind == "ot":
        assert map_of_grid(back) == voxels
    else:
        assert map_of_grid(back) == {v: high if x >= model.threshold_step else low for v, x in voxels.items()}


def test_empty_grid(tmp_path: Path) -> None:
    cleared = grid_of_map({(0, 0, 0): 3})
    cleared.write_bricks([[0, 0, 0]], np.full((1, 512), UNKNOWN, np.int16))
    for grid in (EvidenceGrid(0.25), cleared):
        for kind in ("bt", "ot"):
            path = tmp_path / f"empty.{kind}"
            write_octomap(grid, path)
            assert path.read_bytes() == octomap_tree.header(kind, 0, grid.voxel_size)
            back = read_octomap(path)
            assert back.voxel_size == grid.voxel_size
            assert map_of_grid(back) == {}


# --- cubes -------------------------------------------------------------------------------------------------------


def file_of_leaf(depth: int, value: float) -> bytes:
    """A ``.ot`` of one leaf, the cube at the upper side of the origin."""
    chain = struct.pack("<fB", value, 128) + struct.pack("<fB", value, 1) * (depth - 1) if depth else b""
    return octomap_tree.header("ot", depth + 1, 0.5) + chain + struct.pack("<fB", value, 0)


def file_of_root(value: float) -> bytes:
    """A ``.ot`` of OctoMap's whole cube."""
    eight = struct.pack("<fB", value, 0) * 8
    return octomap_tree.header("ot", 9, 0.5) + struct.pack("<fB", value, 255) + eight


@pytest.mark.parametrize(
    ("depth", "levels"), [(13, 5), (12, 5), (11, 5), (6, 5), (5, 5), (4, 5), (3, 6), (2, 6), (1, 7), (0, 7)]
)
def test_cubes_cost_little(tmp_path: Path, depth: int, levels: int) -> None:
    path = tmp_path / "cube.ot"
    path.write_bytes(file_of_leaf(depth, 1.5))
    grid = read_octomap(path)
    assert grid.pool.levels == levels
    assert grid.pool.used_bricks == 1
    assert grid.pool.used_nodes <= 2 * levels
    edge = 2 ** (16 - depth)
    low, high = known_bounds(grid)
    assert low.tolist() == [0 if depth else -32768] * 3
    assert (high - low).tolist() == [edge] * 3
    assert np.array(grid.bounding_box()).tolist() == [(0.5 * low).tolist(), (0.5 * high).tolist()]
    inside, outside = (low + high) / 2, np.array([low[0] - 1, 0, 0])
    assert grid.values_at([inside * 0.5, (high - 0.5) * 0.5, (low + 0.5) * 0.5]).tolist() == [3072] * 3
    assert grid.values_at([(outside + 0.5) * 0.5, (high + 0.5) * 0.5]).tolist() == [UNKNOWN] * 2

    # OctoMap prunes everything but the root (OccupancyOcTreeBase::prune)
    wanted = path.read_bytes() if depth else file_of_root(1.5)
    again = tmp_path / "again.ot"
    write_octomap(grid, again)
    assert again.read_bytes() == wanted
    assert open_tree(again).size() == (depth + 1 if depth else 9)
    write_octomap(grid, tmp_path / "cube.bt")
    assert open_tree(tmp_path / "cube.bt").size() == (depth + 1 if depth else 9)

    # a shared cube is not written through
    copy = grid.copy()
    copy.insert_scan([inside * 0.5 + [1.1, 0, 0]], inside * 0.5)
    assert grid.values_at([inside * 0.5]).tolist() == [3072]
    assert copy.values_at([inside * 0.5])[0] != 3072
    write_octomap(grid, again)
    assert again.read_bytes() == wanted
    for g in (grid, copy):
        g.release()
    assert grid.pool.used_nodes == grid.pool.used_bricks == 0


def test_pool_too_small_says_what_would_do(tmp_path: Path) -> None:
    path = tmp_path / "cube.ot"
    path.write_bytes(file_of_leaf(5, 1.0))
    for levels in (2, 3, 4):
        pool = GridPool(levels)
        with pytest.raises(GridError, match=r"cube\.ot.*2048 voxels.*levels=5"):
            read_octomap(path, pool=pool)
        assert pool.used_nodes == 0
    assert read_octomap(path, pool=GridPool(6)).pool.levels == 6


def test_grid_beyond_octomaps_cube_is_refused(tmp_path: Path) -> None:
    for voxel in ((32768, 0, 0), (0, -32769, 0), (0, 0, 65535)):
        grid = grid_of_map({voxel: 1, (0, 0, 0): 2}, levels=7)
        with pytest.raises(GridError, match="outside OctoMap's cube"):
            write_octomap(grid, tmp_path / "far.ot")
        assert not list(tmp_path.iterdir())
    grid = grid_of_map({(32767, -32768, 0): 1}, levels=7)
    write_octomap(grid, tmp_path / "near.ot")
    assert map_of_grid(read_octomap(tmp_path / "near.ot", pool=GridPool(7))) == {(32767, -32768, 0): 1}


# --- bad input ---------------------------------------------------------------------------------------------------

VOXELS = {(0, 0, 0): 700, (1, 0, 0): -300, **cube((8, 8, 8), 8, 20)}
FULL, BINARY = octomap_tree.write(VOXELS, "ot", 0.1), octomap_tree.write(VOXELS, "bt", 0.1)
START = FULL.index(b"data\n") + 5
DEEP = octomap_tree.header("ot", 18, 0.1) + struct.pack("<fB", 1.0, 1) * 17 + struct.pack("<fB", 1.0, 0)
DEEP_BINARY = octomap_tree.header("bt", 18, 0.1) + struct.pack("<H", 3) * 17 + struct.pack("<H", 1)

BAD = {
    "not octomap": (b"PK\3\4" + FULL, r"byte 0: not an OctoMap file"),
    "empty file": (b"", r"byte 0: not an OctoMap file"),
    "no data line": (FULL[: START - 5], r"byte \d+: header is truncated"),
    "endless header": (FULL[: START - 5] + b"# x\n" * 20000, r"byte 65536: header is truncated"),
    "colour": (FULL.replace(b"id OcTree", b"id ColorOcTree"), r"another type of OctoMap tree; got ColorOcTree"),
    "stamped": (FULL.replace(b"id OcTree", b"id OcTreeStamped"), r"got OcTreeStamped; wanted OcTree"),
    "no id": (FULL.replace(b"id OcTree\n", b""), r"header has no 'id'"),
    "no size": (FULL.replace(b"size", b"sighs"), r"header has no 'size'"),
    "negative size": (FULL.replace(b"size ", b"size -"), r"number of nodes is impossible"),
    "resolution zero": (FULL.replace(b"res 0.1", b"res 0.0"), r"byte \d+: resolution is impossible"),
    "resolution large": (FULL.replace(b"res 0.1", b"res 1e300"), r"resolution is impossible"),
    "resolution NaN": (FULL.replace(b"res 0.1", b"res nan"), r"resolution is impossible"),
    "resolution word": (FULL.replace(b"res 0.1", b"res big"), r"resolution is impossible; got 'big'"),
    "size of another": (FULL.replace(b"size ", b"size 9"), r"not that of the header; got 19; wanted 919"),
    "huge size": (FULL.replace(b"size ", b"size 99999999999"), r"number of nodes is not that"),
    "size zero": (BINARY.replace(b"size ", b"size 0\n#"), r"number of nodes is not that"),
    "left over": (FULL + b"\0" * 5, r"bytes are left over behind the tree; got 5 bytes"),
    "half a record": (FULL + b"\n", r"file ends within a record"),
    "no records": (FULL[:START], r"tree is truncated; got 0 records"),
    "NaN": (FULL[:START] + struct.pack("<f", np.nan) + FULL[START + 4 :], rf"byte {START}: log-odds .* not finite"),
    "infinite": (FULL[: START + 5] + struct.pack("<f", np.inf) + FULL[START + 9 :], rf"byte {START + 5}: log-odds"),
    "too deep": (DEEP, r"byte \d+: a node lies deeper than 16 levels"),
    "too deep binary": (DEEP_BINARY, r"a node lies deeper than 16 levels"),
    "childless": (octomap_tree.header("bt", 1, 0.1) + b"\0\0", r"an inner node has no children"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(tmp_path: Path, name: str) -> None:
    data, message = BAD[name]
    path = tmp_path / "bad.ot"
    path.write_bytes(data)
    pool = GridPool()
    with pytest.raises(FormatError, match=message) as caught:
        read_octomap(path, pool=pool)
    assert str(path) in str(caught.value)
    assert pool.used_nodes == pool.used_bricks == 0


@pytest.mark.parametrize("data", [FULL, BINARY], ids=["ot", "bt"])
def test_every_truncation_is_refused_and_damage_never_crashes(
    rng: np.random.Generator, tmp_path: Path, data: bytes
) -> None:
    path = tmp_path / "bad"
    for n in range(len(data)):
        path.write_bytes(data[:n])
        with pytest.raises(FormatError):
            read_octomap(path)
    read = 0
    pool = GridPool()
    for _ in range(300):
        damaged = bytearray(data)
        for at in rng.integers(data.index(b"data\n") + 5, len(data), rng.integers(1, 4)):
            damaged[at] ^= int(rng.choice([1, 3])) << 2 * rng.integers(4)
        path.write_bytes(damaged)
        try:
            grid = read_octomap(path, pool=pool)
        except (FormatError, GridError):
            continue
        read += 1
        check_pool(pool, [grid])
        del grid
    assert 0 < read < 300  # some bits are of a value and do no harm, others are of the structure
    assert pool.used_nodes == pool.used_bricks == 0


def test_missing_file_and_unknown_ending(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        read_octomap(tmp_path / "none.bt")
    with pytest.raises(FormatError, match=r"unknown ending .* wanted \.bt or \.ot"):
        write_octomap(EvidenceGrid(0.1), tmp_path / "map.octomap")


def test_log_odds_beyond_ours_are_cut_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "sure.ot"
    path.write_bytes(file_of_leaf(16, -40.0))
    assert map_of_grid(read_octomap(path)) == {(0, 0, 0): -32767}
    assert "log-odds of 1 leaves cut" in caplog.text


def test_header_may_hold_comments_and_come_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "commented.ot"
    body = FULL[START:]
    count = FULL.split(b"size ")[1].split()[0]
    path.write_bytes(
        b"# Octomap OcTree file v2\n\n# x\nres 0.1 m\nmood fine\nsize " + count + b"\nid OcTree\ndata  \n" + body
    )
    assert map_of_grid(read_octomap(path)) == VOXELS
