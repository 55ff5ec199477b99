"""Dead reckoning from speed and steering: against a fine integrator, and its covariance against a Monte Carlo."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_between, se2_compose, se2_log
from graphslam.core.records import AckermannGeometry, SteeringControls
from graphslam_frontends.odometry.motion import MotionNoise, steering_odometry

T = np.arange(0.0, 2.0, 0.025)
SPEED = 3.0 + np.sin(T)
STEERING = 0.3 * np.sin(2 * T)
STAMPS = np.array([0.0, 0.5, 1.0, 1.9])
SMALL = 1e-9


def controls(model, speed=SPEED, steering=STEERING, encoder=0.0):
    g = AckermannGeometry(wheelbase=2.83, encoder_offset=encoder, model=model)
    return SteeringControls(times=T, speed=speed, steering=steering, geometry=g)


def integrate(encoder, t0, t1, n=4000):
    """Midpoint integration of the rear-axle differential equations with held controls: slow and obvious."""
    x = np.zeros(3)
    dt = (t1 - t0) / n
    for k in range(n):
        i = np.searchsorted(T, t0 + (k + 0.5) * dt, side="right") - 1
        v = SPEED[i] / (1 - np.tan(STEERING[i]) * encoder / 2.83)
        w = v * np.tan(STEERING[i]) / 2.83
        h = x[2] + 0.5 * w * dt
        x = x + dt * np.array([v * np.cos(h), v * np.sin(h), w])
    return x


def euler_steps(t0, t1):
    """The front-steer model as Combined SLAM defines it: x' = x + V dt cos(G + φ), one step a held control."""
    x = np.zeros(3)
    knots = np.unique(np.concatenate([T[(t0 < T) & (t1 > T)], [t0, t1]]))
    for a, b in itertools.pairwise(knots):
        i = np.searchsorted(T, a, side="right") - 1
        v, g = SPEED[i], STEERING[i]
        x = x + (b - a) * v * np.array([np.cos(g + x[2]), np.sin(g + x[2]), np.sin(g) / 2.83])
    return x


QUIET = MotionNoise(speed=0.0, steering=0.0)


def test_rear_axle_increments_equal_a_fine_integrator():
    o = steering_odometry(controls("rear-axle", encoder=0.76), STAMPS, QUIET)
    for k in range(1, len(STAMPS)):
        np.testing.assert_allclose(o.increments[k], integrate(0.76, STAMPS[k - 1], STAMPS[k]), atol=1e-5)


def test_front_steer_increments_equal_the_defined_steps():
    o = steering_odometry(controls("front-steer"), STAMPS, QUIET)
    for k in range(1, len(STAMPS)):
        np.testing.assert_allclose(o.increments[k], euler_steps(STAMPS[k - 1], STAMPS[k]), atol=1e-12)


@pytest.mark.parametrize("model", ["rear-axle", "front-steer"])
@pytest.mark.parametrize("per_increment", [False, True])
def test_covariance_is_confirmed_by_monte_carlo(model, per_increment):
    rng = np.random.default_rng(7)
    noise = MotionNoise(speed=0.1, steering=np.deg2rad(2.0), per_increment=per_increment)
    o = steering_odometry(controls(model), STAMPS, noise)
    clean = steering_odometry(controls(model), STAMPS, QUIET).increments
    errors = []
    held = np.clip(np.searchsorted(STAMPS, T, side="right") - 1, 0, len(STAMPS) - 2)
    for _ in range(6000):
        if per_increment:
            dv, da = 0.1 * rng.standard_normal(3)[held], np.deg2rad(2.0) * rng.standard_normal(3)[held]
        else:
            dv, da = 0.1 * rng.standard_normal(len(T)), np.deg2rad(2.0) * rng.standard_normal(len(T))
        noisy = steering_odometry(controls(model, SPEED + dv, STEERING + da), STAMPS, noise)
        errors.append(se2_log(se2_between(clean, noisy.increments)))
    e = np.array(errors)
    for k in range(1, len(STAMPS)):
        P = o.covariances[k] - np.diag([1e-8, 1e-8, 1e-10])
        # element by element, on the scale of the standard deviations: 6,000 draws give 1.8 % (1 σ) of a variance
        s = np.sqrt(np.diag(P))
        np.testing.assert_allclose(np.cov(e[:, k].T) / np.outer(s, s), P / np.outer(s, s), atol=0.1)


def test_noisy_steering_does_not_shorten_the_path():
    rng = np.random.default_rng(1)
    noise = MotionNoise(speed=0.0, steering=np.deg2rad(6.0))
    t = np.arange(0.0, 200.0, 0.025)
    g = AckermannGeometry(wheelbase=4.0, model="front-steer")
    straight = SteeringControls(
        times=t, speed=np.full(len(t), 3.0), steering=np.deg2rad(6.0) * rng.standard_normal(len(t)), geometry=g
    )
    stamps = np.arange(0.0, 199.0, 0.2)
    driven = steering_odometry(straight, stamps, noise).increments[1:, 0].sum()
    # uncorrected it would be short by 0.55 % = 3.3 m; the random part is 0.03 m
    assert driven == pytest.approx(3.0 * (stamps[-1] - stamps[0]), abs=0.15)


def test_increments_chain_and_floor():
    o = steering_odometry(controls("rear-axle"), STAMPS, MotionNoise())
    whole = steering_odometry(controls("rear-axle"), STAMPS[[0, -1]], MotionNoise())
    chained = o.increments[1]
    for u in o.increments[2:]:
        chained = se2_compose(chained, u)
    np.testing.assert_allclose(chained, whole.increments[1], atol=1e-9)
    standing = steering_odometry(controls("rear-axle", 0 * T), STAMPS, MotionNoise(speed=0.05, per_increment=True))
    for P in standing.covariances:
        assert np.linalg.eigvalsh(P)[0] > 0


def test_impossible_requests_are_refused():
    with pytest.raises(DataError, match="before the first control"):
        steering_odometry(controls("rear-axle"), np.array([-1.0, 0.5]), MotionNoise())
    with pytest.raises(ConfigError, match="speed"):
        MotionNoise(speed=-1.0)
    with pytest.raises(ConfigError, match="floor_heading"):
        MotionNoise(floor_heading=0.0)
