"""Things that move are kept out of maps: a box that is carried through a hall with pillars."""

import numpy as np
import pytest

from graphslam.core.dense import CloudMap
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.moving import MovedObjects, moving_points, without_moving
from graphslam.maps.run_map import make_run_map
from graphslam.sim.raycast import RayCaster

SUBMAPS, SCANS = 12, 4


def _box(lower, upper):
    """Vertices and triangles of a box."""
    v = np.array([[x, y, z] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return v, np.array([[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))])


def _scene(boxes):
    vertices, triangles, n = [], [], 0
    for lower, upper in boxes:
        v, t = _box(lower, upper)
        vertices.append(v)
        triangles.append(t + n)
        n += len(v)
    return RayCaster(np.concatenate(vertices), np.concatenate(triangles))


@pytest.fixture(scope="module")
def made():
    """Submaps along a hall, bases, and which of their points are on the box that moves."""
    rng = np.random.default_rng(4)
    hall = [((-12, -8, -1), (22, 8, 4))]
    pillars = [((x, y, -1), (x + 0.6, y + 0.6, 3)) for x in (-6, 0, 6, 12) for y in (-5, 4.4)]
    bases = np.tile([0.0, 0, 0, 0, 0, 0, 1], (SUBMAPS, 1))
    bases[:, 0] = 0.5 * np.arange(SUBMAPS)
    static = _scene(hall + pillars)
    submaps, truth = [], []
    for k in range(SUBMAPS):
        grid, points, scan, origins, moved = EvidenceGrid(0.2), [], [], [], []
        for j in range(SCANS):
            t = k * SCANS + j
            at = np.array([3.0 + 0.25 * t - 4.0, 2.0, -0.9])
            mover = _scene([(at, at + [1.5, 0.8, 1.6])])
            origin = np.array([0.1 * j, 0.0, 0.3])
            d = rng.normal(size=(2500, 3)) * [1.0, 1.0, 0.4]
            d /= np.linalg.norm(d, axis=1)[:, None]
            rays = np.hstack([np.broadcast_to(bases[k, :3] + origin, d.shape), d])
            far = static.ranges(rays)
            near = mover.ranges(rays)
            hit = np.isfinite(near) & (near < far)
            r = np.where(hit, near, far) + rng.normal(0, 0.015, len(d))
            p = origin + d * r[:, None]
            grid.insert_scan(p, np.broadcast_to(origin, p.shape))
            points.append(p)
            scan.append(np.full(len(p), j))
            origins.append(origin)
            moved.append(hit)
        cloud = CloudMap(points=np.concatenate(points), origins=np.array(origins), scan=np.concatenate(scan))
        exit_pose = np.array([0.5, 0, 0, 0, 0, 0, 1])
        interval = (float(k), float(k + 1))
        submaps.append(
            Submap(
                key=k, interval=interval, exit_pose=exit_pose, exit_covariance=1e-4 * np.eye(6), grid=grid, cloud=cloud
            )
        )
        truth.append(np.concatenate(moved))
    return submaps, bases, truth


def test_what_moved_is_found_and_what_stands_is_left(made):
    submaps, bases, truth = made
    found = moving_points(submaps, bases)
    moved, static = np.concatenate(truth), ~np.concatenate(truth)
    flagged = np.concatenate(found)
    z = np.concatenate([s.cloud.points[:, 2] for s in submaps])
    high = z > -1.0 + 0.4  # what is nearer to the ground is left alone
    assert moved.sum() > 1000
    assert np.mean(flagged[moved & high]) > 0.9
    assert np.mean(flagged[static]) < 0.002


def test_its_voxels_are_gone_from_the_maps(made):
    submaps, bases, truth = made
    left = without_moving(submaps, moving_points(submaps, bases))
    before = after = kept = stood = 0
    for a, b, moved in zip(submaps, left, truth):
        on = a.cloud.points[moved & (a.cloud.points[:, 2] > -0.4)]
        before += a.grid.occupied_at(on).sum()
        after += b.grid.occupied_at(on).sum()
        still = a.cloud.points[~moved]
        stood += a.grid.occupied_at(still).sum()
        kept += b.grid.occupied_at(still).sum()
    assert before > 1000
    assert after < 0.05 * before
    assert kept > 0.99 * stood
    assert sum(s.report.get("points_moved", 0) for s in left) == sum(m.sum() for m in moving_points(submaps, bases))


def test_the_fused_map_is_without_it_whatever_path_it_is_of(made):
    submaps, bases, truth = made
    poses = np.concatenate([bases, [[0.5 * SUBMAPS, 0, 0, 0, 0, 0, 1]]])
    times, none = np.arange(SUBMAPS + 1.0), np.zeros(0, np.int64)
    solved = GlobalMap(
        Trajectory(times, poses), times, poses, np.zeros((len(poses), 6, 6)), none, np.zeros((0, 2)),
        np.zeros((0, 2, 2)), none,
    )  # fmt: skip
    fused = make_run_map(submaps, solved)
    removed, every = fused.moving
    assert every == sum(len(m) for m in truth)
    assert removed == sum(m.sum() for m in moving_points(submaps, bases))
    on = np.concatenate([bases[k, :3] + s.cloud.points[m] for k, (s, m) in enumerate(zip(submaps, truth))])
    assert fused.fused.grid.occupied_at(on[on[:, 2] > -0.4]).mean() < 0.05


def test_submaps_without_free_space_are_left_alone(made):
    submaps, bases, _ = made
    bare = [
        Submap(key=s.key, interval=s.interval, exit_pose=s.exit_pose, exit_covariance=s.exit_covariance)
        for s in submaps
    ]
    assert all(len(m) == 0 for m in moving_points(bare, bases))
    assert without_moving(bare, moving_points(bare, bases)) == bare


def box_points(low, high, rng, many: int = 1500):
    """Points on the sides of an upright box."""
    q = rng.uniform(low, high, (many, 3))
    side = rng.integers(0, 4, many)
    q[np.arange(many), side % 2] = np.where(side < 2, low[:2].T[side % 2], high[:2].T[side % 2])
    return q


def test_a_thing_most_of_which_moved_goes_as_a_whole_and_what_stands_beside_it_stays(rng):
    ground = np.column_stack([rng.uniform(-8.0, 8.0, (20_000, 2)), np.zeros(20_000)])
    car = box_points(np.array([0.0, -0.9, 0.0]), np.array([3.0, 0.9, 1.5]), rng)
    wall = box_points(np.array([-8.0, 2.0, 0.0]), np.array([8.0, 2.2, 2.0]), rng, 6000)
    points = np.concatenate([ground, car, wall])
    kind = np.repeat([0, 1, 2], [len(ground), len(car), len(wall)])
    known = car[(car[:, 0] > 1.0) & (car[:, 2] > 0.4)]
    parts = MovedObjects(known).parts(points)
    assert parts[kind == 1].all()
    assert not parts[kind == 2].any()
    away = np.hypot(*(np.maximum(np.abs(ground[:, :2] - [1.5, 0.0]) - [1.5, 0.9], 0.0)).T)
    assert not parts[kind == 0][away > 1.1].any()
    # a few points that were wrongly taken for moved do not take the wall with them
    some = MovedObjects(wall[(np.abs(wall[:, 0]) < 0.1) & (wall[:, 2] > 0.4)]).parts(points)
    assert 0 < some[kind == 2].sum() < 0.15 * (kind == 2).sum()


def test_what_is_near_to_what_moved_is_what_a_plain_search_finds(rng):
    points, known = rng.uniform(-6.0, 6.0, (3000, 3)), rng.uniform(-3.0, 3.0, (40, 3))
    points[:, 2] = 0.0  # nothing stands: only what is near belongs
    nearest = np.min(np.hypot(*(points[:, None, :2] - known[None, :, :2]).transpose(2, 0, 1)), axis=1)
    parts = MovedObjects(known).parts(points)
    assert parts[nearest < 0.6 - 0.22].all()
    assert not parts[nearest > 0.6 + 0.22].any()
    assert not MovedObjects(np.zeros((0, 3))).parts(points).any()
    assert MovedObjects(known).parts(points[:0]).shape == (0,)
