"""The IMU of LiDAR odometry: motions by readings, what is learned from scans, unbent scans, up, and wrong readings."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.worlds import mesh_world
from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.random import SeedTree
from graphslam.graph.factors.imu.preintegration import preintegrate
from graphslam.io.submap_file import submap_arrays, submap_from_arrays
from graphslam_frontends.lidar_odometry import inertial as inertial_module
from graphslam_frontends.lidar_odometry import odometry as odometry_module
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.front_end import LidarFrontEnd, LidarFrontEndConfig
from graphslam_frontends.lidar_odometry.inertial import (
    FARTHEST,
    ImuReadings,
    InertialMotion,
    align_with_gravity,
    cumulative_products,
    fit_velocity_gravity,
    gravity_along_path,
)
from graphslam_frontends.lidar_odometry.odometry import GYRO_OFF
from graphslam_studies.sim.lidar import LidarConfig, simulate_lidar
from graphslam_studies.trust import ScanWorld
from tests.reference.lidar_start import start_odometry

NOISE = ImuNoise(
    gyro=3e-4,
    gyro_bias=5e-3,
    gyro_walk=1e-4,
    accelerometer=3e-3,
    accelerometer_bias=0.03,
    accelerometer_walk=1e-3,
)
HAND = LidarConfig(rate=4.0, points=2500, lines=32, sway=np.deg2rad(4.0), bob=0.04, sway_time=1.2, imu=NOISE)


def carried(seed, *, most=9.0, **change):
    return simulate_lidar(mesh_world("building", seed=seed), seed, replace(HAND, **change), most=most)


def follow(log, imu):
    clouds = log["clouds"]
    odometry = start_odometry(clouds, LidarOdometryConfig(), imu)
    poses = []
    for k in range(len(clouds)):
        odometry.step(clouds.cloud(k), float(clouds.times[k]), clouds.ages(k))
        poses.append(odometry.pose)
    return np.array(poses), odometry


def errors(poses, log):
    truth = log.truth.trajectory.interpolate(log["clouds"].times)
    return np.asarray(
        se3.se3_log(se3.se3_between(se3.se3_between(truth[:1], truth), se3.se3_between(poses[:1], poses)))
    )


@pytest.fixture(scope="module")
def logs():
    return [carried(seed) for seed in (2, 5, 9)]


@pytest.fixture(scope="module")
def paths(logs):
    return [(log, *follow(log, log["imu"])) for log in logs]


@pytest.fixture(scope="module")
def plain(logs):
    return [follow(log, None) for log in logs]


# --- motions by readings ---------------------------------------------------------------------------------------------


def shaken(rng, n=400, rate=200.0, **more):
    t = np.arange(n) / rate
    w = np.stack([np.sin(3 * t + a) for a in rng.uniform(0, 6, 3)], axis=1)
    f = np.stack([2 * np.cos(5 * t + a) for a in rng.uniform(0, 6, 3)], axis=1) + [0, 0, GRAVITY]
    return Imu(times=t, angular_rate=w, specific_force=f, noise=NOISE, **more)


def test_a_running_product_is_that_of_a_loop(rng):
    turns = se3.so3_exp(rng.normal(size=(13, 3)))
    slow = [np.array([0.0, 0, 0, 1])]
    for q in turns:
        slow.append(se3.quat_multiply(slow[-1], q))
    for fast, one in zip(cumulative_products(turns), slow):
        assert abs(fast @ one) == pytest.approx(1.0, abs=1e-12)


def test_a_way_is_that_of_preintegration(rng):
    imu, bias = shaken(rng), np.array([0.02, -0.01, 0.03])
    begin, ends = 0.1234, np.array([0.3, 0.777, 1.5])
    motion = ImuReadings(imu).motion(begin, ends, bias)
    twin = preintegrate(imu, np.full(3, begin), ends, np.concatenate([bias, np.zeros(3)]))
    np.testing.assert_allclose(se3.quat_to_matrix(motion.q), twin.R, atol=1e-9)
    np.testing.assert_allclose(motion.v, twin.v, atol=2e-5)
    np.testing.assert_allclose(motion.p, twin.p, atol=2e-5)


def test_a_way_backwards_undoes_the_way_there(rng):
    readings, v, g = ImuReadings(shaken(rng)), np.array([1.0, -0.5, 0.2]), np.array([0.3, 0.1, -9.8])
    there = readings.motion(0.4, np.array([0.9]), np.zeros(3))
    T = there.poses(v, g)[0]
    # velocity and gravity as the body has them at the other end
    back = T[3:] * [-1.0, -1.0, -1.0, 1.0]
    v1, g1 = se3.quat_rotate(back, v + 0.5 * g + there.v[0]), se3.quat_rotate(back, g)
    S = readings.motion(0.9, np.array([0.4]), np.zeros(3)).poses(v1, g1)[0]
    np.testing.assert_allclose(se3.se3_log(se3.se3_compose(T, S)), 0.0, atol=1e-9)


def test_readings_of_a_mounted_unit_are_those_of_the_base():
    """A base that turns about its own origin feels gravity alone; a unit beside it feels the turn."""
    nothing = dict.fromkeys(("gyro_bias", "gyro_walk", "accelerometer_bias", "accelerometer_walk"), 0.0)
    log = carried(2, most=3.0, bob=0.0, imu=ImuNoise(gyro=1e-9, accelerometer=1e-9, **nothing))
    readings, truth = ImuReadings(log["imu"]), log.truth.trajectory
    t0, at = 0.6, np.array([1.1, 1.7])
    T0, dt = truth.interpolate(np.array([t0]))[0], 0.005
    v = (truth.interpolate(np.array([t0 + dt]))[0, :3] - truth.interpolate(np.array([t0 - dt]))[0, :3]) / (2 * dt)
    to_body = T0[3:] * [-1.0, -1.0, -1.0, 1.0]
    found = readings.motion(t0, at, np.zeros(3)).poses(
        se3.quat_rotate(to_body, v), se3.quat_rotate(to_body, np.array([0, 0, -GRAVITY]))
    )
    off = se3.se3_log(se3.se3_between(found, se3.se3_between(np.tile(T0, (2, 1)), truth.interpolate(at))))
    assert np.abs(off[:, :3]).max() < 2e-3
    assert np.abs(off[:, 3:]).max() < 3e-3


def test_no_way_over_a_pause_or_beyond_the_readings(rng):
    imu = shaken(rng)
    paused = ImuReadings(imu.take(np.r_[0:100, 160:400]))
    assert paused.motion(0.1, np.array([0.4]), np.zeros(3)) is not None
    assert paused.motion(0.1, np.array([0.9]), np.zeros(3)) is None
    assert ImuReadings(imu).motion(0.1, np.array([2.5]), np.zeros(3)) is None
    assert ImuReadings(imu.take(slice(0, 1))).motion(0.0, np.array([0.0]), np.zeros(3)) is None


def test_velocity_and_gravity_are_those_of_the_positions(rng):
    """Within their covariance, 200 times; it would not hold with one of four times or of a quarter of the size."""
    tau = -np.linspace(0.0, 3.0, 13)
    readings = ImuReadings(shaken(rng))
    variance = readings.doubt(tau, 1e-3)
    motion = InertialMotion(tau, np.tile([0.0, 0, 0, 1], (13, 1)), np.zeros((13, 3)), rng.normal(size=(13, 3)))
    z = []
    for _ in range(200):
        v, g = rng.normal(size=3), rng.normal(0.0, 0.5, size=3) + [0, 0, -GRAVITY]
        p = (
            tau[:, None] * v
            + 0.5 * tau[:, None] ** 2 * g
            + motion.p
            + rng.normal(size=(13, 3)) * np.sqrt(variance)[:, None]
        )
        guess = g + rng.normal(0.0, 1.0, 3)
        found_v, found_g, C = fit_velocity_gravity(motion, p, variance, guess, 1.0)
        e = np.stack([found_v - v, found_g - g])
        z.append(np.einsum("ic,ij,jc->", e, np.linalg.inv(C[1:, 1:]), e) / 6)
    assert 0.85 < np.mean(z) < 1.15


def test_upright_keeps_place_and_heading_and_puts_up_on_z(rng):
    pose = np.concatenate([rng.normal(size=3), se3.so3_exp(rng.normal(size=3))])
    up = se3.quat_rotate(pose[3:], np.array([0.1, -0.3, 0.9]) / np.linalg.norm([0.1, -0.3, 0.9]))
    stood = align_with_gravity(pose, up)
    np.testing.assert_allclose(se3.quat_rotate(stood[3:], np.array([0.0, 0, 1])), up, atol=1e-12)
    np.testing.assert_allclose(stood[:3], pose[:3])
    ahead = se3.quat_rotate(stood[3:] * [-1, -1, -1, 1], se3.quat_rotate(pose[3:], np.array([1.0, 0, 0])))
    assert abs(ahead[1]) < 1e-12  # the body looks along x of the frame that stands
    assert align_with_gravity(pose, None) is pose


# --- along scans -----------------------------------------------------------------------------------------------------


def test_scans_of_a_shaking_hand_are_straight_with_an_imu(paths, plain):
    """Errors from scan to scan are a fraction of those of an even motion, and fewer scans are searched for."""
    for (log, poses, odometry), (alone, _) in zip(paths, plain):
        step = [np.sqrt(np.mean(np.sum(np.diff(errors(p, log), axis=0)[:, :3] ** 2, axis=1))) for p in (poses, alone)]
        assert step[0] < 0.35 * step[1]
        assert np.linalg.norm(errors(poses, log)[:, 3:], axis=1).max() < 0.05
        assert odometry.inertial.believed


def test_scans_that_stay_bent_are_named(logs):
    """Shaken without an IMU: said once. With it, carried steadily, or with scans of a millisecond: not."""

    def named(log):
        submaps = LidarFrontEnd().submaps(log, seed=SeedTree(0))
        return [f["code"] for s in submaps for f in s.report.get("findings", ())].count("uneven-motion")

    def without_imu(log):
        return replace(log, streams={k: v for k, v in log.streams.items() if k != "imu"})

    assert named(without_imu(logs[0])) == 1
    assert named(logs[0]) == 0
    assert named(without_imu(carried(2, sway=0.0, bob=0.0))) == 0
    assert named(without_imu(carried(2, sweep=1e-3))) == 0


def test_bias_velocity_and_gravity_are_learned(paths):
    for log, _, odometry in paths:
        unit, truth = odometry.inertial, log.truth.trajectory
        t = float(log["clouds"].times[-1])
        true = truth.interpolate(np.array([t - 0.01, t, t + 0.01]))
        to_body = true[1, 3:] * [-1.0, -1.0, -1.0, 1.0]
        v = se3.quat_rotate(to_body, (true[2, :3] - true[0, :3]) / 0.02)
        g = se3.quat_rotate(to_body, np.array([0.0, 0, -GRAVITY]))
        assert np.linalg.norm(unit.velocity - v) < 0.08
        assert np.linalg.norm(unit.gravity - g) < 0.25  # the bias of the accelerometer is in it
        # the readings' own bias, by the path
        fine = np.arange(20, len(log["imu"].times) - 20)
        at = log["imu"].times[fine]
        w = se3.so3_log(se3.se3_between(truth.interpolate(at - 0.005), truth.interpolate(at + 0.005))[:, 3:]) / 0.01
        off = np.mean(ImuReadings(log["imu"]).rate[fine] - w, axis=0)
        assert np.linalg.norm(unit.bias - off) < 2.5e-3


def wrong(log, what):
    imu = log["imu"]
    if what == "degrees":
        return replace(imu, angular_rate=np.rad2deg(imu.angular_rate))
    if what == "axes":
        return replace(imu, angular_rate=imu.angular_rate[:, [1, 2, 0]])
    if what == "late":
        return replace(imu, times=imu.times + 0.4)
    if what == "forces":  # in g: where they lead is wrong, and matches are not
        return replace(imu, specific_force=imu.specific_force / GRAVITY)
    return imu.take(np.r_[0:600, 1000 : len(imu.times)])  # a gap of two seconds


@pytest.mark.parametrize("what", ["degrees", "axes", "late", "forces", "gap"])
def test_a_wrong_unit_does_no_harm(logs, plain, what):
    log = logs[0]
    alone = errors(plain[0][0], log)
    poses, odometry = follow(log, wrong(log, what))
    off = errors(poses, log)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 1.2 * np.linalg.norm(alone[:, 3:], axis=1).max() + 0.01
    assert odometry.inertial.believed == (what in ("forces", "gap"))


def test_a_wrong_unit_is_a_line_of_the_report(logs):
    log = logs[0].slice(0.0, 4.0)
    spoilt = replace(log, streams={**log.streams, "imu": wrong(log, "axes")})
    submaps = list(LidarFrontEnd().submaps(spoilt, seed=SeedTree(0)))
    codes = [f["code"] for s in submaps for f in s.report.get("findings", ())]
    assert codes.count("imu-left-aside") == len(submaps)
    assert all(s.assisting_streams == frozenset() for s in submaps)


def test_covariances_say_nothing_of_what_the_unit_tells(paths, plain):
    """What is expected of a motion is as wide as without an IMU: a graph may count the readings."""
    odometry, alone = paths[0][2], plain[0][1]
    assert np.all(np.diag(odometry.spread) > 0.2 * np.diag(alone.spread))
    own = odometry.inertial.missed
    assert np.mean(own, axis=0)[0] < 0.02 * odometry.spread[0, 0]  # what it misses is far less


@pytest.fixture(scope="module")
def submaps(logs):
    return list(LidarFrontEnd().submaps(logs[0], seed=SeedTree(0)))


def test_submaps_stand_upright_and_name_what_helped(logs, submaps):
    log = logs[0]
    assert len(submaps) > 1
    for a in submaps:
        assert a.uses == {"clouds"}
        assert a.assisting_streams == {"imu"}
        assert a.report["scans_aided"] > 0.9 * a.report["scans"]
        arrays = {name: np.asarray(value) for name, value in submap_arrays(a).items()}
        assert submap_from_arrays(arrays, where="x").assisting_streams == {"imu"}
    first = submaps[0]
    truth = log.truth.trajectory.interpolate(np.array([first.interval[0]]))[0]
    T_world_base = se3.se3_compose(truth, se3.se3_inverse(first.trajectory.poses[0]))
    assert np.arccos(se3.quat_rotate(T_world_base[3:], np.array([0.0, 0, 1]))[2]) < 0.015
    assert abs(se3.roll_pitch_jacobian(truth[None])[0]).max() > 0.03  # which the body does not
    plain = list(LidarFrontEnd(LidarFrontEndConfig(imu="none")).submaps(log, seed=SeedTree(0)))
    assert plain[0].assisting_streams == frozenset()
    np.testing.assert_array_equal(plain[0].trajectory.poses[0], [0, 0, 0, 0, 0, 0, 1])


def test_resumed_submaps_are_the_same(logs, submaps):
    rest = list(LidarFrontEnd().submaps(logs[0], seed=SeedTree(0), after=submaps[0]))
    for a, b in zip(rest, submaps[1:], strict=True):
        assert a.exit_pose.tobytes() == b.exit_pose.tobytes()
        assert a.cloud.points.tobytes() == b.cloud.points.tobytes()
    for a, b in pairwise(submaps):
        assert a.interval[1] == b.interval[0]


def test_gravity_along_the_path_is_as_sure_as_it_says(paths):
    """Roll and pitch of three lidars; two-sided bounds: errors fade within seconds, and the bias is shared."""
    z = []
    for log, poses, odometry in paths:
        times = log["clouds"].times
        tilt = gravity_along_path(odometry.inertial, times, poses)
        true, _ = se3.roll_pitch_jacobian(log.truth.trajectory.interpolate(times))
        off = tilt.at(times, poses) - true
        z.append(np.mean((off / tilt.sigma) ** 2))
        assert np.abs(off).max() < 0.03
        assert np.ptp(true) > 0.1
    assert 0.1 < np.mean(z) < 2.5


def test_a_stream_that_is_no_imu_is_refused(logs):
    with pytest.raises(ConfigError, match=r"frontend\.imu"):
        list(LidarFrontEnd(LidarFrontEndConfig(imu="clouds")).submaps(logs[0], seed=SeedTree(0)))


def test_a_run_has_its_map_upright_and_its_graph_counts_the_readings(logs):
    options = {"imu": {"use": "auto"}, "map": {"fuse": False}, "refine": {"use": "always"}}
    run = gs.run(logs[0], frontend="lidar-odometry", config=options, progress=False)
    kinds = set(zip(run.graph.ledger.table()["stream"], run.graph.ledger.table()["kind"]))
    assert {("imu", "aid"), ("imu", "measurement"), ("clouds", "measurement")} <= kinds
    value = run.metrics.set_index("key")["value"]
    assert value["imu_chi2_per_dof"] < 2.5
    assert value["path_rmse_aligned"] < 0.02
    truth = log_up(logs[0].truth.trajectory.interpolate(run.map.trajectory.times))
    assert np.linalg.norm(log_up(run.map.trajectory.poses) - truth, axis=1).mean() < 0.01
    spent = next(f["text"] for f in run.report["verdict"]["lines"] if f["code"] == "refine-evidence")
    assert "clouds, imu — each used once" in spent


def log_up(poses):
    return se3.quat_to_matrix(poses[:, 3:])[:, 2]


class Begun:
    """Clouds that are stamped when their scans begin, as many drivers do."""

    def __init__(self, source, late):
        self.source, self.late, self.counts = source, late, source.counts

    def cloud(self, k):
        return self.source.cloud(k)

    def ages(self, k):
        return self.source.ages(k) - self.late[k]

    def packed(self):
        return self.source.packed()


def test_scans_may_be_stamped_when_they_begin(paths):
    log, _, odometry = paths[0]
    assert odometry.inertial.unsure(-0.05) == odometry.inertial.unsure(0.05)
    clouds = log["clouds"]
    late = np.array([clouds.source.ages(k).max() for k in range(len(clouds.source.counts))])
    begun = replace(clouds, times=clouds.times - late[clouds.index], source=Begun(clouds.source, late))
    some = np.arange(len(clouds.times)) < 60
    short = replace(log, streams={**log.streams, "clouds": begun.take(some)}, truth=None)
    made = list(LidarFrontEnd().submaps(short, seed=SeedTree(0)))
    assert made
    assert all(s.report["scans_lost"] == 0 for s in made)
    for s in made:
        assert np.linalg.eigvalsh(s.trajectory.covariances[1:]).min() > 0


@pytest.mark.parametrize(("limit", "fooled"), [(GYRO_OFF, False), (10.0, True)])
def test_a_place_that_looks_alike_when_turned_is_refused_by_the_gyro(monkeypatch, limit, fooled):
    """Rooms look alike when turned by a right angle: the search once turned this path by 90° against its own gyro."""
    monkeypatch.setattr(odometry_module, "GYRO_OFF", limit)
    monkeypatch.setattr(inertial_module, "FARTHEST", 1e6)  # or its place would be refused
    monkeypatch.setattr(odometry_module, "LED_AWAY", np.inf)  # or the finest cells would refuse it
    log = ScanWorld(kind="lidar", number=91, seconds=70.0).log(7)
    path, _ = follow(log, log["imu"])
    assert (float(np.abs(errors(path, log)[:, :3]).max()) > 1.0) == fooled


@pytest.mark.parametrize(("limit", "fooled"), [(FARTHEST, False), (1e6, True)])
def test_a_match_that_slides_along_a_wall_is_held_by_the_imu(monkeypatch, limit, fooled):
    """Walls that hold a scan barely more than noise of their normals once moved this path by metres, scan by scan."""
    monkeypatch.setattr(inertial_module, "FARTHEST", limit)
    log = ScanWorld(kind="lidar", number=10, seconds=82.0).log(1)
    path, _ = follow(log, log["imu"])
    assert (float(np.abs(errors(path, log)[:, 3:]).max()) > 0.8) == fooled
