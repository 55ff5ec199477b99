"""Dead reckoning from speed and yaw rate and from recorded odometry, and the choice between the streams of a log."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.records import AckermannGeometry, Gps, Odometry, SteeringControls, VelocityControls
from graphslam_frontends.odometry.motion import (
    MotionNoise,
    cut_odometry,
    dead_reckoned_increments,
    steering_odometry,
    velocity_odometry,
)
from tests.reference.compose_covariance import se2_compose_covariance
from tests.reference.dead_reckoning import drive_arcs, drive_arcs_covariance

T = np.arange(0.0, 2.0, 0.05)
SPEED = 0.4 + 0.3 * np.sin(T)
RATE = 1.2 * np.cos(3 * T)
SPEED[10:14], RATE[10:14] = 0.0, 0.0  # it stands a while
RATE[20:24] = 1e-5  # nearly straight: the series
STAMPS = np.array([0.0, 0.5, 1.02, 1.9])
QUIET = MotionNoise(speed=0.0, yaw_rate=0.0)


def controls(speed=SPEED, rate=RATE):
    return VelocityControls(times=T, speed=speed, yaw_rate=rate)


def held(k):
    """Speeds, rates and durations of increment k."""
    knots = np.union1d(T[(STAMPS[k - 1] < T) & (STAMPS[k] > T)], STAMPS[k - 1 : k + 1])
    i = np.searchsorted(T, knots[:-1] + 1e-9, side="right") - 1
    return SPEED[i], RATE[i], np.diff(knots)


def test_arcs_equal_a_fine_integrator():
    o = velocity_odometry(controls(), STAMPS, QUIET)
    for k in range(1, len(STAMPS)):
        np.testing.assert_allclose(o.increments[k], drive_arcs(*held(k)), atol=1e-8)


@pytest.mark.parametrize("per_increment", [False, True])
def test_covariance_equals_the_slow_twin(per_increment):
    noise = MotionNoise(
        speed=0.02, speed_fraction=0.05, yaw_rate=0.01, yaw_rate_fraction=0.08, per_increment=per_increment,
        lateral=0.02, heading=0.01, speed_walk=0.01, yaw_walk=0.015,
    )  # fmt: skip
    o = velocity_odometry(controls(), STAMPS, noise)
    for k in range(1, len(STAMPS)):
        P = drive_arcs_covariance(*held(k), noise)
        s = np.sqrt(np.diag(P))
        np.testing.assert_allclose(o.covariances[k] / np.outer(s, s), P / np.outer(s, s), atol=2e-3)


@pytest.mark.parametrize("per_increment", [False, True])
def test_covariance_is_confirmed_by_monte_carlo(per_increment):
    rng = np.random.default_rng(3)
    noise = MotionNoise(speed=0.03, yaw_rate=0.05, yaw_rate_fraction=0.1, per_increment=per_increment)
    moving = (SPEED != 0) | (RATE != 0)
    draws = 6000
    errors = np.empty((draws, 2, 3))
    aligned = STAMPS[[0, 1, 3]]  # stamps at control stamps: a cut control would be drawn twice
    o = velocity_odometry(controls(), aligned, noise)
    clean = velocity_odometry(controls(), aligned, QUIET).increments
    part = np.clip(np.searchsorted(aligned, T + 1e-9, side="right") - 1, 0, 1)
    for d in range(draws):
        n = rng.standard_normal((3, 2))[:, part] if per_increment else rng.standard_normal((3, len(T)))
        noisy = controls(SPEED + 0.03 * n[0] * moving, RATE + (0.05 * n[1] + 0.1 * RATE * n[2]) * moving)
        errors[d] = se2_log(se2_between(clean, velocity_odometry(noisy, aligned, QUIET).increments))[1:]
    for k in (1, 2):
        P = o.covariances[k] - np.diag([1e-8, 1e-8, 1e-10])
        s = np.sqrt(np.diag(P))
        # 6,000 draws give 1.8 % (1 σ) of a variance
        np.testing.assert_allclose(np.cov(errors[:, k - 1].T) / np.outer(s, s), P / np.outer(s, s), atol=0.1)


def test_noisy_rates_do_not_shorten_the_path():
    rng = np.random.default_rng(5)
    n, sigma = 100, 1.0  # heading variance over an increment: 100 · (1 rad/s · 0.05 s)² = 0.25
    t = 0.05 * np.arange(n)
    noise = MotionNoise(speed=0.0, yaw_rate=sigma)
    driven = {True: [], False: []}
    for _ in range(3000):
        c = VelocityControls(times=t, speed=np.ones(n), yaw_rate=sigma * rng.standard_normal(n))
        for corrected in driven:
            o = velocity_odometry(c, np.array([0.0, 5.0]), noise if corrected else QUIET)
            driven[corrected].append(o.increments[1, 0])
    # truth 5 m; the mean of 3,000 is known to 6 mm; uncorrected it is short by 6 %
    assert np.mean(driven[True]) == pytest.approx(5.0, abs=0.03)
    assert np.mean(driven[False]) < 4.8


def test_a_walk_does_not_depend_on_the_rate_of_the_controls():
    noise = MotionNoise(speed=0.0, yaw_rate=0.0, speed_walk=0.02, yaw_walk=0.04)
    found = []
    for n in (20, 200, 2000):
        t = np.linspace(0.0, 4.0, n, endpoint=False)
        c = VelocityControls(times=t, speed=np.full(n, 0.5), yaw_rate=np.zeros(n))
        found.append(velocity_odometry(c, np.array([0.0, 4.0]), noise).covariances[1])
    np.testing.assert_allclose(found[0], found[2], rtol=2e-2, atol=1e-9)
    # heading 0.04² · 4 s; along 0.02² · 4 s; across ∫ (v (T - t))² q dt = q v² T³ / 3 (tangent at the end)
    np.testing.assert_allclose(np.diag(found[2]), [0.0016, 0.0016 * 0.25 * 64 / 3, 0.0064], rtol=2e-3)


def test_a_standing_base_gains_no_more_than_the_floors():
    noise = MotionNoise(speed=0.1, yaw_rate=0.1)
    o = velocity_odometry(controls(0 * T, 0 * T), STAMPS, noise)
    np.testing.assert_array_equal(o.increments, 0.0)
    np.testing.assert_allclose(o.covariances, np.tile(np.diag([1e-8, 1e-8, 1e-10]), (4, 1, 1)))


def recorded(rng, n=12):
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 0.4, n - 1))])
    u = rng.normal(size=(n, 3)) * [0.3, 0.05, 0.3]
    u[0] = 0
    A = rng.normal(size=(n, 3, 3)) * 0.01
    return Odometry(times=t, increments=u, covariances=A @ np.swapaxes(A, 1, 2) + 1e-6 * np.eye(3))


def test_recorded_odometry_composes_motion_and_covariance(rng):
    o = recorded(rng)
    at = np.array([0, 3, 4, 11])
    floors = MotionNoise(floor_position=1e-9, floor_heading=1e-9)
    got = cut_odometry(o, o.times[at], floors)
    for k in range(1, len(at)):
        T_ab, P = np.zeros(3), np.zeros((3, 3))
        for j in range(at[k - 1] + 1, at[k] + 1):
            P = se2_compose_covariance(T_ab, P, o.increments[j], o.covariances[j])
            T_ab = se2_compose(T_ab, o.increments[j])
        np.testing.assert_allclose(got.increments[k], T_ab, atol=1e-12)
        np.testing.assert_allclose(got.covariances[k], P, atol=1e-15)


def test_a_cut_record_is_driven_at_constant_velocity(rng):
    o = recorded(rng)
    a, b = o.times[4], o.times[5]
    got = cut_odometry(o, np.array([a, a + 0.25 * (b - a), b]), MotionNoise())
    np.testing.assert_allclose(got.increments[1], se2_exp(0.25 * se2_log(o.increments[5])), atol=1e-12)
    np.testing.assert_allclose(se2_compose(got.increments[1], got.increments[2]), o.increments[5], atol=1e-12)
    np.testing.assert_allclose(got.covariances[1], 0.25 * o.covariances[5], atol=2e-8)


def test_hold_reaches_beyond_the_ends_and_no_farther(rng):
    o = recorded(rng)
    log = SensorLog(name="l", streams={"odo": o})
    t = np.array([-0.2, 0.0, o.times[-1] + 0.2])
    got, name = dead_reckoned_increments(log, t, MotionNoise(), hold=0.2)
    assert name == "odo"
    back = se2_exp(0.2 / o.times[1] * se2_log(o.increments[1]))
    np.testing.assert_allclose(got.increments[1], back, atol=1e-12)
    with pytest.raises(DataError, match="before the first motion record"):
        dead_reckoned_increments(log, t, MotionNoise(), hold=0.1)
    with pytest.raises(DataError, match="outside the odometry"):
        dead_reckoned_increments(log, t[1:], MotionNoise(), hold=0.1)


def test_the_log_decides_what_is_reckoned_from(rng):
    car = AckermannGeometry(wheelbase=2.0)
    steering = SteeringControls(times=T, speed=SPEED, steering=0.1 * RATE, geometry=car)
    streams = {"odo": recorded(rng), "vel": controls(), "car": steering}
    noise = MotionNoise()
    got, name = dead_reckoned_increments(SensorLog(name="l", streams=streams), STAMPS, noise)
    assert name == "car"
    np.testing.assert_array_equal(got.increments, steering_odometry(steering, STAMPS, noise).increments)
    del streams["car"]
    got, name = dead_reckoned_increments(SensorLog(name="l", streams=streams), STAMPS - 0.3, noise, hold=0.3)
    assert name == "vel"
    early = VelocityControls(times=np.concatenate([[-0.3], T[1:]]), speed=SPEED, yaw_rate=RATE)
    np.testing.assert_array_equal(got.covariances, velocity_odometry(early, STAMPS - 0.3, noise).covariances)
    none = Gps(times=[0.0], positions=[[0.0, 0.0]], sigma=[1.0], lever=[0.0, 0.0])
    with pytest.raises(MissingDataError, match="no motion to dead-reckon"):
        dead_reckoned_increments(SensorLog(name="l", streams={"gps": none}), STAMPS, noise)
    empty = SensorLog(name="l", streams={"vel": controls().take(slice(0, 0))})
    with pytest.raises(MissingDataError, match="empty"):
        dead_reckoned_increments(empty, STAMPS, noise)


def test_impossible_requests_are_refused(rng):
    with pytest.raises(DataError, match="before the first control"):
        velocity_odometry(controls(), STAMPS - 1.0, QUIET)
    with pytest.raises(ConfigError, match="yaw_rate_fraction"):
        MotionNoise(yaw_rate_fraction=-0.1)
    spatial = Odometry(
        times=[0.0, 1.0], increments=np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1)), covariances=np.tile(np.eye(6), (2, 1, 1))
    )
    with pytest.raises(DataError, match="cannot be used"):
        dead_reckoned_increments(SensorLog(name="l", streams={"odo": spatial}), np.array([0.0, 1.0]), MotionNoise())
