"""Ways driven: exact derivatives, no jumps, near the waypoints, on the floor."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.se3 import quat_rotate, se3_between, so3_log
from graphslam.sim.crawler_sensors import roll_pitch_angles
from graphslam.sim.drive import DriveConfig, RouteMotion, drive_motion
from graphslam.sim.raycast import RayCaster
from tests.reference.drive_path import drive_through_world
from tests.reference.plain_mesh import hall, quad


@pytest.fixture(scope="module")
def motion() -> RouteMotion:
    return drive_motion(hall())


def leaning_motion() -> RouteMotion:
    """Turns on a plane that leans both ways: yaw, pitch and roll change together."""
    plane = np.array([0.15, 0.3])
    corners = np.array([[0.0, 0], [6, 0], [6, 5], [1, 6], [1, 1]])
    floor = quad(*([x, y, plane @ [x, y]] for x, y in [(-5, -5), (15, -5), (15, 15), (-5, 15)]))
    world = hall(np.column_stack([corners, corners @ plane]), corner_radius=1.5)
    world = dataclasses.replace(world, vertices=floor[0], triangles=floor[1])
    return drive_motion(world, caster=RayCaster.of(world))


@pytest.mark.parametrize("leaning", [False, True])
def test_derivatives_are_those_of_the_poses(leaning: bool, motion: RouteMotion, rng: np.random.Generator) -> None:
    h = 1e-4
    motion = leaning_motion() if leaning else motion
    t = rng.uniform(h, motion.duration - h, 1000)
    before, after = motion.poses(t - h), motion.poses(t + h)
    np.testing.assert_allclose((after - before)[:, :3] / (2 * h), motion.velocities(t), atol=1e-6)
    np.testing.assert_allclose(
        (motion.velocities(t + h) - motion.velocities(t - h)) / (2 * h), motion.accelerations(t), atol=1e-4
    )
    rate, change = motion.rotation(t)
    np.testing.assert_allclose(so3_log(se3_between(before, after)[:, 3:]) / (2 * h), rate, atol=1e-5)
    np.testing.assert_allclose((motion.rotation(t + h)[0] - motion.rotation(t - h)[0]) / (2 * h), change, atol=2e-3)
    assert np.abs(rate).max(axis=0)[0 if leaning else 1 :].min() > 0.05  # it does pitch and turn
    assert np.abs(motion.accelerations(t)).max() > 0.1


def test_the_way_is_that_of_the_world_from_rest_to_rest(motion: RouteMotion) -> None:
    world = hall()
    t = np.linspace(0.0, motion.duration, 4001)
    wanted = world.route().positions(np.linspace(0.0, world.route().length, 4001))
    got = motion.poses(t)[:, :3]
    away = np.linalg.norm(got[::4, None] - wanted[None, ::2], axis=2).min(axis=1)
    assert away.max() < 0.03
    np.testing.assert_allclose(got[[0, -1]], world.waypoints[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(motion.velocities(t[[0, -1]]), 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.accelerations(t[[0, -1]]), 0.0, atol=1e-9)
    assert motion.length == pytest.approx(world.route().length, rel=1e-3)


def test_it_moves_along_its_own_x_axis_at_the_speed_of_the_world(motion: RouteMotion) -> None:
    t = np.linspace(0.0, motion.duration, 5000)
    own = quat_rotate(motion.poses(t)[:, 3:] * [-1, -1, -1, 1], motion.velocities(t))
    assert np.abs(own[:, 1:]).max() < 0.002  # of 0.75 m/s: smoothing cuts corners by less
    assert own[:, 0].max() == pytest.approx(0.75, rel=1e-3)
    assert own[:, 0].min() >= -1e-9
    assert np.median(own[:, 0]) == pytest.approx(0.75, rel=0.01)


def test_nothing_jumps_and_pitch_takes_the_wheelbase_to_change(motion: RouteMotion) -> None:
    t = np.arange(0.0, motion.duration, 1e-3)
    rate, change = motion.rotation(t)
    assert np.abs(np.diff(rate, axis=0)).max() < 1e-3 * np.abs(change).max() * 1.1  # the rate follows its derivative
    assert np.abs(np.diff(motion.velocities(t), axis=0)).max() < 1e-3
    tilt = roll_pitch_angles(motion.poses(t)[:, 3:])
    ramp = np.arctan(0.5 / 4.0)
    assert -tilt[:, 1].min() == pytest.approx(ramp, rel=1e-3)  # uphill the nose is up: pitch < 0
    assert tilt[:, 1].max() == pytest.approx(ramp, rel=1e-3)
    first = t < t[np.argmin(tilt[:, 1])]
    x = motion.poses(t)[first, 0]
    between = x[(tilt[first, 1] < -0.02 * ramp) & (tilt[first, 1] > -0.98 * ramp)]
    assert 0.3 < between.max() - between.min() < 0.6
    assert abs(between.mean() - 6.0) < 0.02


def test_tight_corners_are_driven_slowly() -> None:
    corners = [[0, 0, 0], [5, 0, 0], [5, 3, 0], [0, 3, 0]]
    slow = drive_motion(hall(corners, corner_radius=0.5), DriveConfig(most_turn_rate=0.4))
    fast = drive_motion(hall(corners, corner_radius=0.5), DriveConfig(most_turn_rate=5.0))
    t = np.linspace(0, 1, 4000)
    turning = [np.abs(m.rotation(t * m.duration)[0][:, 2]).max() for m in (slow, fast)]
    assert 0.3 < turning[0] <= 0.401
    assert turning[1] > 1.0
    assert slow.duration > fast.duration + 1.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_roll_is_that_of_the_floor(side: float) -> None:
    lean = side * 0.1  # the floor rises to the left by so much a metre
    floor = quad(*([x, y, lean * y] for x, y in [(-3, -3), (12, -3), (12, 3), (-3, 3)]))
    world = dataclasses.replace(hall([[0, 0, 0], [8, 0, 0]]), vertices=floor[0], triangles=floor[1])
    tilted = roll_pitch_angles(drive_through_world(world, caster=RayCaster.of(world)).poses[:, 3:])
    np.testing.assert_allclose(tilted, np.tile([np.arctan(lean), 0.0], (len(tilted), 1)), atol=1e-5)
    flat = roll_pitch_angles(drive_through_world(world).poses[:, 3:])
    np.testing.assert_allclose(flat, 0.0, atol=1e-12)


def test_no_floor_no_roll() -> None:
    """A hole under a wheel, or a table above it, is not the floor."""
    floor = quad([-3, 0.1, 0], [12, 0.1, 0], [12, 3, 0], [-3, 3, 0])
    table = quad([-3, -3, 0.4], [12, -3, 0.4], [12, -0.1, 0.4], [-3, -0.1, 0.4])
    for vertices, triangles in (floor, (np.vstack([floor[0], table[0]]), np.vstack([floor[1], table[1] + 4]))):
        world = dataclasses.replace(hall([[0, 0, 0], [8, 0, 0]]), vertices=vertices, triangles=triangles)
        roll = roll_pitch_angles(drive_through_world(world, caster=RayCaster.of(world)).poses[:, 3:])[:, 0]
        np.testing.assert_allclose(roll, 0.0, atol=1e-9)


def test_rate_and_rest() -> None:
    config = DriveConfig(rate=20.0, stand=3.0)
    path = drive_through_world(hall(), config)
    np.testing.assert_allclose(np.diff(path.times), 0.05)
    moved = np.linalg.norm(path.positions - path.positions[0], axis=1)
    assert moved[path.times <= 3.0].max() < 1e-9
    assert moved[path.times > 4.5].min() > 0.1
    assert path.times[-1] == pytest.approx(drive_through_world(hall()).times[-1] + 3.0, abs=0.06)


def test_a_way_of_a_hand_is_driven_as_well() -> None:
    motion = drive_motion(hall([[0, 0, 0], [0.1, 0, 0]]))
    t = np.linspace(0.0, motion.duration, 50)
    x = motion.poses(t)[:, 0]
    assert np.all(np.diff(x) > -1e-9)
    assert x[[0, -1]] == pytest.approx([0.0, 0.1], abs=1e-6)
    assert motion.velocities(t)[:, 0].max() <= 0.76


def test_impossible_wishes_are_refused(motion: RouteMotion) -> None:
    for t in ([-1.0], [0.0, motion.duration + 1.0], [np.nan]):
        with pytest.raises(DataError, match="outside the drive"):
            motion.poses(np.array(t))
    for change in ({"rate": 0.0}, {"wheelbase": -1.0}, {"ramp": np.nan}):
        with pytest.raises(ConfigError, match=next(iter(change))):
            DriveConfig(**change)
