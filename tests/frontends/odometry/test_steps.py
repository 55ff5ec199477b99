"""Logs become steps: deskewed, thinned, complete."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.point_clouds import PointClouds
from graphslam_frontends.odometry.deskew import assign_steps, cut_beams, stratified_indices
from graphslam_frontends.odometry.inertial_biases import InertialBiases
from graphslam_frontends.odometry.make_steps import level_on_the_whole, make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from tests.frontends.step_logs import HALF, odometry_of, planar_log, room_log, spoiled
from tests.reference.imu_drive import drive
from tests.reference.plain_steps import deskew_all, room_scans, winding_path


@pytest.fixture(scope="module")
def room() -> SensorLog:
    return room_log()


def test_equals_deskewing_beam_by_beam(room: SensorLog) -> None:
    steps = make_steps(room, StepConfig(period=0.4))
    plain = deskew_all(room["scanner"], room.truth.trajectory, steps.times, 0.0)
    assert len(plain) == len(steps) == 10
    for k, beams in enumerate(plain):
        points, origins, met = steps.scan(k)
        assert len(points) == len(beams) > 60
        np.testing.assert_allclose(origins, [b[0] for b in beams], atol=1e-9)
        np.testing.assert_allclose(points, [b[1] for b in beams], atol=1e-9)
        np.testing.assert_array_equal(met, [b[2] for b in beams])


def test_with_perfect_motion_every_return_is_on_a_wall(room: SensorLog) -> None:
    steps = make_steps(room)
    poses = steps.truth.interpolate(steps.times)
    on, without = 0.0, 0.0
    for k in range(len(steps)):
        points, _, met = steps.scan(k)
        world = se3.se3_transform(poses[k], points[met])
        assert np.all(np.abs(world) < HALF + 0.02)
        on = max(on, np.abs(np.abs(world) - HALF).min(axis=1).max())
    assert on < 1e-2  # the path between its records is interpolated
    # and were the motion within a step ignored, it would not be so
    frozen = replace(room["scanner"], beam_times=np.zeros(15))
    still = SensorLog(name="still", streams={"scanner": frozen, "odometry": room["odometry"]})
    for k, (a, b) in enumerate(zip(steps.offsets[:-1], steps.offsets[1:])):
        skewed, _, met = make_steps(still).scan(k)
        if len(met) == b - a and np.any(met):
            world = se3.se3_transform(poses[k], skewed[met])
            without = max(without, np.abs(np.abs(world) - HALF).min(axis=1).max())
    assert without > 3.0 * on


def test_odometry_chains_to_the_path(room: SensorLog) -> None:
    steps = make_steps(room, StepConfig(period=0.3))
    path = room.truth.trajectory
    T = path.interpolate(steps.times[:1])[0]
    for step in steps.odometry.increments[1:]:
        T = se3.se3_compose(T, step)
    np.testing.assert_allclose(T, path.interpolate(steps.times[-1:])[0], atol=1e-9)
    np.testing.assert_array_equal(steps.odometry.increments[0], [0, 0, 0, 0, 0, 0, 1])
    # 0.3 s at 50 Hz: 15 records of 1 mm each, and a little more sideways by the lever of the turns
    sigma = np.sqrt(np.diagonal(steps.odometry.covariances[3]))
    np.testing.assert_allclose(sigma, np.sqrt(15) * 1e-3, rtol=0.05)
    assert steps.path_length[-1] == pytest.approx(steps.times[-1] - steps.times[0], rel=0.02)  # 1 m/s, in chords
    assert steps.uses == {"scanner", "odometry"}
    assert steps.range_sigma == 0.02
    assert steps.max_range == 8.0
    assert steps.tilt is None


def test_thinning_is_spread_and_always_the_same(room: SensorLog) -> None:
    drops = DropCounter()
    full, thin = make_steps(room), make_steps(room, StepConfig(most_points=20), drops=drops)
    assert np.all(np.diff(thin.offsets) == 20)
    assert drops.counts["scanner: beams thinned out (20 per step kept)"] == len(full.points) - len(thin.points)
    for k in range(len(full)):
        chosen = stratified_indices(int(full.offsets[k + 1] - full.offsets[k]), 20)
        for a, b in zip(thin.scan(k), full.scan(k)):
            np.testing.assert_array_equal(a, b[chosen])
    again = make_steps(room, StepConfig(most_points=20))
    np.testing.assert_array_equal(again.points, thin.points)


@pytest.mark.parametrize(("n", "most"), [(0, 5), (5, 5), (6, 5), (1000, 400), (905, 60), (2715, 400), (800, 400)])
def test_spread(n: int, most: int) -> None:
    chosen = stratified_indices(n, most)
    assert len(chosen) == min(n, most)
    assert np.all(np.diff(chosen) > 0)
    assert np.all((chosen >= 0) & (chosen < n))
    if n > most:
        gaps = np.diff(np.concatenate([[-1], chosen, [n]]))
        assert gaps.max() <= 2 * int(np.ceil(n / most))


def test_spread_does_not_fall_into_step_with_scans() -> None:
    """Half of the beams of scans of 60: every beam of the fan gets its turn, none twice as often as another."""
    counts = np.bincount(stratified_indices(6000, 3000) % 60, minlength=60)
    assert counts.min() > 35
    assert counts.max() < 65


def test_directions_equal_those_of_whole_scans(room: SensorLog, rng: np.random.Generator) -> None:
    scans = room["scanner"]
    k, j = rng.integers(len(scans.times), size=50), rng.integers(15, size=50)
    np.testing.assert_allclose(scans.beam_directions(k, j), scans.head_rays()[1][k, j], atol=1e-12)


def test_beams_belong_to_the_step_they_end_in() -> None:
    steps = np.array([1.0, 2.0])
    beams = np.array([0.4, 0.5, 1.0, 1.0 + 1e-12, 2.0, 2.1])
    np.testing.assert_array_equal(assign_steps(beams, steps, 0.5), [-1, 0, 0, 1, 1, -1])


def test_long_beams_are_cut_and_met_nothing(room: SensorLog) -> None:
    full, cut = make_steps(room), make_steps(room, StepConfig(max_range=3.0))
    length = np.linalg.norm(full.points - full.origins, axis=1)
    np.testing.assert_allclose(np.linalg.norm(cut.points - cut.origins, axis=1), np.minimum(length, 3.0), atol=1e-9)
    np.testing.assert_array_equal(cut.returns, length < 3.0)
    assert np.any(cut.returns)
    assert not np.all(cut.returns)
    assert cut.max_range == 3.0
    ends, met = cut_beams(np.zeros((2, 3)), np.array([[0, 0, 2.0], [0, 0, 1.0]]), np.array([True, False]), 1.5)
    np.testing.assert_allclose(ends, [[0, 0, 1.5], [0, 0, 1.0]])
    np.testing.assert_array_equal(met, [False, False])


def test_two_scanners_share_the_beams_of_a_step(room: SensorLog) -> None:
    other = replace(room["scanner"], max_range=4.0, ranges=np.minimum(room["scanner"].ranges, 4.0))
    steps = make_steps(spoiled(room, scanner2=other), StepConfig(most_points=40))
    assert np.all(np.diff(steps.offsets) == 40)
    assert steps.uses == {"scanner", "scanner2", "odometry"}
    length = np.linalg.norm(steps.points - steps.origins, axis=1)
    assert steps.max_range == 8.0
    assert np.all(length[~steps.returns] > 3.999)
    one = make_steps(spoiled(room, scanner2=other), StepConfig(scanners=("scanner",)))
    np.testing.assert_array_equal(one.points, make_steps(room).points)


def test_one_step_a_record(room: SensorLog) -> None:
    scans = room["scanner"]
    steps = make_steps(room, StepConfig(period=None))
    np.testing.assert_allclose(steps.times, scans.times + 0.04)
    assert np.all(np.diff(steps.offsets) == 15)


def test_degraded_by_a_stated_bias(room: SensorLog) -> None:
    clean, off = make_steps(room), make_steps(room, StepConfig(yaw_bias=0.005))
    assert "0.005 rad/s" in off.name
    assert clean.name == "room"
    seconds = clean.times[-1] - clean.times[0]
    T, P = clean.errors.between(0, 9)
    U, C = off.errors.between(0, 9)
    xi = se3.se3_log(se3.se3_between(U, T))  # true in estimated: the bias itself, hardly anything else
    assert xi[2] == pytest.approx(-0.005 * seconds, rel=0.1)
    assert np.sqrt(C[2, 2] - P[2, 2]) == pytest.approx(0.005 * seconds, rel=0.1)
    added = C - P  # one σ of one constant error
    np.testing.assert_allclose(added, np.outer(xi, xi), atol=0.05 * np.abs(added).max())
    with pytest.raises(DataError, match="where level is"):
        off.errors.between(0, 9, level_start=True)


def test_motion_of_an_imu_and_wheels() -> None:
    d = drive(np.random.default_rng(0), seconds=8.0)
    scans = room_scans(d.truth, np.array([40.0, 40.0, 4.0]), beams=7, max_range=12.0)
    log = SensorLog(name="crawler", streams={"imu": d.imu, "wheels": d.wheels, "scanner": scans}, truth=Truth(d.truth))
    steps = make_steps(log)
    assert steps.dim == 3
    assert steps.tilt.shape == (len(steps), 2)
    assert steps.tilt_sigma == pytest.approx(d.imu.noise.attitude)
    assert steps.tilt_time == d.imu.noise.attitude_time
    assert isinstance(steps.errors.biases, InertialBiases)
    assert steps.uses == {"imu", "wheels", "scanner"}
    # moved by the estimated motion inside a step only: within centimetres of the truth
    exact = make_steps(SensorLog(name="exact", streams={"scanner": scans, "odometry": odometry_of(d.truth)}))
    assert np.array_equal(exact.offsets, steps.offsets)
    assert np.linalg.norm(exact.points - steps.points, axis=1).max() < 0.15
    assert np.linalg.norm(exact.points - steps.points, axis=1).mean() < 0.02
    biased = make_steps(log, StepConfig(yaw_bias=0.02))
    turned = se3.so3_log(se3.se3_between(biased.errors.poses[-1], steps.errors.poses[-1])[3:])
    assert turned[2] == pytest.approx(-0.02 * (steps.times[-1]), rel=0.05)


def test_level_floors_tell_what_gravity_is_off_by(rng: np.random.Generator) -> None:
    """Out on the flat, up a ramp, on, down another, and back: the median is the constant error, whatever the ramps."""
    constant = np.array([0.004, -0.0055])
    tilt = constant + 0.004 * rng.standard_normal((600, 2))
    tilt[100:160, 1] -= 0.12
    tilt[380:440, 1] += 0.12
    increments = np.zeros((600, 7))
    increments[:, 0], increments[:, 6] = 0.25, 1.0
    # a long stand on a slope says nothing of floors
    increments[:200, 0] = np.where(np.arange(200) < 90, 0.0, 0.25)
    tilt[:90] += 0.08
    level = level_on_the_whole(tilt, increments)
    assert level is not None
    removed = tilt - level
    np.testing.assert_allclose(removed, np.broadcast_to(removed[0], removed.shape), atol=1e-15)  # one number each
    np.testing.assert_allclose(removed[0], constant, atol=8e-4)
    assert level_on_the_whole(None, increments) is None
    still = level_on_the_whole(tilt, np.tile([0.0, 0, 0, 0, 0, 0, 1], (600, 1)))
    assert still is not None
    assert np.all(np.isfinite(still))


def test_steps_on_level_floors() -> None:
    d = drive(np.random.default_rng(0), seconds=8.0)
    scans = room_scans(d.truth, np.array([40.0, 40.0, 4.0]), beams=7, max_range=12.0)
    log = SensorLog(name="crawler", streams={"imu": d.imu, "wheels": d.wheels, "scanner": scans}, truth=Truth(d.truth))
    plain, level = make_steps(log), make_steps(log, StepConfig(level_floors=True))
    np.testing.assert_array_equal(level.tilt, level_on_the_whole(plain.tilt, plain.odometry.increments))
    assert np.abs(level.tilt - plain.tilt).max() > 1e-3
    np.testing.assert_array_equal(plain.odometry.increments, level.odometry.increments)


def test_motion_of_the_beams_dimension_is_taken(room: SensorLog) -> None:
    """A planar robot with an IMU drives in the plane; a log with both odometries gives each scanner its own."""
    d, flat = drive(None, seconds=8.2), planar_log()
    steps = make_steps(planar_log(imu=d.imu))
    np.testing.assert_array_equal(steps.odometry.increments, make_steps(flat).odometry.increments)
    both = {"flat": odometry_of(flat.truth.trajectory), **room.streams, "laser": flat["laser"]}
    log = SensorLog(name="both", streams=both)
    assert make_steps(log).uses == {"scanner", "odometry"}
    assert make_steps(log, StepConfig(scanners=("laser",))).uses == {"laser", "flat"}
    with pytest.raises(ConfigError, match="2 dimensions, the motion of odometry 3"):
        make_steps(log, StepConfig(scanners=("laser",), motion=("odometry",)))


def test_clouds_keep_their_order_and_origin(rng: np.random.Generator) -> None:
    path = winding_path()
    points = rng.uniform(-3.0, 3.0, size=(600, 3))
    points[10] = [0.5, 0, 0.001]
    mount = np.array([0.1, 0, 0.3, 0, 0, np.sin(0.2), np.cos(0.2)])
    times = path.times[[20, 50, 90, 130]]
    offsets = np.array([0, 200, 200, 350, 600])
    clouds = PointClouds.from_arrays(times, points, offsets, origin=np.array([0.5, 0.0, 0.0]), T_base_sensor=mount)
    log = SensorLog(name="lidar", streams={"clouds": clouds, "odometry": odometry_of(path)})
    drops = DropCounter()
    steps = make_steps(log, StepConfig(period=None, most_points=1000, max_range=2.5), drops=drops)
    assert len(steps) == 4
    np.testing.assert_array_equal(np.diff(steps.offsets), [199, 0, 150, 250])
    assert drops.counts["clouds: nearer than 0.1 m"] == 1
    assert drops.counts["clouds: scan without a reading"] == 1
    np.testing.assert_allclose(steps.origins, np.tile(se3.se3_transform(mount, [0.5, 0, 0]), (599, 1)), atol=1e-9)
    kept = steps.returns[199:349]
    ends = se3.se3_transform(mount, points[200:350])
    np.testing.assert_allclose(steps.points[199:349][kept], ends[kept], atol=1e-9)
    far = np.linalg.norm(points[200:350] - [0.5, 0, 0], axis=1) >= 2.5
    np.testing.assert_array_equal(kept, ~far)
    assert 0 < far.sum() < 150
