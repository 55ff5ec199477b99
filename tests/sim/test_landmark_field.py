"""The landmark field: its truth and its noise, each two-sided against the stated figures."""

from __future__ import annotations

import dataclasses
import json
import math
import time

import numpy as np
import pytest
from scipy import stats

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import se2_between, se2_compose, se2_inverse, se2_log, se2_transform, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps, LandmarkObservations, SteeringControls
from graphslam.evaluate.consistency import joint_nees, pose_error
from graphslam.sim.landmark_field import (
    PRESETS,
    LandmarkFieldConfig,
    landmark_field_preset,
    simulate_landmark_field,
)
from graphslam_frontends.odometry.motion import MotionNoise, steering_odometry
from tests.reference.batch_slam import batch_slam
from tests.sim.normality import P_VALUE, assert_normal

QUICK = PRESETS["quick"]


def expected(log: SensorLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row numbers of true observations, and their exact ranges and bearings, by brute force over all features."""
    obs, truth = log["landmarks"], log.truth
    rows, ranges, bearings = [], [], []
    for k, t in enumerate(obs.times):
        pose = truth.trajectory.poses[np.flatnonzero(truth.trajectory.times == t)[0]]
        d = se2_transform(se2_inverse(pose), truth.landmarks)
        for row in range(obs.offsets[k], obs.offsets[k + 1]):
            if obs.ids[row] >= 0:
                p = d[obs.ids[row]]
                rows.append(row)
                ranges.append(math.hypot(*p))
                bearings.append(math.atan2(p[1], p[0]))
    return np.array(rows), np.array(ranges), np.array(bearings)


@pytest.fixture(scope="module")
def world_a() -> SensorLog:
    return simulate_landmark_field(dataclasses.replace(PRESETS["A"], gps_rate=5.0, gps_sigma=2.0), 11)


def test_noise_of_controls_is_the_stated_one(world_a: SensorLog) -> None:
    c = world_a["controls"]
    exact = simulate_landmark_field(dataclasses.replace(PRESETS["A"], noise_scale=0.0), 11)["controls"]
    assert_normal(c.speed - exact.speed, 0.3, "speed")
    assert_normal(c.steering - exact.steering, math.radians(3.0), "steering")
    r = np.corrcoef(c.speed - exact.speed, c.steering - exact.steering)[0, 1]
    assert abs(r) < stats.norm.ppf(1 - P_VALUE / 2) / math.sqrt(len(c.times))


def test_noise_of_observations_is_the_stated_one(world_a: SensorLog) -> None:
    rows, ranges, bearings = expected(world_a)
    obs = world_a["landmarks"]
    assert len(rows) == len(obs.ranges) > 40_000
    assert_normal(obs.ranges[rows] - ranges, 0.5, "range")
    assert_normal(wrap_angle(obs.bearings[rows] - bearings), math.radians(5.0), "bearing")
    assert np.all(obs.sigmas == [0.5, math.radians(5.0)])


def test_noise_of_gps_is_the_stated_one(world_a: SensorLog) -> None:
    g = world_a["gps"]
    truth = world_a.truth.trajectory.interpolate(g.times)[:, :2]
    assert_normal((g.positions - truth)[:, 0], 2.0, "GPS x")
    assert_normal((g.positions - truth)[:, 1], 2.0, "GPS y")


def test_the_noise_test_has_power(world_a: SensorLog) -> None:
    """A simulator that lies by 3 %, or is biased, must fail the test above."""
    rows, ranges, _ = expected(world_a)
    e = world_a["landmarks"].ranges[rows] - ranges
    for wrong in (1.03 * e, 0.97 * e, e + 0.02, np.repeat(e[::2], 2)):
        with pytest.raises(AssertionError):
            assert_normal(wrong, 0.5, "range")


def test_world_a_is_the_papers(world_a: SensorLog) -> None:
    obs, truth = world_a["landmarks"], world_a.truth
    assert len(np.unique(obs.ids)) == 554  # every feature is seen
    assert world_a.duration == pytest.approx(4460 / 3, abs=0.03)
    assert np.allclose(np.diff(world_a["controls"].times), 1 / 40, atol=1e-9)
    assert np.allclose(np.diff(obs.times), 1 / 5, atol=1e-9)
    assert 5.5 < len(obs.ranges) / len(obs.times) < 8.0
    # the second lap comes back to the first
    half = len(truth.trajectory) // 2
    assert np.linalg.norm(truth.trajectory.poses[half, :2]) < 5.0
    assert world_a.truth.trajectory.length() == pytest.approx(4460, abs=0.1)


def test_a_world_of_25_minutes_takes_less_than_a_second() -> None:
    simulate_landmark_field(QUICK, 0)  # compile
    t = time.process_time()
    simulate_landmark_field(PRESETS["A"], 0)
    assert time.process_time() - t < 5.0


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_closes_a_loop_and_sees_old_features(name: str) -> None:
    c = PRESETS[name]
    log = simulate_landmark_field(c, 0)
    obs = log["landmarks"]
    scan = np.repeat(np.arange(len(obs.times)), np.diff(obs.offsets))
    real, scan = obs.ids[obs.ids >= 0], scan[obs.ids >= 0]
    first, last = np.full(c.features, -1), np.full(c.features, -1)
    first[real[::-1]], last[real] = scan[::-1], scan
    one_lap = c.lap_length / c.speed * c.scan_rate
    again = np.sum((last - first > 0.8 * one_lap) & (first >= 0))
    assert again >= 0.03 * c.features
    assert np.mean(np.diff(obs.offsets) > 0) > 0.9  # hardly ever blind: B sees 2.9 features a scan


def test_truth_starts_at_the_identity_and_moves_by_the_stated_model() -> None:
    log = simulate_landmark_field(dataclasses.replace(QUICK, noise_scale=0.0), 3)
    P, c = log.truth.trajectory.poses, log["controls"]
    assert np.array_equal(P[0], np.zeros(3))
    assert len(P) == len(c.times) + 1
    dt, V, G = 1 / 40, c.speed, c.steering
    assert np.allclose(P[1:, 0], P[:-1, 0] + V * dt * np.cos(G + P[:-1, 2]), atol=1e-12)
    assert np.allclose(P[1:, 1], P[:-1, 1] + V * dt * np.sin(G + P[:-1, 2]), atol=1e-12)
    assert np.allclose(wrap_angle(P[1:, 2] - P[:-1, 2] - V * dt * np.sin(G) / 4.0), 0.0, atol=1e-12)


def test_exact_controls_integrate_to_the_truth() -> None:
    """An independent dead reckoning (the front ends') agrees with the simulator about model, stamps and hold."""
    log = simulate_landmark_field(dataclasses.replace(QUICK, noise_scale=0.0), 3)
    times = np.concatenate([[0.0], log["landmarks"].times])
    odo = steering_odometry(log["controls"], times, MotionNoise(speed=0.0, steering=0.0))
    T = np.zeros(3)
    for inc, true in zip(odo.increments, log.truth.trajectory.interpolate(times)):
        T = se2_compose(T, inc)
        assert np.abs(se2_log(se2_between(T, true))).max() < 1e-9


def test_exact_observations_point_at_the_features() -> None:
    log = simulate_landmark_field(dataclasses.replace(QUICK, noise_scale=0.0), 3)
    rows, ranges, bearings = expected(log)
    assert np.abs(log["landmarks"].ranges[rows] - ranges).max() < 1e-9
    assert np.abs(wrap_angle(log["landmarks"].bearings[rows] - bearings)).max() < 1e-9


def test_the_sensor_sees_all_features_in_its_sector_and_no_others() -> None:
    c = dataclasses.replace(QUICK, noise_scale=0.0, field_of_view=math.radians(120), max_range=15.0, min_range=5.0)
    log = simulate_landmark_field(c, 4)
    obs = log["landmarks"]
    for k, t in enumerate(obs.times):
        pose = log.truth.trajectory.interpolate(t)[0]
        d = se2_transform(se2_inverse(pose), log.truth.landmarks)
        r, b = np.hypot(*d.T), np.degrees(np.arctan2(d[:, 1], d[:, 0]))
        seen = np.flatnonzero((r >= 5.0) & (r <= 15.0) & (np.abs(b) <= 60.0))
        assert sorted(obs.ids[obs.scan(k)]) == seen.tolist()
        assert np.all(np.diff(obs.bearings[obs.scan(k)]) >= 0)


def test_systematic_errors_are_the_stated_ones_and_no_part_of_the_noise() -> None:
    a = simulate_landmark_field(QUICK, 1)["controls"]
    c = dataclasses.replace(QUICK, speed_factor=1.05, steering_bias=math.radians(-0.5))
    b = simulate_landmark_field(c, 1)["controls"]
    assert np.allclose(b.speed - a.speed, 0.05 * QUICK.speed, atol=1e-12)
    assert np.allclose(b.steering - a.steering, math.radians(-0.5), atol=1e-12)


def test_the_worlds_that_confuse_state_an_consistent_noise() -> None:
    """Their presets draw nothing that the stated σ do not cover, and truth names the clutter."""
    for name in ("clutter", "pairs", "rows", "hard"):
        c = PRESETS[name]
        assert (c.noise_scale, c.speed_factor, c.steering_bias) == (1.0, 1.0, 0.0)
        log = simulate_landmark_field(c, 1)
        assert 600 <= log.truth.trajectory.length() <= 900
        assert np.any(log["landmarks"].ids < 0) == (c.clutter_rate > 0)
        assert len(log.truth.landmarks) == c.features


def test_same_seed_same_bytes_other_seed_other_noise() -> None:
    a, b, c = (simulate_landmark_field(QUICK, s) for s in (5, 5, 6))
    assert a["landmarks"].ranges.tobytes() == b["landmarks"].ranges.tobytes()
    assert a["controls"].speed.tobytes() == b["controls"].speed.tobytes()
    assert a.truth.landmarks.tobytes() == b.truth.landmarks.tobytes()
    assert not np.array_equal(a["controls"].speed, c["controls"].speed)
    assert not np.array_equal(a.truth.landmarks, c.truth.landmarks)


def test_layout_seed_holds_the_features_and_leaves_the_noise_free() -> None:
    held = dataclasses.replace(QUICK, layout_seed=42)
    a, b = simulate_landmark_field(held, 1), simulate_landmark_field(held, 2)
    assert np.array_equal(a.truth.landmarks, b.truth.landmarks)
    assert not np.array_equal(a["controls"].speed, b["controls"].speed)
    assert np.array_equal(a["controls"].speed, simulate_landmark_field(QUICK, 1)["controls"].speed)


def test_gps_clutter_and_missed_detections_do_not_change_the_rest() -> None:
    a = simulate_landmark_field(QUICK, 1)
    b = simulate_landmark_field(dataclasses.replace(QUICK, gps_rate=1.0, clutter_rate=2.0), 1)
    assert np.array_equal(a["controls"].speed, b["controls"].speed)
    real = b["landmarks"].ids >= 0
    assert np.array_equal(a["landmarks"].ranges, b["landmarks"].ranges[real])
    assert "gps" not in a
    c = simulate_landmark_field(dataclasses.replace(QUICK, detection_probability=0.5), 1)
    assert set(c["landmarks"].ranges) < set(a["landmarks"].ranges)


def test_clutter_and_detection_rates_are_the_stated_ones() -> None:
    c = dataclasses.replace(PRESETS["demo"], clutter_rate=1.5, detection_probability=0.8)
    log = simulate_landmark_field(c, 0)
    obs, full = log["landmarks"], simulate_landmark_field(PRESETS["demo"], 0)["landmarks"]
    clutter = obs.ids < 0
    n = len(obs.times)
    low, high = stats.poisson.ppf([P_VALUE / 2, 1 - P_VALUE / 2], 1.5 * n)
    assert low < clutter.sum() < high
    visible = len(full.ranges)
    low, high = stats.binom.ppf([P_VALUE / 2, 1 - P_VALUE / 2], visible, 0.8)
    assert low < np.sum(~clutter) < high
    assert log.dropped["landmarks: visible but not detected"] == visible - np.sum(~clutter)
    # uniform over the area of the sector: r² and the bearing are uniform
    u = (obs.ranges[clutter] ** 2 - 1.0) / (30.0**2 - 1.0)
    v = obs.bearings[clutter] / math.pi + 0.5
    assert stats.kstest(u, "uniform").pvalue > P_VALUE
    assert stats.kstest(v, "uniform").pvalue > P_VALUE


def test_ranges_that_noise_makes_negative_are_dropped_and_counted() -> None:
    c = dataclasses.replace(QUICK, sigma_range=5.0)
    log = simulate_landmark_field(c, 0)
    assert np.all(log["landmarks"].ranges > 0)
    assert log.dropped["landmarks: measured range not positive"] > 0


def test_gps_knows_lever_and_frame() -> None:
    frame = (100.0, -50.0, 0.8)
    c = dataclasses.replace(QUICK, gps_rate=2.0, gps_lever=[2.0, 0.5], gps_frame=frame, noise_scale=0.0)
    log = simulate_landmark_field(c, 0)
    antenna = se2_transform(log.truth.trajectory.interpolate(log["gps"].times), np.array([2.0, 0.5]))
    assert np.allclose(log["gps"].positions, se2_transform(np.array(frame), antenna), atol=1e-9)
    assert log["gps"].lever.tolist() == [2.0, 0.5]


def test_meta_states_every_figure_and_is_json() -> None:
    log = simulate_landmark_field(dataclasses.replace(QUICK, layout_seed=9, gps_rate=1.0), 4)
    meta = json.loads(json.dumps(log.meta, allow_nan=False))
    assert meta == log.meta
    assert (meta["seed"], meta["layout_seed"]) == (4, 9)
    assert meta["noise"]["steering"] == QUICK.sigma_steering
    assert LandmarkFieldConfig(**meta["config"]) == dataclasses.replace(QUICK, layout_seed=9, gps_rate=1.0)
    kinds = {n: type(s) for n, s in log.streams.items()}
    assert kinds == {"controls": SteeringControls, "landmarks": LandmarkObservations, "gps": Gps}


def test_a_world_without_features_has_empty_scans() -> None:
    log = simulate_landmark_field(dataclasses.replace(QUICK, landmarks=0), 0)
    assert len(log["landmarks"].ranges) == 0
    assert len(log["landmarks"].times) > 0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sigma_range", 0.0),
        ("sigma_speed", -1.0),
        ("speed", math.nan),
        ("lap_length", math.inf),
        ("scan_rate", 7.0),
        ("gps_rate", 80.0),
        ("field_of_view", 7.0),
        ("detection_probability", 1.1),
        ("lateral_min", 30.0),
        ("laps", 1e-9),
        ("landmarks", -1),
        ("gps_lever", (1.0,)),
        ("route_amplitude", 1.0),
        ("pair_fraction", 1.5),
        ("pair_distance", 0.0),
        ("row_spacing", 61.0),
        ("row_spacing", -1.0),
        ("row_jitter", 3.0),
        ("speed_factor", 0.0),
        ("steering_bias", math.nan),
    ],
)
def test_impossible_configuration_names_the_field(field: str, value: object) -> None:
    with pytest.raises(ConfigError, match=field):
        dataclasses.replace(QUICK, **{field: value})


def test_unknown_preset_and_unknown_field() -> None:
    with pytest.raises(UnknownNameError, match="demo"):
        landmark_field_preset("Z")
    with pytest.raises(ConfigError, match="sigma_rnage"):
        landmark_field_preset("A", sigma_rnage=1.0)
    assert landmark_field_preset("A", sigma_range=0.2).sigma_range == 0.2


def test_residuals_at_the_truth_are_chi_square() -> None:
    """Motion, sensor and their stated noise fit together: the whitened residuals of the truth have unit variance."""
    log = simulate_landmark_field(PRESETS["demo"], 2)
    times = np.concatenate([[0.0], log["landmarks"].times])
    noise = MotionNoise(floor_position=1e-6, floor_heading=1e-8)
    odo = steering_odometry(log["controls"], times, noise)
    X = log.truth.trajectory.interpolate(times)
    e = se2_log(se2_between(odo.increments[1:], se2_between(X[:-1], X[1:])))
    d2 = np.einsum("ki,kij,kj->", e, np.linalg.inv(odo.covariances[1:]), e)
    low, high = stats.chi2.ppf([P_VALUE / 2, 1 - P_VALUE / 2], 3 * len(e))
    assert low < d2 < high


@pytest.mark.parametrize("scale", [1.0, 1.3, 0.75])
def test_batch_optimum_is_consistent_only_if_the_simulator_is(scale: float) -> None:
    """χ²/dof and joint NEES of a full batch: inside the two-sided bounds at scale 1, outside for a lying simulator.

    Small noise, so that the Gaussian of the optimum is exact; four runs.
    """
    small = {"sigma_steering": math.radians(0.3), "sigma_speed": 0.05, "sigma_range": 0.05}
    c = dataclasses.replace(QUICK, sigma_bearing=math.radians(0.5), noise_scale=scale, **small)
    chi2 = dof = d2 = n = 0.0
    for seed in range(4):
        log = simulate_landmark_field(c, seed)
        r = batch_slam(log)
        true = log.truth.trajectory.interpolate(r.times)
        e = np.concatenate(
            [pose_error(r.poses[1:], true[1:]).ravel(), (log.truth.landmarks[r.ids] - r.landmarks).ravel()]
        )
        chi2, dof = chi2 + r.chi2, dof + r.dof
        d2, n = d2 + joint_nees(e, information=r.information), n + len(e)
    for value, freedom in ((chi2, dof), (d2, n)):
        low, high = stats.chi2.ppf([P_VALUE / 2, 1 - P_VALUE / 2], freedom)
        assert (low < value < high) == (scale == 1.0), (value / freedom, low / freedom, high / freedom)
        if scale != 1.0:
            assert (value > high) == (scale > 1.0)
