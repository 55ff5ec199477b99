"""The scenes of the benchmark are what they say: rays end on walls and nowhere before, the loop closes."""

from __future__ import annotations

import numpy as np

from graphslam.core.se3 import quat_rotate, se3_transform
from tests.benchmarks import evidence_scenes as scenes


def test_tunnel_rays_end_on_the_wall_and_nowhere_before():
    s = scenes.tunnel(40)
    s.poses[:, :3] += scenes.CORNER
    points = s.clouds[17]
    directions = quat_rotate(s.poses[17, 3:], points / np.linalg.norm(points, axis=1)[:, None])
    origins = np.broadcast_to(s.poses[17, :3], directions.shape)
    ranges = scenes.tunnel_ranges(origins, directions, 40.0)
    hit = ranges < 40.0
    assert 0.8 < hit.mean() < 1.0
    end = origins + ranges[:, None] * directions
    assert np.abs(scenes._clearance(end[hit])).max() < 1e-3
    along = np.linspace(0.0, 0.999, 2000)
    for o, e in zip(origins, end):
        assert scenes._clearance(o + along[:, None] * (e - o)).min() > -1e-6
    measured = np.linalg.norm(points, axis=1)
    assert 0.01 < np.std((measured - ranges)[hit & (ranges < 30.0)]) < 0.03  # σ = 2 cm
    beyond = scenes.tunnel(1000)
    share = np.mean([~returns for _, _, returns in beyond])
    assert 0.02 < share < 0.07


def test_loop_is_smooth_closed_and_200_metres_long():
    s = np.linspace(0.0, 200.0, 20_001)
    xy, heading = scenes._loop(s)
    step = np.diff(xy, axis=0)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 0.01, rtol=1e-4)
    course = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    middle = np.unwrap(0.5 * (heading[1:-1] + heading[:-2]))
    np.testing.assert_allclose(course[:-1], middle, atol=0.01)
    np.testing.assert_allclose(xy[-1], xy[0], atol=1e-6)
    clear = scenes._clearance(np.column_stack([xy, np.full(len(xy), -0.6)]))
    assert clear.min() > 0.5


def test_street_points_lie_on_its_shapes():
    s = scenes.street(2)
    low, high, poles = scenes._street_shapes(4)
    points = se3_transform(s.poses[1], s.clouds[1])
    points = points[np.linalg.norm(s.clouds[1], axis=1) < s.max_range]
    points = points[np.random.default_rng(0).choice(len(points), 4000, replace=False)]
    outside = np.maximum(np.maximum(low - points[:, None], points[:, None] - high), 0.0)
    inside = np.minimum(points[:, None] - low, high - points[:, None]).min(axis=-1)
    box = np.where(inside > 0, inside, np.linalg.norm(outside, axis=-1)).min(axis=1)
    pole = np.abs(np.linalg.norm(points[:, None, :2] - poles[:, :2], axis=-1) - poles[:, 2]).min(axis=1)
    ground = np.abs(points[:, 2])
    assert np.minimum(np.minimum(box, pole), ground).max() < 5 * scenes.STREET_SIGMA
    for near in (ground, box, pole):
        assert np.mean(near < 0.06) > 0.002  # all three kinds are seen
    # nothing is seen through a box: half-way points are outside of all of them
    o = s.poses[1, :3]
    half = o + 0.9 * (points - o)
    deep = np.minimum(half[:, None] - low, high - half[:, None]).min(axis=-1).max(axis=1)
    assert np.mean(deep > 0.05) == 0.0
