"""The crawler's sensors: exact without noise, and with the noise they state."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.imu import GRAVITY
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.se3 import quat_multiply, quat_rotate, se3_between, se3_compose, se3_transform, so3_exp, so3_log
from graphslam.sim.crawler import crawler_motion, crawler_preset, simulate_crawler, start_frame
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.crawler_sensors import (
    end_error,
    measure_imu,
    measure_wheels,
    ornstein_uhlenbeck,
    roll_pitch_angles,
    yaw_bias_for,
)
from graphslam.sim.drive import RouteMotion, drive_motion
from graphslam.sim.raycast import RayCaster
from tests.reference.plain_mesh import hall

EXACT = CrawlerConfig(noise_scale=0.0, drop_out=0.0, imu_rate=200.0)
# the unit sits off the base and askew
ASKEW = (0.2, -0.1, 0.4, *(float(v) for v in so3_exp(np.array([0.3, -0.2, 2.0]))))


@pytest.fixture(scope="module")
def exact() -> SensorLog:
    return simulate_crawler(hall(), 0, dataclasses.replace(EXACT, scanners=2, imu_mount=ASKEW))


@pytest.fixture(scope="module")
def noisy() -> SensorLog:
    return simulate_crawler(hall(), 0)


@pytest.fixture(scope="module")
def motion() -> RouteMotion:
    return crawler_motion(hall())


def chi2_bounds(dof: int) -> tuple[float, float]:
    """Four σ of an estimated variance relative to the true one."""
    return 1.0 - 4.0 * np.sqrt(2.0 / dof), 1.0 + 4.0 * np.sqrt(2.0 / dof)


def placed(log: SensorLog, name: str, lag: float | None = None) -> np.ndarray:
    """Returns in the world at the true pose of each beam's time, or of ``lag`` after the scan's stamp."""
    s = log[name]
    origin, directions = s.head_rays()
    offsets = s.beam_times if lag is None else np.full_like(s.beam_times, lag)
    times = (s.times[:, None] + offsets)[: len(s.times) - 1]
    poses = log.truth.trajectory.interpolate(times.ravel())
    poses = se3_compose(np.broadcast_to(log.meta["T_world_frame"], poses.shape), poses)
    points = origin + directions[:-1] * s.ranges[:-1, :, None]
    return se3_transform(poses, points.reshape(-1, 3)).reshape(points.shape)


@pytest.mark.parametrize("name", ["scanner", "scanner2"])
def test_exact_beams_end_on_the_mesh_at_the_pose_of_their_own_time(exact: SensorLog, name: str) -> None:
    caster = RayCaster.of(hall())
    assert np.all(np.isfinite(exact[name].ranges))  # the hall is closed
    off = caster.distances(placed(exact, name).reshape(-1, 3))
    assert off.max() < 1e-3
    late = caster.distances(placed(exact, name, lag=0.0).reshape(-1, 3))
    assert late.max() > 0.03  # without the beams' own times the walls are that thick


def test_the_head_spins_and_the_second_scanner_looks_back(exact: SensorLog) -> None:
    for name, ahead in (("scanner", 1.0), ("scanner2", -1.0)):
        origin, d = exact[name].head_rays()
        assert np.all(ahead * d[..., 0] > -1e-9)  # half a sphere each
        assert ahead * origin[0] > 0
        outer = d[:, -1]  # the last beam lies across: it goes round once in four seconds
        np.testing.assert_allclose(outer[: len(outer) - 50], outer[50:], atol=1e-9)
        np.testing.assert_allclose(outer[: len(outer) - 25], -outer[25:], atol=0.06)
        assert np.ptp(outer[:, 2]) > 1.9


def test_truth_begins_level_at_the_origin_and_follows_the_world(exact: SensorLog) -> None:
    path = exact.truth.trajectory
    np.testing.assert_allclose(path.poses[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
    frame = np.array(exact.meta["T_world_frame"])
    motion = crawler_motion(hall(), EXACT)
    np.testing.assert_allclose(frame, start_frame(motion), atol=1e-12)
    t = path.times
    np.testing.assert_allclose(se3_transform(frame, path.positions), motion.poses(t)[:, :3], atol=1e-9)
    np.testing.assert_allclose(np.diff(t), 1.0 / 200.0)
    turned = dataclasses.replace(hall(), waypoints=hall().waypoints[::-1])
    other = simulate_crawler(turned, 0, EXACT)
    np.testing.assert_allclose(other.truth.trajectory.poses[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
    # starting on a slope the frame is level, and the base is not
    slope = simulate_crawler(hall([[7, 0, 0.125], [10, 0, 0.5], [14, 0, 0.5]]), 0, EXACT)
    first = slope.truth.trajectory.poses[0]
    np.testing.assert_allclose(roll_pitch_angles(first[None, 3:])[0], [0.0, -np.arctan(0.125)], atol=1e-6)


def test_exact_inertia_integrates_to_the_truth(exact: SensorLog) -> None:
    """A plain strapdown with the middle of each step: rates give the attitude, forces and gravity the way."""
    imu, truth = exact["imu"], exact.truth.trajectory
    unit = se3_compose(truth.poses, np.broadcast_to(imu.T_base_imu, truth.poses.shape))  # T_frame_imu, true
    q, p, v = unit[0, 3:], unit[0, :3], np.zeros(3)
    path = [unit[0]]
    for k in range(len(imu.times) - 1):
        dt = imu.times[k + 1] - imu.times[k]
        q_next = quat_multiply(q, so3_exp(0.5 * dt * (imu.angular_rate[k] + imu.angular_rate[k + 1])))
        a = 0.5 * (quat_rotate(q, imu.specific_force[k]) + quat_rotate(q_next, imu.specific_force[k + 1]))
        a = a - [0.0, 0.0, GRAVITY]
        p, v, q = p + dt * v + 0.5 * dt**2 * a, v + dt * a, q_next
        path.append(np.concatenate([p, q]))
    error = np.array(path)[:, :3] - unit[:, :3]
    assert np.abs(error).max() < 5e-3
    assert np.abs(so3_log(se3_between(unit, np.array(path))[:, 3:])).max() < 2e-5
    assert truth.length() > 25
    np.testing.assert_allclose(imu.attitude, roll_pitch_angles(unit[:, 3:]), atol=1e-9)
    assert np.ptp(imu.attitude, axis=0).min() > 0.1  # askew on a ramp and in turns: both change


def test_exact_wheels_give_the_length_and_the_turn(exact: SensorLog) -> None:
    wheels, truth = exact["wheels"], exact.truth.trajectory
    dt = np.append(np.diff(wheels.times), 0.0)
    assert np.sum(wheels.speed * dt) == pytest.approx(truth.length(), abs=2e-3)
    yaw = np.arctan2(*truth.poses[-1, [5, 6]]) * 2.0
    assert abs(np.sum(wheels.yaw_rate * dt) - yaw) % (2 * np.pi) == pytest.approx(0.0, abs=0.02)  # ramps are shallow


def test_a_robot_at_rest() -> None:
    log = simulate_crawler(hall(), 0, dataclasses.replace(EXACT, stand=9.0))
    imu, wheels, scans = (log[k].take(log[k].times < 9.0 - 1.0 / 75.0) for k in ("imu", "wheels", "scanner"))
    np.testing.assert_allclose(imu.angular_rate, 0.0, atol=1e-12)
    np.testing.assert_allclose(imu.specific_force, np.tile([0, 0, GRAVITY], (len(imu.times), 1)), atol=1e-9)
    np.testing.assert_allclose(imu.attitude, 0.0, atol=1e-9)
    np.testing.assert_array_equal(wheels.speed[:-1], 0.0)
    # one turn of the head later, 50 scans, all looks the same
    assert np.median(np.abs(scans.ranges[:-50] - scans.ranges[50:])) < 1e-5
    assert np.median(np.abs(scans.ranges[:-10] - scans.ranges[10:])) > 0.05


def test_ranges_have_the_stated_noise_and_drop_outs(noisy: SensorLog) -> None:
    config = CrawlerConfig()
    clean = simulate_crawler(hall(), 0, dataclasses.replace(config, noise_scale=0.0, drop_out=0.0))["scanner"].ranges
    got = noisy["scanner"].ranges
    lost = np.isnan(got)
    n = lost.size
    assert abs(lost.mean() - 0.005) < 4.0 * np.sqrt(0.005 * 0.995 / n)
    e = (got - clean)[~lost]
    assert abs(e.mean()) < 4.0 * 0.025 / np.sqrt(len(e))
    low, high = chi2_bounds(len(e))
    assert low < np.mean((e / 0.025) ** 2) < high
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 4.0 / np.sqrt(len(e))
    assert noisy["scanner"].sigma == 0.025


def test_what_is_too_far_or_too_near() -> None:
    config = dataclasses.replace(EXACT, max_range=6.1, min_range=1.0, imu_rate=50.0)
    full = simulate_crawler(hall(), 0, dataclasses.replace(EXACT, imu_rate=50.0))["scanner"].ranges
    scans = simulate_crawler(hall(), 0, config)["scanner"]
    near, far = full < 1.0, full >= np.float32(6.1)
    assert 0.01 < near.mean() < 0.9
    assert 0.01 < far.mean() < 0.9
    np.testing.assert_array_equal(np.isnan(scans.ranges), near)
    np.testing.assert_array_equal(scans.ranges >= scans.max_range, far)  # 6.1 is no float32
    keep = ~near & ~far
    np.testing.assert_array_equal(scans.ranges[keep], full[keep])
    blurred = simulate_crawler(hall(), 0, dataclasses.replace(config, noise_scale=1.0))["scanner"].ranges
    assert np.nanmax(blurred) == scans.ranges.max(where=far, initial=0.0)  # noise makes nothing farther than too far
    open_air = dataclasses.replace(hall(), vertices=[[0, 0, -0.1], [1, 0, -0.1], [0, 1, -0.1]], triangles=[[0, 1, 2]])
    nothing = simulate_crawler(open_air, 0, config)["scanner"]
    assert np.mean(nothing.ranges >= nothing.max_range) > 0.9
    assert not np.any(np.isinf(nothing.ranges))


def imu_errors(motion: RouteMotion, seed: int, **changes: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict]:
    """Errors of rates, forces and attitude of one log."""
    config = dataclasses.replace(CrawlerConfig(), **changes)
    none = dataclasses.replace(config, noise_scale=0.0)
    imu, drawn = measure_imu(motion, config, 1e-3, 1e-3, SeedTree(seed))
    true, _ = measure_imu(motion, none, 1e-3, 1e-3, SeedTree(seed))
    return (
        imu,
        imu.angular_rate - true.angular_rate,
        imu.specific_force - true.specific_force,
        imu.attitude - true.attitude,
        drawn,
    )


def test_inertia_has_the_stated_white_noise_and_bias(motion: RouteMotion) -> None:
    imu, rate, force, _, drawn = imu_errors(motion, 3, gyro_walk=0.0, accelerometer_walk=0.0)
    for errors, density, bias in ((rate, 1e-4, drawn["gyro_bias"]), (force, 2e-3, drawn["accelerometer_bias"])):
        white = (errors - bias) / (density * np.sqrt(100.0))
        low, high = chi2_bounds(white.size)
        assert low < np.mean(white**2) < high
        assert np.abs(white.mean(axis=0)).max() < 4.5 / np.sqrt(len(white))
        assert abs(np.corrcoef(white[1:, 0], white[:-1, 0])[0, 1]) < 4.0 / np.sqrt(len(white))
    assert drawn["gyro_bias"][2] == 1e-3
    assert imu.noise.gyro == 1e-4
    assert imu.noise.accelerometer == 2e-3


def test_constants_are_drawn_with_their_stated_sigma(motion: RouteMotion) -> None:
    drawn = [measure_imu(motion, CrawlerConfig(imu_rate=5.0), 1e-3, 1e-3, SeedTree(s))[1] for s in range(300)]
    for name, sigma, axes in (
        ("gyro_bias", 2e-4, slice(0, 2)),
        ("accelerometer_bias", 0.02, slice(None)),
        ("attitude_bias", np.radians(0.1), slice(None)),
    ):
        values = np.array([d[name][axes] for d in drawn]) / sigma
        low, high = chi2_bounds(values.size)
        assert low < np.mean(values**2) < high
    scales = np.array(
        [dataclasses.astuple(measure_wheels(motion, CrawlerConfig(wheel_rate=1.0), SeedTree(s))[1]) for s in range(300)]
    )
    low, high = chi2_bounds(300)
    for values, sigma in ((scales[:, 0], 0.005), (scales[:, 1], 0.05)):
        assert low < np.mean((values / sigma) ** 2) < high


def test_biases_walk_as_stated(motion: RouteMotion) -> None:
    walked = []
    for seed in range(60):
        changes = {"imu_rate": 10.0, "gyro": 0.0, "accelerometer": 0.0, "gyro_walk": 1e-4, "accelerometer_walk": 0.01}
        imu, rate, force, _, drawn = imu_errors(motion, seed, **changes)
        np.testing.assert_allclose(rate[0], drawn["gyro_bias"], atol=1e-12)  # it begins at the constant
        root = np.sqrt(imu.times[-1])
        walked.append(np.concatenate([(rate[-1] - rate[0]) / 1e-4, (force[-1] - force[0]) / 0.01]) / root)
    low, high = chi2_bounds(180)
    for axes in (slice(0, 3), slice(3, 6)):
        assert low < np.mean(np.array(walked)[:, axes] ** 2) < high


def test_attitude_errors_stay_alike_for_the_stated_time(rng: np.random.Generator) -> None:
    sigma, time, dt = 0.004, 5.0, 0.1
    e = ornstein_uhlenbeck(rng, (400, 4000), sigma, time, dt)
    low, high = chi2_bounds(4000)
    for k in (0, 1, 50, 399):  # stationary from the first record on
        assert low < np.mean(e[k] ** 2) / sigma**2 < high
    for lag in (1, 50, 200):
        alike = np.mean(e[:-lag] * e[lag:]) / sigma**2
        assert alike == pytest.approx(np.exp(-lag * dt / time), abs=0.02)


def test_attitude_of_the_log(motion: RouteMotion) -> None:
    values = np.concatenate([imu_errors(motion, s, imu_rate=2.0)[3][::40] for s in range(150)])
    stated = imu_errors(motion, 0, imu_rate=2.0)[0].noise
    assert stated.attitude == pytest.approx(np.radians(np.hypot(0.25, 0.1)))
    assert stated.attitude_time == 5.0
    assert np.sqrt(np.mean(values**2)) == pytest.approx(stated.attitude, rel=0.1)


def test_wheels_have_the_stated_noise(motion: RouteMotion) -> None:
    config = CrawlerConfig()
    none = dataclasses.replace(config, noise_scale=0.0)
    got, scale = measure_wheels(motion, config, SeedTree(7))
    true, _ = measure_wheels(motion, none, SeedTree(7))
    moving = np.abs(true.speed) > 1e-6
    for g, t, s, sigma in (
        (got.speed, true.speed, scale.speed, 0.02),
        (got.yaw_rate, true.yaw_rate, scale.turn, 0.02),
    ):
        e = ((g - (1.0 + s) * t) / sigma)[moving]
        low, high = chi2_bounds(len(e))
        assert low < np.mean(e**2) < high
        assert abs(e.mean()) < 4.0 / np.sqrt(len(e))
    assert np.sum(moving) > 900


def test_the_yaw_bias_brings_about_the_wanted_drift() -> None:
    motion = drive_motion(hall())
    for sign in (1.0, -1.0):
        bias = yaw_bias_for(motion, 1.0, sign, 0.1)
        assert np.sign(bias) == sign
        assert end_error(motion, bias) == pytest.approx(1.0, abs=1e-6)
        # by driving with the wrong heading
        t = np.linspace(0.0, motion.duration, 20001)
        moved, turned = np.diff(motion.poses(t)[:, :2], axis=0), bias * 0.5 * (t[1:] + t[:-1])
        c, s = np.cos(turned), np.sin(turned)
        wrong = np.column_stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]])
        assert np.linalg.norm(wrong.sum(axis=0) - moved.sum(axis=0)) == pytest.approx(1.0, abs=1e-3)
    assert yaw_bias_for(motion, 0.0, 1.0, 0.1) == 0.0
    assert abs(yaw_bias_for(motion, 1e6, 1.0, 0.002)) <= 0.002  # out of reach: what the limit allows


def test_drift_of_logs() -> None:
    """Sign and size change from seed to seed; dead reckoning with the recorded yaw rate ends that far off."""
    config = CrawlerConfig(scan_rate=0.5, imu_rate=50.0, drift=0.1, most_turned=9.0)
    logs = [simulate_crawler(hall(), s, config) for s in range(12)]
    ends = np.array([log.meta["drawn"]["end_error_of_yaw_bias"] for log in logs])
    biases = np.array([log.meta["drawn"]["gyro_bias"][2] for log in logs])
    length = logs[0].meta["length"]
    assert 0.8 * 0.1 * length <= ends.min() < ends.max() <= 1.2 * 0.1 * length
    assert ends.std() > 0.04 * 0.1 * length
    assert {-1.0, 1.0} == set(np.sign(biases))
    assert np.abs(biases).mean() == pytest.approx(logs[0]["imu"].noise.gyro_bias, rel=0.2)
    hidden = simulate_crawler(hall(), 0, dataclasses.replace(config, drift=1.0, most_turned=0.5))
    turned = abs(hidden.meta["drawn"]["gyro_bias"][2]) * hidden.meta["duration"]
    assert 0.4 <= turned <= 0.6  # out of reach: the limit of the heading holds
    for log, end in zip(logs[:4], ends):
        imu, wheels = log["imu"], log["wheels"]
        roll, pitch = imu.attitude.T
        turning = (imu.angular_rate[:, 1] * np.sin(roll) + imu.angular_rate[:, 2] * np.cos(roll)) / np.cos(pitch)
        yaw = np.cumsum(turning) / 50.0
        k = np.searchsorted(wheels.times, imu.times, side="right") - 1
        path = np.cumsum(
            np.column_stack([np.cos(yaw), np.sin(yaw)]) * (wheels.speed[k] * np.cos(pitch) / 50.0)[:, None], 0
        )
        miss = np.linalg.norm(path[-1] - log.truth.trajectory.positions[-1, :2])
        assert miss == pytest.approx(end, abs=0.35)


def arrays(stream: Any) -> list[bytes]:
    return [a.tobytes() for f in dataclasses.fields(stream) if isinstance(a := getattr(stream, f.name), np.ndarray)]


def test_seeds(noisy: SensorLog) -> None:
    again, other = simulate_crawler(hall(), 0), simulate_crawler(hall(), 1)
    two = simulate_crawler(hall(), 0, crawler_preset("two-scanners"))
    for name in ("scanner", "imu", "wheels"):
        assert arrays(noisy[name]) == arrays(again[name])
        assert arrays(noisy[name]) == arrays(two[name])  # a further sensor changes nothing in the others
        assert arrays(noisy[name]) != arrays(other[name])
    assert json.dumps(noisy.meta) == json.dumps(again.meta)
    clean = simulate_crawler(hall(), 0, crawler_preset("two-scanners", noise_scale=0.0, drop_out=0.0))
    a, b = (two[name].ranges - clean[name].ranges for name in ("scanner", "scanner2"))
    both = np.isfinite(a) & np.isfinite(b)
    assert not np.array_equal(np.isnan(a), np.isnan(b))
    assert abs(np.corrcoef(a[both], b[both])[0, 1]) < 4.0 / np.sqrt(both.sum())


def test_presets_and_what_the_log_says(noisy: SensorLog) -> None:
    full = crawler_preset("full", noise_scale=0.5)
    assert (full.beams, full.scan_rate, full.noise_scale) == (181, 37.5, 0.5)
    assert noisy["scanner"].ranges.shape[1] == 61
    meta = json.loads(json.dumps(noisy.meta, allow_nan=False))
    assert meta["config"]["beams"] == 61
    assert meta["noise"]["range_sigma"] == 0.025
    assert meta["noise"]["yaw_bias"] == noisy["imu"].noise.gyro_bias
    assert meta["length"] == pytest.approx(noisy.truth.trajectory.length(), rel=1e-4)
    assert noisy.read == {k: len(s.times) for k, s in noisy.streams.items()}


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"beams": 1}, "beams = 1"),
        ({"beams": 61.0}, "beams = 61.0"),
        ({"scanners": 3}, "scanners = 3"),
        ({"scan_rate": 0.0}, "scan_rate"),
        ({"range_sigma": -0.1}, "range_sigma"),
        ({"max_range": float("nan")}, "max_range"),
        ({"drop_out": 1.0}, "drop_out"),
        ({"min_range": 40.0}, "min_range"),
        ({"sweep_time": 1.0}, "sweep_time"),
        ({"mount": (0, 0, 0, 0, 0, 0, 2)}, "mount"),
        ({"imu_mount": "up"}, "imu_mount"),
        ({"gyro": "much"}, "gyro = much"),
        ({"gyros": 1.0}, "unknown parameter 'gyros'"),
    ],
)
def test_impossible_figures_are_refused(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        crawler_preset(**changes)


def test_unknown_preset() -> None:
    with pytest.raises(UnknownNameError, match="light"):
        crawler_preset("ligth")
