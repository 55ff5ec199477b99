"""The mixed world: its records agree with its truth, and their noise is the stated one, from both sides."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import graphslam as gs
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import se2_between, se2_compose, se2_log, se2_transform, wrap_angle
from graphslam.core.imu import GRAVITY
from graphslam.core.log import SensorLog
from graphslam.sim.mixed import MixedConfig, mixed_place, mixed_preset, simulate_mixed
from tests.sim.normality import assert_normal

SEED = 3


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("mixed", seed=SEED, preset="quick")


@pytest.fixture(scope="module")
def exact() -> SensorLog:
    return gs.simulate("mixed", seed=SEED, preset="quick", noise_scale=0.0)


def at(log: SensorLog, times: np.ndarray) -> np.ndarray:
    """True poses ``(n, 3)`` at stamps of the truth."""
    path = log.truth.trajectory
    rows = np.searchsorted(path.times, times - 1e-9)
    assert np.allclose(path.times[rows], times, atol=1e-9)
    return path.poses[rows]


def seen(log: SensorLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals of range [m] and bearing [rad] of every observation against the truth, and its tree."""
    obs = log["landmarks"]
    poses = at(log, np.repeat(obs.times, np.diff(obs.offsets)))
    step = log.truth.landmarks[obs.ids] - poses[:, :2]
    bearing = np.arctan2(step[:, 1], step[:, 0]) - poses[:, 2]
    return obs.ranges - np.hypot(*step.T), wrap_angle(obs.bearings - bearing), obs.ids


def test_same_seed_same_bytes_and_another_seed_another_world(log: SensorLog) -> None:
    again = gs.simulate("mixed", seed=SEED, preset="quick")
    for name in log.streams:
        assert log[name].times.tobytes() == again[name].times.tobytes()
    assert log["laser"].ranges.tobytes() == again["laser"].ranges.tobytes()
    assert log["imu"].angular_rate.tobytes() == again["imu"].angular_rate.tobytes()
    assert log["wheels"].increments.tobytes() == again["wheels"].increments.tobytes()
    other = gs.simulate("mixed", seed=SEED + 1, preset="quick")
    assert other.meta["noise"] != log.meta["noise"]
    assert other.truth.landmarks.shape != log.truth.landmarks.shape or not np.allclose(
        other.truth.landmarks, log.truth.landmarks
    )
    # the layout's own seed holds the place, with other noise
    moved = simulate_mixed(mixed_preset("quick", layout_seed=SEED), SEED + 1)
    assert np.array_equal(moved.truth.landmarks, log.truth.landmarks)
    assert not np.array_equal(moved["wheels"].increments, log["wheels"].increments)


def test_twenty_seeds_are_twenty_places_with_loops_inside_and_outside() -> None:
    for seed in range(20):
        config = MixedConfig()
        place = mixed_place(config, seed)
        assert 250.0 < place.route.length < 500.0
        s = place.route.every(0.5)
        points = place.route.positions(s)[:, :2]
        inside = place.outside_by(points) == 0.0
        assert np.sum(np.diff(inside.astype(int)) == 1) == config.laps
        assert np.sum(np.diff(inside.astype(int)) == -1) == config.laps
        assert 0.2 < inside.mean() < 0.7
        # trees are in the park alone, off the route; nothing stands on the route
        assert len(place.trees) > 40
        assert place.outside_by(place.trees[:, :2]).min() > 3.0
        apart = np.linalg.norm(points[:, None] - place.trees[:, :2], axis=2) - place.trees[:, 2]
        assert apart.min() > 1.2
        path = np.column_stack([points, np.full(len(points), 0.5)])
        assert place.caster.distances(path).min() > 0.3


def test_records_without_noise_are_the_truth(exact: SensorLog) -> None:
    wheels, imu, gps, laser = (exact[n] for n in ("wheels", "imu", "gps", "laser"))
    pose = np.zeros(3)
    for step in wheels.increments:
        pose = se2_compose(pose, step)
    assert np.allclose(pose, at(exact, wheels.times[-1:])[0], atol=1e-9)

    # a level unit: turned and moved by it from rest, the robot stays on the true path
    path = exact.truth.trajectory
    dt = np.diff(imu.times)
    turned = np.concatenate([[0.0], np.cumsum(0.5 * dt * (imu.angular_rate[1:, 2] + imu.angular_rate[:-1, 2]))])
    assert np.abs(wrap_angle(turned - path.poses[:, 2])).max() < 2e-3
    c, s = np.cos(turned), np.sin(turned)
    f = imu.specific_force
    world = np.column_stack([c * f[:, 0] - s * f[:, 1], s * f[:, 0] + c * f[:, 1]])
    speed = np.vstack([np.zeros(2), np.cumsum(0.5 * dt[:, None] * (world[1:] + world[:-1]), axis=0)])
    moved = np.vstack([np.zeros(2), np.cumsum(0.5 * dt[:, None] * (speed[1:] + speed[:-1]), axis=0)])
    assert np.abs(moved - path.poses[:, :2]).max() < 0.5
    assert np.allclose(f[:, 2], GRAVITY, atol=1e-6)
    assert np.allclose(imu.angular_rate[:, :2], 0.0, atol=1e-9)
    assert imu.attitude is None

    antenna = se2_transform(at(exact, gps.times), np.broadcast_to(gps.lever, gps.positions.shape))
    assert np.allclose(gps.positions, se2_transform(np.array(exact.meta["datum"]), antenna), atol=1e-9)
    for begin, end in exact.meta["indoor"]:
        assert not np.any((gps.times >= begin) & (gps.times <= end))

    ranges, bearings, ids = seen(exact)
    assert ids.min() >= 0
    assert np.abs(ranges).max() < 1e-9
    assert np.abs(bearings).max() < 1e-9

    # trunks are where the landmarks are: some beams end on the bark of one, and none inside of it
    poses = at(exact, laser.times)[:, None]
    angle = poses[..., 2] + laser.bearings
    hit = np.isfinite(laser.ranges) & (laser.ranges < laser.max_range)
    ends = (poses[..., :2] + laser.ranges[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1))[hit]
    off = np.linalg.norm(ends[:, None] - exact.truth.landmarks, axis=2) - exact.meta["radii"]
    nearest = off.min(axis=1)
    assert nearest.min() > -0.01  # the trunk is a prism of twelve sides
    assert np.sum(nearest < 0.01) > 1000
    assert np.sum(nearest > 1.0) > 10000


def test_noise_of_every_stream_is_the_stated_one(log: SensorLog, exact: SensorLog) -> None:
    noise = log.meta["noise"]
    wheels = log["wheels"]
    poses = at(log, wheels.times)
    off = se2_log(se2_between(se2_between(poses[:-1], poses[1:]), wheels.increments[1:]))
    sigma = np.sqrt(np.diagonal(wheels.covariances[1:], axis1=1, axis2=2))
    for k, name in enumerate(("along", "across", "heading")):
        assert_normal(off[:, k] / sigma[:, k], 1.0, f"wheels, {name}")

    gps = log["gps"]
    antenna = se2_transform(at(log, gps.times), np.broadcast_to(gps.lever, gps.positions.shape))
    fixes = gps.positions - se2_transform(np.array(log.meta["datum"]), antenna)
    assert_normal((fixes / gps.sigma[:, None]).ravel(), 1.0, "gps")

    ranges, bearings, _ = seen(log)
    sigmas = log["landmarks"].sigmas
    assert_normal(ranges / sigmas[:, 0], 1.0, "range of a tree")
    assert_normal(bearings / sigmas[:, 1], 1.0, "bearing of a tree")

    a, b = log["laser"], exact["laser"]
    both = np.isfinite(a.ranges) & np.isfinite(b.ranges) & (b.ranges < 0.9 * b.max_range) & (a.ranges < a.max_range)
    assert_normal((a.ranges - b.ranges)[both].astype(float), noise["laser"], "laser")

    # increments of the IMU's error: white noise twice, and one step of the walk of its bias
    imu, rate = log["imu"], 1.0 / float(np.median(np.diff(log["imu"].times)))
    for name, kind in (("gyro", "angular_rate"), ("accelerometer", "specific_force")):
        error = getattr(imu, kind) - getattr(exact["imu"], kind) - log.meta["drawn"][f"{name}_bias"]
        step = error[1::2][: len(error) // 2] - error[0::2][: len(error) // 2]
        sigma = math.sqrt(2.0 * noise[name] ** 2 * rate + noise[f"{name}_walk"] ** 2 / rate)
        assert_normal(step.ravel(), sigma, name)
        # a mean over ten seconds shows the bias as far as the walk and the white noise let it
        short = error[: int(10 * rate)].mean(axis=0)
        bound = 4.5 * math.sqrt(noise[name] ** 2 / 10.0 + noise[f"{name}_walk"] ** 2 * 10.0 / 3.0)
        assert np.abs(short).max() < bound


def test_the_two_sensors_of_a_tree_have_errors_of_their_own(log: SensorLog, exact: SensorLog) -> None:
    obs = log["landmarks"]
    ranges, _, _ = seen(log)
    laser, clean = log["laser"], exact["laser"]
    scans = np.searchsorted(laser.times, np.repeat(obs.times, np.diff(obs.offsets)) - 1e-9)
    beam = np.clip(np.searchsorted(laser.bearings, obs.bearings), 0, len(laser.bearings) - 1)
    error = laser.ranges[scans, beam] - clean.ranges[scans, beam]
    bark = np.abs(laser.ranges[scans, beam] - obs.ranges) < 1.0
    ok = bark & np.isfinite(error) & (np.abs(error) < 0.3)
    assert ok.sum() > 300
    r = np.corrcoef(error[ok], ranges[ok])[0, 1]
    assert abs(r) < stats.norm.ppf(1 - 5e-5) / math.sqrt(ok.sum())


@pytest.mark.parametrize("frontend", ["rbpf-ekf", "segslam"])
def test_either_front_end_maps_it_with_a_consistent_path(log: SensorLog, frontend: str) -> None:
    run = gs.run(log, frontend=frontend, seed=0)
    own, other = ("landmarks", "laser") if frontend == "rbpf-ekf" else ("laser", "landmarks")
    streams = next(f.text for f in run.verdict if f.code == "streams")
    assert f"{own} {len(log[own].times)} of" in streams
    assert f"{other} 0 of" in streams
    assert run.metric("pose_rmse") < 0.4
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], run.metric("nees_dof"))
    assert low < run.metric("nees") < high
    if frontend == "rbpf-ekf":
        assert run.metric("association_pair_precision") == 1.0
        assert run.metric("association_pair_recall") > 0.95
    else:
        assert run.metric("loops_loops") > 3


def test_bad_figures_are_refused() -> None:
    with pytest.raises(ConfigError, match="laser_rate"):
        MixedConfig(laser_rate=3.0)
    with pytest.raises(ConfigError, match="unknown parameter 'beam'"):
        mixed_preset(beam=3)
    with pytest.raises(UnknownNameError, match="tiny"):
        mixed_preset("tiny")
    with pytest.raises(ConfigError, match="length"):
        replace(MixedConfig(), length=(5.0, 6.0))
