"""Preintegration against a slow twin, against the exact motion, against GTSAM's, and its covariance against draws."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.imu import GRAVITY, Imu
from graphslam.graph.factors.imu.preintegration import longest_pause, mean_force, preintegrate
from tests.reference.imu_ring import MOUNT, NOISE, ring, true_unit, true_velocity, unit_on
from tests.reference.slow_preintegration import slow_preintegrate

BIAS = np.array([0.01, -0.02, 0.015, 0.1, -0.05, 0.2])


def test_it_is_the_slow_twin(rng):
    imu, _ = unit_on(np.sort(rng.uniform(0, 8, 400)), rng)
    begin, end = np.array([1.0, 2.3, imu.times[50]]), np.array([2.3, 6.1, imu.times[60]])
    fast = preintegrate(imu, begin, end, BIAS)
    for k in range(3):
        R, p, v = slow_preintegrate(imu, begin[k], end[k], BIAS)
        np.testing.assert_allclose(fast.R[k], R.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(fast.p[k], p, atol=1e-11)
        np.testing.assert_allclose(fast.v[k], v, atol=1e-11)
    np.testing.assert_allclose(fast.seconds, end - begin)


def exact(begin: float, end: float) -> np.ndarray:
    """``[φ's rotation vector, p, v]`` of the true motion (eq. 33 solved for the increments)."""
    t = np.array([begin, end])
    X, v, T = true_unit(t), true_velocity(t), end - begin
    Rt, g = se3.quat_to_matrix(X[0, 3:]).T, np.array([0, 0, -GRAVITY])
    turn = se3.so3_log(se3.quat_multiply(X[0, 3:] * [-1, -1, -1, 1], X[1, 3:]))
    p = Rt @ (X[1, :3] - X[0, :3] - v[0] * T - 0.5 * g * T**2)
    return np.concatenate([turn, p, Rt @ (v[1] - v[0] - g * T)])


def vector(pim, k=0) -> np.ndarray:
    return np.concatenate([se3.so3_log(se3.matrix_to_quat(pim.R[k])), pim.p[k], pim.v[k]])


def test_it_is_the_motion():
    """And converges to it with the square of the step."""
    errors = []
    for hz in (50, 100, 200):
        imu, _ = unit_on(np.arange(0, 6 * hz) / hz, None)
        errors.append(np.abs(vector(preintegrate(imu, [0.513], [5.217])) - exact(0.513, 5.217)).max())
    assert errors[2] < 2e-4
    assert 3.0 < errors[0] / errors[1] < 5.0
    assert 3.0 < errors[1] / errors[2] < 5.0


def test_its_bias_jacobian_is_that_of_differences(rng):
    imu, _ = unit_on(np.arange(0, 400) / 100, rng)
    pim, h = preintegrate(imu, [0.2], [3.4], BIAS), 1e-6
    for c in range(6):
        step = h * np.eye(6)[c]
        ahead, behind = (preintegrate(imu, [0.2], [3.4], BIAS + s) for s in (step, -step))
        turn = se3.quat_multiply(se3.matrix_to_quat(behind.R[0]) * [-1, -1, -1, 1], se3.matrix_to_quat(ahead.R[0]))
        d = np.concatenate([se3.so3_log(turn), ahead.p[0] - behind.p[0], ahead.v[0] - behind.v[0]]) / (2 * h)
        np.testing.assert_allclose(pim.J[0][:, c], d, rtol=1e-6, atol=1e-6)


def test_gtsam_says_the_same(rng):
    """Increments within the error of its coarser rule, covariance within a few per cent."""
    hz = 1000
    imu, _ = unit_on(np.arange(0, 2 * hz + 2) / hz, rng)
    mine = preintegrate(imu, [0.0], [1.5], BIAS)
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    parameters.setGyroscopeCovariance(NOISE.gyro**2 * np.eye(3))
    parameters.setAccelerometerCovariance(NOISE.accelerometer**2 * np.eye(3))
    parameters.setIntegrationCovariance(1e-16 * np.eye(3))
    parameters.setBiasOmegaCovariance(NOISE.gyro_walk**2 * np.eye(3))
    parameters.setBiasAccCovariance(NOISE.accelerometer_walk**2 * np.eye(3))
    b = gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3])
    theirs = gtsam.PreintegratedCombinedMeasurements(parameters, b)
    for k in range(1500):
        mean = [0.5 * (x[k] + x[k + 1]) for x in (imu.specific_force, imu.angular_rate)]
        theirs.integrateMeasurement(*mean, 1.0 / hz)
    np.testing.assert_allclose(theirs.deltaRij().matrix(), mine.R[0], atol=1e-6)
    np.testing.assert_allclose(theirs.deltaPij(), mine.p[0], atol=0.02)
    np.testing.assert_allclose(theirs.deltaVij(), mine.v[0], atol=0.02)
    order = np.r_[0:9, 12:15, 9:12]  # GTSAM has the accelerometer's bias first
    # GTSAM's is of the rotation vector, ours of a right turn; and its residual of the biases is b_i - b_j
    to_right = np.diag(np.repeat([1.0, -1.0], [9, 6]))
    to_right[:3, :3] = se3.so3_left_jacobian(-vector(mine)[:3])
    P = to_right @ theirs.preintMeasCov()[np.ix_(order, order)] @ to_right.T
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(mine.covariance[0] / np.outer(scale, scale), P / np.outer(scale, scale), atol=0.03)


def test_its_covariance_by_monte_carlo():
    """Two-sided, for all of it and by block; the error of one walk is that of its own bias at the start."""
    rng, runs, begin, end = np.random.default_rng(11), 400, 0.5, 4.25
    t = np.arange(0, 5 * 50) / 50
    noise = replace(NOISE, gyro_walk=2e-3, accelerometer_walk=0.02)
    clean, _ = unit_on(t, None)
    true = vector(preintegrate(clean, [begin], [end]))
    blocks = {"all": slice(0, 15), "φ": slice(0, 3), "p": slice(3, 6), "v": slice(6, 9), "b": slice(9, 15)}
    d2 = {name: [] for name in blocks}
    for _ in range(runs):
        imu, bias = unit_on(t, rng, noise)
        at = [np.array([np.interp(s, t, b) for b in bias.T]) for s in (begin, end)]
        pim = preintegrate(imu, [begin], [end], at[0])
        q = se3.quat_multiply(se3.matrix_to_quat(pim.R[0]) * [-1, -1, -1, 1], se3.so3_exp(true[:3]))
        e = np.concatenate([se3.so3_log(q), true[3:] - vector(pim)[3:], at[1] - at[0]])
        for name, s in blocks.items():
            d2[name].append(e[s] @ np.linalg.solve(pim.covariance[0][s, s], e[s]))
    for name, s in blocks.items():
        low, high = chi2_mean_bounds(s.stop - s.start, runs, 0.999)
        assert low < np.mean(d2[name]) < high, name


def test_what_it_refuses(rng):
    imu, _ = unit_on(np.arange(0, 100) / 100, rng)
    with pytest.raises(DataError, match="not inside the readings"):
        preintegrate(imu, [0.5], [1.5])
    with pytest.raises(DataError, match="not inside the readings"):
        preintegrate(imu, [0.5], [0.5])
    with pytest.raises(ConfigError, match="without noise"):
        preintegrate(replace(imu, noise=replace(NOISE, gyro=0.0)), [0.1], [0.5])
    with pytest.raises(DataError, match="time does not increase at record 2"):
        replace(imu.take(slice(0, 3)), times=[0.0, 1.0, 0.5])
    fixed = preintegrate(replace(imu, noise=replace(NOISE, gyro_walk=0.0, gyro_bias=0.0)), [0.1], [0.9])
    assert np.linalg.eigvalsh(fixed.covariance[0]).min() > 0


def test_pauses():
    t = np.array([0.0, 0.1, 0.2, 0.9, 1.0, 1.1])
    seen = longest_pause(t, np.array([0.05, 0.15, 0.95, 0.3]), np.array([0.15, 0.25, 1.05, 0.4]))
    np.testing.assert_allclose(seen, [0.1, 0.7, 0.1, 0.7])


def test_a_force_is_seen_from_the_middle(rng):
    """Of a unit that turns where it stands the mean is gravity in its own axes; still is what does not turn."""
    t = np.arange(0, 300) / 100
    q = se3.so3_exp(np.outer(t, [0.3, 0.9, -0.2]))
    force = se3.quat_rotate(q * [-1, -1, -1, 1], [0.0, 0.0, GRAVITY])
    imu = Imu(
        times=t, angular_rate=np.tile([0.3, 0.9, -0.2], (300, 1)), specific_force=force, noise=NOISE, T_base_imu=MOUNT
    )
    seen, count, still = mean_force(imu, np.array([1.5]), 0.5)
    np.testing.assert_allclose(seen[0], force[150], atol=0.03)
    assert 99 <= count[0] <= 101
    assert not still[0]  # the forces change
    quiet = replace(imu, angular_rate=np.zeros((300, 3)), specific_force=np.tile([0, 0, GRAVITY], (300, 1)))
    rough = quiet.angular_rate + NOISE.gyro * 10 * rng.standard_normal((300, 3))
    assert mean_force(replace(quiet, angular_rate=rough), np.array([1.5]), 0.5)[2][0]
    assert not mean_force(replace(quiet, angular_rate=10 * rough), np.array([1.5]), 0.5)[2][0]


def test_a_ring_is_what_it_says(rng):
    """The generator of these tests itself: truth, leaning bases, and paths that are near it."""
    made = ring(rng, submaps=2)
    for s in made.submaps:
        seen, true = s.trajectory.poses, made.truth(s.trajectory.times)
        start = se3.se3_compose(true[0], se3.se3_inverse(seen[0]))
        off = se3.se3_log(se3.se3_between(se3.se3_compose(start, seen[-1]), true[-1]))
        assert np.abs(off).max() < 0.3
