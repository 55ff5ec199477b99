"""Constant errors beside a smoothed submap: against smoothing again what was measured with them, and a Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.charts import map_difference
from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_log, wrap_angle
from graphslam.core.sensor_biases import SensorBiases
from graphslam_frontends.landmarks.config import SensorBiasConfig
from graphslam_frontends.landmarks.sensor_biases import estimate_sensor_biases
from graphslam_frontends.landmarks.summarise import SmoothingProblem, SmoothingResult
from tests.frontends.landmarks.test_smoothing import SENSOR, Q, drive
from tests.reference.fastslam import measure

SECONDS = np.full(12, 0.4)


def measured_with(g, u, z, config):
    """What would have been measured with constant errors ``g`` less, slowly and one by one."""
    names, _ = config.chosen()
    u, z, sensor = u.copy(), z.copy(), SENSOR.copy()
    xi = se2_log(u)
    metres = np.hypot(xi[:, 0], xi[:, 1])
    weight = metres if names[0] == "turn_per_metre" else SECONDS
    xi[:, :2] *= np.exp(-g[1])
    xi[:, 2] -= g[0] * weight
    z[:, 0] -= g[2]
    if names[3] == "range_scale":
        z[:, 0] = (z[:, 0]) * np.exp(-g[3])
    else:
        sensor[2] += g[3]
        sensor[:2] += g[4:]
    return se2_exp(xi), z, sensor


def again(s: SmoothingResult, g, u, k, j, z, config) -> SmoothingResult:
    u, z, sensor = measured_with(g, u, z, config)
    return SmoothingProblem(u, np.tile(Q, (len(u), 1, 1)), k, j, z, sensor).smooth(s.poses, s.landmarks)


def nearly_exact(seed):
    """A drive whose noise is a fiftieth of what is stated: Gauss-Newton's matrix is then that of the whole cost."""
    rng = np.random.default_rng(seed)
    truth, landmarks, u, k, j, z = drive(rng)
    exact = np.array([measure(truth[a], SENSOR, landmarks[b]) for a, b in zip(k, j)])
    z[:, :2] = exact + 0.02 * np.sqrt(z[:, 2:]) * rng.standard_normal(exact.shape)
    u = se2_between(np.vstack([np.zeros(3), truth[:-1]]), truth)
    u = se2_compose(u, 0.02 * np.sqrt(np.diag(Q)) * rng.standard_normal(u.shape))
    return truth, landmarks, u, k, j, z


CONFIGS = {
    "wheels and sensor": SensorBiasConfig(),
    "a vehicle that steers": SensorBiasConfig(yaw_bias=0.0, turn_per_metre=0.02),
    "ranges alone": SensorBiasConfig(sensor_yaw=0.0, range_scale=0.05, mount=0.0),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_responses_are_those_of_smoothing_again(name):
    config = CONFIGS[name]
    truth, landmarks, u, k, j, z = nearly_exact(1)
    if name == "ranges alone":
        z[:, 1], z[:, 3] = 0.0, np.inf
    s = SmoothingProblem(u, np.tile(Q, (len(u), 1, 1)), k, j, z, SENSOR).smooth(truth, landmarks)
    found = estimate_sensor_biases(config, s, SECONDS, None, base=False)
    step = np.full(6, 2e-4)
    # what the residuals say: the least cost for each g is a parabola, C - 2 score g + g' information g
    cost = lambda g: again(s, g, u, k, j, z, config).chi2  # noqa: E731
    for a in range(len(found.sigmas) if name != "ranges alone" else 4):
        g = np.zeros(6)
        g[a] = step[a]
        up, down = (again(s, x, u, k, j, z, config) for x in (g, -g))
        moved = map_difference(up.gaussian.mean, down.gaussian.mean, "cartesian") / (2 * step[a])
        np.testing.assert_allclose(found.response[:, a], moved, rtol=0.05, atol=0.05 * np.abs(moved).max() + 1e-6)
        path = se2_log(se2_between(down.poses, up.poses)) / (2 * step[a])
        np.testing.assert_allclose(found.path[:, :, a], path, rtol=0.05, atol=0.05 * np.abs(path).max() + 1e-6)
        score = -(up.chi2 - down.chi2) / (4 * step[a])
        scale = np.sqrt(found.information[a, a])
        assert found.score[a] == pytest.approx(score, abs=0.15 * scale)
        bent = (up.chi2 + down.chi2 - 2 * s.chi2) / (2 * step[a] ** 2)
        assert found.information[a, a] == pytest.approx(bent, rel=0.1)
    g = np.array([1.0, -1.0, 1.0, 1.0, 0.0, 0.0]) * step
    assert cost(g) - cost(np.zeros(6)) == pytest.approx(
        -2 * found.score @ g + g @ found.information @ g, abs=0.1 * (g @ found.information @ g) + 0.02
    )


def test_likelihood_is_the_score_and_the_information():
    truth, landmarks, u, k, j, z = drive(np.random.default_rng(2))
    s = SmoothingProblem(u, np.tile(Q, (len(u), 1, 1)), k, j, z, SENSOR).smooth(truth, landmarks)
    found = estimate_sensor_biases(SensorBiasConfig(), s, SECONDS, None, base=True)
    R, d = found.likelihood()
    np.testing.assert_allclose(R.T @ R, found.information, rtol=1e-6, atol=1e-6 * found.information.max())
    np.testing.assert_allclose(R.T @ d, found.score, rtol=1e-6, atol=1e-6 * np.abs(found.score).max())
    assert np.all(found.path[0] == 0.0)
    assert len(found.path) == len(s.poses) + 1


def test_two_names_for_one_error_are_refused():
    with pytest.raises(ConfigError, match="cannot be estimated together"):
        SensorBiasConfig(turn_per_metre=0.1)
    with pytest.raises(ConfigError, match="range_offset"):
        SensorBiasConfig(range_offset=-1.0)


def erring(log, g):
    """A simulated log whose wheels turn ``g[0]`` rad/s too much and drive ``e^g[1]`` too far, with ranges ``g[2]`` too
    long and a sensor turned by ``g[3]`` to the left, ``g[4]`` further ahead and ``g[5]`` further to the left."""
    odometry, seen = log["odometry"], log["landmarks"]
    xi = se2_log(odometry.increments)
    dt = np.diff(odometry.times, prepend=odometry.times[0])
    xi[:, 2] += g[0] * dt * (np.abs(xi).max(axis=1) > 0)
    xi[:, :2] *= np.exp(g[1])
    bearings = wrap_angle(seen.bearings - g[3])
    # a sensor that stands elsewhere than it says: the log says it stands where it does less g
    mount = seen.T_base_sensor - np.array([g[4], g[5], 0.0])
    streams = {
        "odometry": replace(odometry, increments=se2_exp(xi)),
        "landmarks": replace(seen, ranges=seen.ranges + g[2], bearings=bearings, T_base_sensor=mount),
    }
    return replace(log, streams=streams)


def figures(log, biases, seed):
    options = {
        "frontend": {"association": "known", "particles": 5, "stopping": {"max_distance": 15.0}, "biases": biases},
        "backend": {"associate": False, "merge_every": 0},
        "calibrate": {"use": "none"},
    }
    return gs.run(log, frontend="rbpf-ekf", solver="batch", config=options, seed=seed, progress=False)


def test_constant_errors_are_found_with_the_map_and_its_covariances_know_of_them():
    from graphslam_studies.calibration_robot import draw_robot
    from graphslam_studies.calibration_robot import drive as drawn

    scores, nees, without = [], [], []
    for seed in range(40, 56):
        rng = np.random.default_rng(seed)
        robot = replace(draw_robot(seed), yaw_bias=0.0, distance_scale=1.0, range_offset=0.0, sensor_yaw=0.0, clock=0.0)
        log = drawn(robot, seed, 60.0)
        odometry, seen = log["odometry"], log["landmarks"]  # their σ are stated four times too small
        log = replace(
            log,
            streams={
                "odometry": replace(odometry, covariances=16.0 * odometry.covariances),
                "landmarks": replace(seen, sigmas=4.0 * seen.sigmas),
            },
        )
        g = np.array([0.005, 0.02, 0.05, 0.02, 0.05, 0.05]) * rng.standard_normal(6)
        run = figures(erring(log, g), {"mount": 0.2}, seed)
        found, P = run.graph.sensor_biases()
        scores.append((found - g) @ np.linalg.solve(P, found - g) / 6.0)
        value = run.metrics.set_index("key")["value"]
        nees.append((value["nees_aligned_poses_per_dof"] + value["nees_aligned_landmarks_per_dof"]) / 2)
        value = figures(erring(log, g), None, seed).metrics.set_index("key")["value"]
        without.append((value["nees_aligned_poses_per_dof"] + value["nees_aligned_landmarks_per_dof"]) / 2)
    assert 0.62 < np.mean(scores) < 1.5  # 96 degrees of freedom, 99.8 %; with covariances halved it is two
    assert 0.7 < np.mean(nees) < 1.4
    assert np.median(without) > 1.6


def test_biases_refuse_what_does_not_fit():
    good = {
        "names": SensorBiasConfig().chosen()[0], "sigmas": np.ones(6),
        "response": np.zeros((5, 6)), "score": np.zeros(6), "information": np.eye(6), "path": np.zeros((3, 3, 6)),
        "points": np.zeros((0, 6)),
    }  # fmt: skip
    SensorBiases(**good)
    for name, bad in {
        "sigmas": np.zeros(6),
        "information": np.triu(np.ones((6, 6))),
        "score": np.full(6, np.nan),
    }.items():
        with pytest.raises(GraphSlamError):
            SensorBiases(**{**good, name: bad})


def test_a_pose_that_errs_moves_like_its_response():
    """The trajectory of a solution has the constant errors taken out of it."""
    truth, landmarks, u, k, j, z = drive(np.random.default_rng(3))
    s = SmoothingProblem(u, np.tile(Q, (len(u), 1, 1)), k, j, z, SENSOR).smooth(truth, landmarks)
    found = estimate_sensor_biases(SensorBiasConfig(), s, SECONDS, None, base=False)
    g = np.array([0.01, 0.02, 0.05, 0.02, 0.05, -0.05])
    other = again(s, g, u, k, j, z, SensorBiasConfig())
    moved = se2_compose(s.poses, se2_exp(found.path @ g))
    left = np.abs(se2_log(se2_between(moved, other.poses))).max()
    assert left < 0.1 * np.abs(se2_log(se2_between(s.poses, other.poses))).max()
