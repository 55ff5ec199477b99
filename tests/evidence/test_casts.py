"""Casting: the voxels a plain walk meets, the exact twin's hits, ranges without bias, beams that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, GeometryError, GridError
from graphslam.core.se3 import se3_exp, se3_inverse, se3_transform
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.cast_kernels import cast_rays, unit_directions
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam.evidence.queries import HIT, INSIDE, LEFT, MAX_RANGE, UNKNOWN_SPACE, UNUSABLE, cast_beams, cast_grids
from graphslam.evidence.query_kernels import look_up_values
from tests.reference.evidence_twin import EvidenceTwin
from tests.reference.plain_cast import plain_cast

TWIN_STATUS = {"max": MAX_RANGE, "hit": HIT, "inside": INSIDE, "left": LEFT, "unknown": UNKNOWN_SPACE}


def scanned(rng: np.random.Generator, dim: int = 3, voxel_size: float = 0.1, levels: int = 5) -> EvidenceGrid:
    """A map of a few scans of random points."""
    grid = EvidenceGrid(voxel_size, pool=GridPool(levels), dim=dim)
    for _ in range(3):
        grid.insert_scan(rng.normal(0, 1.5, (50, dim)), rng.normal(0, 0.3, dim))
    return grid


def voxels_of(grid: EvidenceGrid) -> dict[tuple[int, int, int], int]:
    """The known voxels of a grid."""
    i = np.arange(512)
    inner = np.stack([i & 7, (i >> 3) & 7, i >> 6], axis=1)
    out = {}
    for brick, values in zip(grid.brick_coordinates(), grid.brick_values()):
        for k in np.flatnonzero(values != -32768):
            out[tuple((8 * brick + inner[k]).tolist())] = int(values[k])
    return out


def scattered(rng: np.random.Generator, *, spread: int, count: int, levels: int = 4) -> EvidenceGrid:
    """Single occupied voxels far apart, each in a brick of mixed unknown and free voxels."""
    grid = EvidenceGrid(1.0, pool=GridPool(levels))
    half = grid.pool.half // 8
    bricks = np.unique(np.clip(rng.integers(-spread, spread, (count, 3)), -half, half - 1), axis=0)
    values = rng.choice(np.array([-32768, -500, -1], np.int16), (len(bricks), 512))
    values[np.arange(len(bricks)), rng.integers(0, 512, len(bricks))] = rng.integers(0, 2, len(bricks)) * 300
    grid.write_bricks(bricks, values)
    return grid


def towards(rng: np.random.Generator, grid: EvidenceGrid, origins: np.ndarray) -> np.ndarray:
    """Directions of which every second one points near an occupied voxel."""
    cloud = grid.occupied_cloud()
    near = cloud[rng.integers(0, len(cloud), len(origins))] - origins
    near += rng.normal(0, 0.7 * grid.voxel_size, near.shape)
    near[::2] = rng.normal(0, 1, near[::2].shape)
    return near


def assert_as_plain(
    grid: EvidenceGrid, origins: np.ndarray, directions: np.ndarray, reach: float, ignore: bool
) -> None:
    units = np.empty_like(directions)
    unit_directions(directions, units)
    found = cast_beams(grid, origins, directions, reach, ignore_unknown=ignore, voxels=True)
    values, half, v = voxels_of(grid), grid.pool.half, grid.voxel_size
    assert found.voxels is not None
    for k in range(len(directions)):
        start = tuple((origins[k] * (1.0 / v) + half).tolist())
        status, length, voxel = plain_cast(
            values, start, tuple(units[k].tolist()), reach * (1.0 / v), grid.model.threshold_step, half,
            ignore_unknown=ignore,
        )  # fmt: skip
        assert found.status[k] == status
        assert found.ranges[k] == length * v  # the same arithmetic: to the last bit
        if status in (HIT, INSIDE):
            assert tuple(found.voxels[k].tolist()) == voxel


@pytest.mark.parametrize("ignore", [True, False])
def test_jumping_meets_the_voxels_of_a_plain_walk(rng: np.random.Generator, ignore: bool) -> None:
    grid = scanned(rng)
    origins = rng.normal(0, 1, (300, 3))
    assert_as_plain(grid, origins, towards(rng, grid, origins), 4.0, ignore)


def test_large_empty_cubes_are_jumped_to_the_same_voxels(rng: np.random.Generator) -> None:
    for spread, count, rays, reach in ((6, 500, 300, 200.0), (128, 900, 80, 3000.0)):
        grid = scattered(rng, spread=spread, count=count)
        origins = rng.uniform(-7 * spread, 7 * spread, (rays, 3))
        directions = towards(rng, grid, origins)
        hits = (cast_beams(grid, origins, directions, reach).status == HIT).mean()
        assert 0.1 < hits < 0.9  # both kinds
        assert_as_plain(grid, origins, directions, reach, True)


def test_rays_along_axes_planes_and_diagonals_lose_no_hit(rng: np.random.Generator) -> None:
    # origins on planes and edges of the lattice, directions with equal, zero and vanishing components: all ties
    grid = scattered(rng, spread=5, count=400)
    components = np.array([0.0, -0.0, 1.0, -1.0, 1.0, -1.0, 2.0, -0.5, 1e-17, -1e-17, 1e-250, 3e-10])
    directions = rng.choice(components, (1500, 3))
    directions = directions[np.abs(directions).max(axis=1) > 0.1]
    origins = rng.integers(-80, 80, (len(directions), 3)) * 0.5
    assert_as_plain(grid, origins, directions, 150.0, True)
    assert_as_plain(grid, origins[:300], directions[:300], 150.0, False)


@pytest.mark.parametrize("dim", [3, 2])
def test_hits_are_those_of_the_exact_twin(rng: np.random.Generator, dim: int) -> None:
    grid = EvidenceGrid(0.1, dim=dim)
    twin = EvidenceTwin(0.1, grid.model, grid.pool.half, dim)
    for _ in range(3):
        points, origin = rng.normal(0, 1.5, (40, dim)), rng.normal(0, 0.3, dim)
        grid.insert_scan(points, origin)
        twin.insert_scan(points, origin)
    pose = np.array([0.3, -0.2, 1.1]) if dim == 2 else se3_exp(rng.normal(0, 0.4, 6))
    origins = rng.normal(0, 0.7, (120, dim))
    directions = towards(rng, grid, origins)
    if dim == 3:  # so aimed once the pose has turned them
        directions = se3_transform(se3_inverse(pose), origins + directions) - origins
    met = 0
    for ignore in (True, False):
        found = cast_beams(grid, origins, directions, 3.0, pose=pose, ignore_unknown=ignore, voxels=True)
        assert found.voxels is not None
        for k in range(len(origins)):
            what, enter, voxel = twin.cast(origins[k], directions[k], 3.0, pose=pose, ignore_unknown=ignore)
            assert found.status[k] == TWIN_STATUS[what]
            if what == "hit":
                met += 1
                assert tuple(found.voxels[k].tolist()) == voxel
                # from the entry to the middle of the chord: at most half the diagonal of a voxel
                assert -1e-9 <= found.ranges[k] - enter <= 0.05 * np.sqrt(3) + 1e-9
            else:
                assert found.ranges[k] == pytest.approx(enter, abs=1e-9)
    assert met > 10


def test_octomap_meets_the_same_voxels(rng: np.random.Generator) -> None:
    octomap = pytest.importorskip("octomap")
    grid = scanned(rng)
    tree = octomap.OcTree(0.1)
    for voxel, value in voxels_of(grid).items():
        tree.updateNode((np.array(voxel) + 0.5) * 0.1, value / 2048.0, True)
    tree.updateInnerOccupancy()
    origins = rng.normal(0, 0.8, (400, 3))
    directions = towards(rng, grid, origins)
    found = cast_beams(grid, origins, directions, 30.0, voxels=True)
    assert found.voxels is not None
    same = hits = 0
    for k in range(400):
        end = np.zeros(3)
        hit = tree.castRay(origins[k], directions[k], end, True, 30.0)
        hits += hit
        same += hit == found.hit[k] and (not hit or tuple(np.floor(end / 0.1)) == tuple(found.voxels[k]))
    assert 50 < hits < 350
    assert same >= 0.995 * 400  # OctoMap walks in single precision: rays through edges may differ


def test_ranges_have_no_bias_where_entries_have_half_a_voxel(rng: np.random.Generator) -> None:
    # walls at random depths inside their voxels, seen within 20 degrees of their normal
    v, errors, early = 0.2, [], []
    for _ in range(60):
        depth = rng.uniform(4.0, 6.0)
        grid = EvidenceGrid(v)
        y, z = np.meshgrid(np.arange(-3, 3, 0.1), np.arange(-3, 3, 0.1))
        grid.insert_scan(np.stack([np.full(y.size, depth), y.ravel(), z.ravel()], axis=1))
        slope = rng.uniform(-0.35, 0.35, (50, 2))
        directions = np.column_stack([np.ones(50), slope])
        found = cast_beams(grid, None, directions, 20.0, voxels=True)
        assert found.voxels is not None
        assert (found.status == HIT).all()
        length = np.linalg.norm(directions, axis=1)
        errors.append(found.ranges / length - depth)
        early.append(found.voxels[:, 0] * v - depth)
    assert abs(np.mean(errors)) < 0.1 * v  # ~ 0.03 expected of 60 depths
    assert np.mean(early) < -0.4 * v


def test_maximum_range_and_leaving(rng: np.random.Generator) -> None:
    grid = EvidenceGrid(0.5, pool=GridPool(2))  # 128 voxels: 64 m
    grid.insert_scan([[10.2, 0.1, 0.1]], [0.1, 0.1, 0.1])
    ahead = [[1.0, 0.0, 0.0]]
    start = [0.1, 0.1, 0.1]
    assert cast_beams(grid, start, ahead, 9.8).status[0] == MAX_RANGE  # voxel [10, 10.5) is entered at 9.9
    assert cast_beams(grid, start, ahead, 9.8).ranges[0] == 9.8
    just = cast_beams(grid, start, ahead, 10.0)
    assert (just.status[0], just.ranges[0]) == (HIT, 10.0)  # not beyond the maximum range
    far = cast_beams(grid, start, ahead, 100.0)
    assert (far.status[0], far.ranges[0]) == (HIT, pytest.approx(10.15))
    back = cast_beams(grid, start, [[-3.0, 0.0, 0.0]], np.inf)  # directions may be of any length
    assert (back.status[0], back.ranges[0]) == (LEFT, pytest.approx(32.1))
    inside = cast_beams(grid, [10.1, 0.2, 0.3], rng.normal(size=(20, 3)), 5.0)
    assert (inside.status == INSIDE).all()
    assert (inside.ranges == 0).all()
    assert inside.hit.all()
    unknown = cast_beams(grid, [0.1, 5.0, 0.1], ahead, 5.0, ignore_unknown=False)
    assert (unknown.status[0], unknown.ranges[0]) == (UNKNOWN_SPACE, 0.0)
    stopped = cast_beams(grid, start, [[-1.0, 0.0, 0.0]], 5.0, ignore_unknown=False)
    assert (stopped.status[0], stopped.ranges[0]) == (UNKNOWN_SPACE, pytest.approx(0.1))


def test_empty_maps_stop_nothing() -> None:
    grid = EvidenceGrid(0.1)
    found = cast_beams(grid, None, [[1.0, 2.0, 3.0]], 7.0)
    assert (found.status[0], found.ranges[0]) == (MAX_RANGE, 7.0)
    assert cast_beams(grid, None, [[1.0, 2.0, 3.0]], 7.0, ignore_unknown=False).status[0] == UNKNOWN_SPACE
    assert cast_beams(grid, None, np.zeros((0, 3)), 7.0).ranges.shape == (0,)


def test_beams_that_cannot_be_used_are_marked(rng: np.random.Generator) -> None:
    grid = scanned(rng)
    directions = np.array([[1.0, 0, 0], [0, 0, 0], [np.nan, 1, 0], [np.inf, 0, 0], [1e-308, 0, 0], [1e300, 1e300, 0]])
    found = cast_beams(grid, None, directions, 5.0)
    assert found.status.tolist()[1:4] == [UNUSABLE] * 3
    assert np.isnan(found.ranges[1:4]).all()
    assert not np.isnan(found.ranges[[0, 4, 5]]).any()  # tiny and huge directions have a direction
    assert found.ranges[4] == found.ranges[0]
    origins = np.array([[1e4, 0, 0], [np.nan, 0, 0], [0, -1e4, 0], [0, 0, 0.0]])
    found = cast_beams(grid, origins, np.ones((4, 3)), 5.0)
    assert (found.status == UNUSABLE).tolist() == [True, True, True, False]


def test_impossible_requests_are_refused(rng: np.random.Generator) -> None:
    grid = scanned(rng)
    one = np.ones((1, 3))
    for limit in (0.0, -1.0, np.nan):
        with pytest.raises(GridError, match="maximum range"):
            cast_beams(grid, None, one, limit)
    with pytest.raises(GridError, match="beam directions"):
        cast_beams(grid, None, np.ones((3, 2)), 1.0)
    with pytest.raises(GridError, match="differ in number"):
        cast_beams(grid, np.zeros((2, 3)), np.ones((3, 3)), 1.0)
    with pytest.raises(GeometryError, match="finite"):
        cast_beams(grid, None, one, 1.0, pose=[np.nan, 0, 0, 0, 0, 0, 1])
    pose = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
    with pytest.raises(GridError, match="differ in number"):
        cast_grids([grid, grid], pose, None, one, 1.0)
    with pytest.raises(GridError, match="does not belong"):
        cast_grids([grid, EvidenceGrid(0.1)], np.repeat(pose, 2, 0), None, one, 1.0)
    other = EvidenceGrid(0.1, model=BeamModel(threshold=0.7), pool=grid.pool)
    with pytest.raises(GridError, match="threshold"):
        cast_grids([grid, other], np.repeat(pose, 2, 0), None, one, 1.0)
    with pytest.raises(ConfigError, match="threads"):
        cast_grids([grid], pose, None, one, 1.0, threads=0)


def test_many_grids_at_once_are_as_one_by_one_whatever_the_threads(rng: np.random.Generator) -> None:
    base = scanned(rng)
    grids = []
    for _ in range(7):
        grids.append(base.copy())
        grids[-1].insert_scan(rng.normal(0, 1.5, (20, 3)))
    grids[3] = grids[2]  # a grid may be asked twice
    poses = se3_exp(rng.normal(0, 0.2, (7, 6)))
    origins, directions = rng.normal(0, 0.1, (40, 3)), rng.normal(0, 1, (40, 3))
    one = cast_grids(grids, poses, origins, directions, 4.0, voxels=True)
    two = cast_grids(grids, poses, origins, directions, 4.0, voxels=True, threads=2)
    assert one.ranges.tobytes() == two.ranges.tobytes()
    assert one.status.tobytes() == two.status.tobytes()
    assert one.voxels is not None
    usable = one.status != UNUSABLE
    assert two.voxels is not None
    assert (one.voxels[usable] == two.voxels[usable]).all()
    for k, grid in enumerate(grids):
        alone = cast_beams(grid, origins, directions, 4.0, pose=poses[k])
        assert (alone.ranges == one.ranges[k]).all()
    assert len(np.unique(one.ranges)) > 15
    assert cast_grids([], np.zeros((0, 7)), None, directions, 4.0).ranges.shape == (0, 40)


def test_pose_and_origin_move_the_beams(rng: np.random.Generator) -> None:
    grid = scanned(rng)
    pose = se3_exp(rng.normal(0, 0.3, 6))
    origins, directions = rng.normal(0, 0.2, (60, 3)), rng.normal(0, 1, (60, 3))
    moved = cast_beams(grid, origins, directions, 4.0, pose=pose)
    still = cast_beams(
        grid,
        se3_transform(pose, origins),
        se3_transform(pose, directions) - se3_transform(pose, np.zeros(3)),
        4.0,
    )
    assert (moved.status == still.status).all()
    np.testing.assert_allclose(moved.ranges, still.ranges, atol=1e-9)
    assert not np.allclose(moved.ranges, cast_beams(grid, origins, directions, 4.0, pose=se3_inverse(pose)).ranges)


def test_uncompiled_kernel_agrees(rng: np.random.Generator) -> None:
    grid = scanned(rng)
    pool, t = grid.pool, grid.pool.tree
    units = np.empty((40, 3))
    unit_directions(rng.normal(0, 1, (40, 3)), units)
    origins = rng.normal(0, 0.7, (40, 3))
    kernel = getattr(cast_rays, "py_func", cast_rays)
    for stop in (False, True):
        ranges, status = np.empty((1, 40)), np.empty((1, 40), np.int8)
        kernel(
            0, 1, np.array([grid.root]), np.array([[1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]]), origins, units, 3.0, 0.1,
            pool.half, pool.levels, grid.model.threshold_step, stop, t.children, t.node_occupied, t.bricks,
            t.brick_lines, ranges, status, np.empty((0, 0, 0), np.int32),
        )  # fmt: skip
        compiled = cast_beams(grid, origins, units, 3.0, ignore_unknown=not stop)
        assert (compiled.status == status[0]).all()
        # compilers may fuse a multiplication and an addition
        np.testing.assert_allclose(compiled.ranges, ranges[0], rtol=0, atol=1e-12)


def test_read_only_arrays_compile_nothing_anew(rng: np.random.Generator) -> None:
    grid = scanned(rng)
    points = rng.normal(0, 1, (10, 3))
    kernels = [k for k in (cast_rays, unit_directions, look_up_values) if hasattr(k, "signatures")]
    grid.cast(points, points, 3.0)
    grid.log_odds_at(points)
    before = [len(k.signatures) for k in kernels]
    points.flags.writeable = False
    grid.cast(points, points, 3.0)
    grid.cast(points[0], points, 3, pose=np.eye(4), ignore_unknown=False, voxels=True)
    grid.log_odds_at(points)
    grid.insert_scan(points, returns=np.broadcast_to(True, 10))
    assert [len(k.signatures) for k in kernels] == before
