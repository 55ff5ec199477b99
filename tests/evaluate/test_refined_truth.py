"""Truth in the frame of a refined path."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.map_truth import MapTruth
from graphslam.core.poses import SE2, SE3, remove_roll_pitch
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.refined import level_truth


def tilted(rng, n):
    """Poses of a body that leans by some degrees."""
    e = np.column_stack([rng.normal(0, 0.05, (n, 2)), rng.uniform(-3, 3, n), rng.normal(0, 5.0, (n, 3))])
    return SE3.exp(e)


def some_truth(exits):
    return MapTruth(
        keys=np.arange(len(exits)), exit_poses=exits, landmark_ids=np.zeros(0, np.int64), landmarks=np.zeros((0, 3))
    )


@pytest.mark.parametrize("lean", [0.0, 0.02])
def test_the_first_position_and_heading_have_no_error_whatever_the_tilt_of_the_base(rng, lean):
    """The first base lies 5 cm below the body, along an estimated vertical that is wrong by ``lean``."""
    world = tilted(rng, 6)
    below = SE3.exp(np.array([lean, -0.7 * lean, 0.0, 0.0, 0.0, -0.05]))
    base = SE3.compose(world[0], below)
    bases = np.broadcast_to(base, world.shape)
    times = np.arange(6.0)
    estimate = SE3.compose(np.broadcast_to(SE3.exp(np.array([0.01, 0.02, 0.4, 1.0, 2.0, 3.0])), world.shape), world)
    truth, path = level_truth(
        some_truth(SE3.between(bases, world)),
        Trajectory(times, SE3.between(bases, world)),
        base,
        Trajectory(times, estimate),
    )
    error = SE3.between(remove_roll_pitch(estimate[0]), remove_roll_pitch(path.poses[0]))
    np.testing.assert_allclose(SE3.log(error), 0.0, atol=1e-12)
    np.testing.assert_allclose(truth.exit_poses, path.poses, atol=1e-12)
    # level: only a turn about the vertical and a shift lie between this frame and the world
    turn = SE3.compose(path.poses, SE3.inverse(world))
    np.testing.assert_allclose(turn[:, 3:5], 0.0, atol=1e-12)


def test_without_truth_at_the_first_pose_the_first_base_is_level(rng):
    world = tilted(rng, 4)
    bases = np.broadcast_to(world[0], world.shape)
    known = SE3.between(bases, world)
    times = np.arange(4.0)
    truth, path = level_truth(some_truth(known), Trajectory(times[1:], known[1:]), world[0], Trajectory(times, known))
    wanted = SE3.between(np.broadcast_to(remove_roll_pitch(world[0]), world.shape), world)
    np.testing.assert_allclose(truth.exit_poses, wanted, atol=1e-12)
    np.testing.assert_allclose(path.poses, wanted[1:], atol=1e-12)


def test_in_the_plane_nothing_is_level(rng):
    poses = rng.normal(size=(3, 3))
    path = Trajectory(np.arange(3.0), poses)
    truth = MapTruth(
        keys=np.arange(3), exit_poses=poses, landmark_ids=np.zeros(0, np.int64), landmarks=np.zeros((0, 2))
    )
    assert level_truth(truth, path, SE2.identity, path) == (truth, path)
