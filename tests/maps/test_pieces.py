"""Division of submaps among the nodes of their path."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, GeometryError, GridError
from graphslam.core.poses import SE2, SE3
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.maps.fuse import fuse_pieces
from graphslam.maps.pieces import (
    DivisionConfig,
    Piece,
    divide_grid,
    node_times_every,
    owning_places,
    piece_of_grid,
    pieces_of_submap,
)
from tests.reference.plain_fuse import nearest_owner, voxels_of, voxels_of_grid
from tests.reference.small_maps import same_map, scanned, some_pose, straight


def corridor(path: Trajectory, rng: np.random.Generator, size: float = 0.25) -> EvidenceGrid:
    grid = EvidenceGrid(size, dim=path.dim)
    for pose in path.poses[::5]:
        points = rng.normal(size=(30, path.dim))
        points *= 3.0 / np.linalg.norm(points, axis=1, keepdims=True)
        grid.insert_scan(points, pose=pose)
    return grid


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("stretch", "reach"), [(1.0, np.inf), (4.0, 2.5), (0.5, 2.5)])
def test_every_known_voxel_goes_to_the_nearest_place(
    dim: int, stretch: float, reach: float, rng: np.random.Generator
) -> None:
    path = straight(dim, lift=0.3)
    grid = corridor(path, rng)
    config = DivisionConfig(stretch=stretch, reach=reach, spacing=0.0)
    times = [0.0, 3.0, 7.5]
    pieces = divide_grid(grid, path, times, config=config)
    places, nodes = owning_places(path, np.array(times), config)
    at = np.zeros((len(places), 3))
    at[:, :dim] = places
    if dim == 2:
        at[:, 2] = 0.5 * grid.voxel_size
    got = {
        voxel: (m, value) for m, p in enumerate(pieces) for voxel, value in voxels_of(p.coordinates, p.values).items()
    }
    assert sum(p.known for p in pieces) == len(got)  # no voxel twice
    lost = 0
    for voxel, value in voxels_of_grid(grid).items():
        owner = nearest_owner(voxel, grid.voxel_size, at, nodes, stretch, reach)
        if owner < 0:
            lost += 1
            assert voxel not in got
        else:
            assert got[voxel] == (owner, value)
    assert (lost > 0) == np.isfinite(reach)
    assert min(p.known for p in pieces) > 50


@pytest.mark.parametrize("dim", [2, 3])
def test_pieces_at_rest_make_the_submap_again(dim: int, rng: np.random.Generator) -> None:
    path = straight(dim)
    grid = corridor(path, rng)
    submap = Submap(
        key=3, interval=(0.0, 10.0), exit_pose=path.poses[-1], exit_covariance=np.eye(3 if dim == 2 else 6),
        trajectory=path, grid=grid,
    )  # fmt: skip
    times = node_times_every(path, 3.0)
    assert len(times) == 3
    pieces = pieces_of_submap(submap, times)
    assert set(pieces) == {(3, 0), (3, 1), (3, 2)}
    inner = path.interpolate(times)
    fused = fuse_pieces(pieces, {(3, k): inner[k] for k in range(3)})
    assert same_map(fused.grid, grid)
    # moved as one they are the whole submap moved; bent they are not
    group = SE3 if dim == 3 else SE2
    T = some_pose(rng, dim)
    fused.move({(3, k): group.compose(T, inner[k]) for k in range(3)}, tolerance=0)
    rigid = fuse_pieces(pieces_of_submap(submap), {(3, 0): T})
    assert same_map(fused.grid, rigid.grid)
    fused.move({(3, 2): T})
    assert not same_map(fused.grid, rigid.grid)


def test_stretches_meet_half_way_between_nodes() -> None:
    path = straight(2, length=9.0, n=91)
    _, nodes = owning_places(path, np.array([0.0, 10.0 / 3 + 0.01]), DivisionConfig(spacing=0.0))
    assert int(np.sum(nodes == 0)) == 16  # 0 … 1.5 m; the node at 3 m leads from there on
    _, standing = owning_places(
        Trajectory(np.arange(10.0), np.zeros((10, 3))), np.array([0.0, 8.0]), DivisionConfig(spacing=0.0, retrace=0.0)
    )
    assert standing.tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 1, 1]  # half-way in time where nothing moves


def test_out_and_back_goes_with_the_way_out(rng: np.random.Generator) -> None:
    out = straight(2, length=9.0, n=46)
    poses = np.concatenate([out.poses, out.poses[::-1] + [0.0, 0.3, np.pi]])
    path = Trajectory(np.linspace(0.0, 20.0, 92), poses)
    grid = corridor(path, rng)
    times = [0.0, 5.0, 12.0, 17.0]
    pieces = divide_grid(grid, path, times, config=DivisionConfig(retrace=1.0))
    back = [v for p in pieces[2:] for v in voxels_of(p.coordinates, p.values)]
    # what lies around the turn is first seen there; of the walls along the way nothing goes with the way back
    assert min(v[0] for v in back) * grid.voxel_size > 5.5
    assert pieces[3].known == 0
    dealt = divide_grid(grid, path, times, config=DivisionConfig(retrace=0.0))
    assert sum(p.known for p in dealt[2:]) > 0.35 * sum(p.known for p in dealt)
    # a lane of its own is no way back
    lanes = np.concatenate([out.poses, out.poses[::-1] + [0.0, 2.5, np.pi]])
    apart = divide_grid(grid, Trajectory(path.times, lanes), times, config=DivisionConfig(retrace=1.0))
    assert sum(p.known for p in apart[2:]) > 0.25 * sum(p.known for p in apart)


def test_a_floor_between_storeys_goes_with_the_upper_one() -> None:
    """A path on a floor, up, and back over it: the slab's upper side is nearer to the lower path in a straight line."""
    low = np.column_stack([np.linspace(0, 10, 41), np.zeros(41), np.zeros(41)])
    high = np.column_stack([np.linspace(10, 0, 41), np.full(41, 4.0), np.full(41, 3.2)])
    p = np.concatenate([low, high])
    poses = np.zeros((len(p), 7))
    poses[:, :3], poses[:, 6] = p, 1.0
    path = Trajectory(np.linspace(0, 20, len(p)), poses)
    grid = EvidenceGrid(0.2)
    # the floor of the upper storey, 0.7 m under its path's height, over the lower path
    slab = np.array([[x, 0.1, 2.5] for x in np.arange(1.0, 9.0, 0.2)])
    grid.insert_scan(slab, origin=slab + [0.0, 0.0, 0.05])
    upper = {
        s: divide_grid(grid, path, [0.0, 15.0], config=DivisionConfig(stretch=s))[1].known / grid.voxel_counts().known
        for s in (1.0, 4.0)
    }
    assert upper[1.0] < 0.2
    assert upper[4.0] > 0.8


def test_a_piece_knows_its_box(rng: np.random.Generator) -> None:
    T = some_pose(rng, 3)
    piece = piece_of_grid(scanned(rng, 3), T)
    known = np.array(list(voxels_of(piece.coordinates, piece.values)))
    low, high = known.min(axis=0) * 0.25, (known.max(axis=0) + 1) * 0.25
    base = SE3.transform(np.broadcast_to(T, (8, 7)), piece.corners)
    assert np.allclose(base.min(axis=0), low)
    assert np.allclose(base.max(axis=0), high)
    assert piece.known == len(known)


def test_impossible_pieces_are_refused(rng: np.random.Generator) -> None:
    brick = np.zeros((1, 512), np.int16)
    at = np.zeros((1, 3), np.int64)
    for arguments in (
        (0.0, 3, at, brick),
        (0.2, 4, at, brick),
        (0.2, 3, at, brick.astype(np.int32)),
        (0.2, 3, at[:, :2], brick),
        (0.2, 3, np.repeat(at, 2, 0), np.repeat(brick, 2, 0)),
        (0.2, 2, at, brick),  # fills layers that a plane does not have
        (0.2, 3, np.array([[0, 0, 0], [100_000, 100_000, 0]]), np.repeat(brick, 2, 0)),
    ):
        with pytest.raises(GridError):
            Piece(*arguments)
    with pytest.raises(GeometryError):
        Piece(0.2, 3, at, brick, np.full(7, np.inf))
    with pytest.raises(GeometryError):
        Piece(0.2, 3, at, brick, np.zeros(3))
    flat = np.full((1, 512), UNKNOWN, np.int16)
    flat[0, 5] = 7
    assert Piece(0.2, 2, at, flat).known == 1


def test_impossible_divisions_are_refused(rng: np.random.Generator) -> None:
    path = straight(2)
    grid = corridor(path, rng)
    for times in ([], [3.0, 1.0], [0.0, 99.0], [0.0, np.nan]):
        with pytest.raises(DataError):
            divide_grid(grid, path, times)
    with pytest.raises(DataError):
        divide_grid(grid, straight(3), [0.0])
    with pytest.raises(DataError):
        divide_grid(grid, path, [0.0, 1.0], T_base_nodes=np.zeros((3, 3)))
    for wrong in ({"stretch": 0.0}, {"reach": -1.0}, {"retrace": np.nan}, {"spacing": np.inf}):
        with pytest.raises(ConfigError):
            DivisionConfig(**wrong)
    with pytest.raises(ConfigError):
        node_times_every(path, 0.0)
    bare = Submap(key=0, interval=(0.0, 1.0), exit_pose=np.zeros(3), exit_covariance=np.eye(3))
    with pytest.raises(DataError, match="has no map"):
        pieces_of_submap(bare)
    pathless = Submap(key=0, interval=(0.0, 1.0), exit_pose=np.zeros(3), exit_covariance=np.eye(3), grid=grid)
    assert set(pieces_of_submap(pathless)) == {(0, 0)}
    with pytest.raises(DataError, match="no path"):
        pieces_of_submap(pathless, [0.0])
    with pytest.raises(DataError, match="names"):
        pieces_of_submap(pathless, names=["a", "b"])
