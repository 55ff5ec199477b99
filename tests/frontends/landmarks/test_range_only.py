"""Ranges without bearings: trilateration, delayed start, mirror images, and local maps that are neither over- nor
under-confident."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.worlds import simulate
from graphslam.core.errors import ConfigError, MissingDataError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import se2_compose
from graphslam.core.log import DropCounter
from graphslam.core.random import SeedTree
from graphslam.core.records import LandmarkObservations
from graphslam_frontends.landmarks.config import DelayedInitialisation, RbpfEkfConfig, StoppingConfig
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.mirror_ambiguity import resolve_mirror_ambiguity
from graphslam_frontends.landmarks.prepare import prepare_log
from graphslam_frontends.landmarks.range_only import WaitingRanges
from graphslam_frontends.landmarks.range_only_kernels import (
    FIT_CHI2,
    FIT_LENGTH,
    FIT_LOG_LIKELIHOOD,
    FIT_MARGIN,
    FIT_MEAN_RANGE,
    FIT_USED,
    FIT_XX,
    FIT_YY,
    circle_starts,
    trilaterate_kernel,
)
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf
from graphslam_frontends.landmarks.summarise import SmoothingProblem
from graphslam_frontends.odometry.motion import MotionNoise
from graphslam_studies.evaluate.submap_consistency import submap_nees
from graphslam_studies.frontends.rbpf_slam import RbpfSlamConfig, rbpf_snapshots
from tests.reference import trilateration as slow

BEACON = np.array([6.0, 9.0])
SIGMA = 0.1


def bend(k=12):
    """Places along a curve: no mirror image fits."""
    a = np.linspace(0, 1.6, k)
    return np.column_stack([12 * np.sin(a), 12 * (1 - np.cos(a))])


def straight(k=12):
    return np.column_stack([np.linspace(0, 12, k), np.zeros(k)])


def measured(anchors, rng, sigma=SIGMA):
    return np.hypot(*(BEACON - anchors).T) + sigma * rng.standard_normal(len(anchors))


def fitted(anchors, ranges, variances, limit=np.inf):
    starts = circle_starts(anchors, ranges, limit)
    fit, used, minima = np.empty(FIT_LENGTH), np.zeros(len(ranges), bool), np.empty((len(starts), 3))
    found = trilaterate_kernel(anchors, ranges, variances, limit, starts, fit, used, minima)
    return found, fit, used, minima[:found]


@pytest.mark.parametrize("path", [bend, straight])
@pytest.mark.parametrize("seed", range(4))
def test_trilateration_equals_its_slow_twin(path, seed):
    rng = np.random.default_rng(seed)
    anchors, variances = path(), rng.uniform(0.5, 2.0, 12) * SIGMA**2
    ranges = measured(anchors, rng)
    found, fit, used, minima = fitted(anchors, ranges, variances)
    expected = slow.all_minima(anchors, ranges, variances)
    assert found == len(expected)
    by_y = lambda m: m[np.argsort(m[:, 1])]  # noqa: E731 (mirror images of a straight path fit equally well)
    np.testing.assert_allclose(by_y(minima), by_y(expected), atol=2e-4)
    best = fit[:2]
    assert slow.residuals(best, anchors, ranges, variances) @ slow.residuals(
        best, anchors, ranges, variances
    ) == pytest.approx(expected[0, 2], abs=1e-6)
    C = slow.covariance(best, anchors, ranges, variances)
    np.testing.assert_allclose(fit[FIT_XX : FIT_YY + 1], C[[0, 0, 1], [0, 1, 1]], rtol=2e-3)
    assert fit[FIT_CHI2] == pytest.approx(expected[0, 2], rel=1e-5)
    assert fit[FIT_MARGIN] == pytest.approx(
        expected[1, 2] - expected[0, 2] if found > 1 else np.inf, rel=1e-3, abs=1e-3
    )
    assert fit[FIT_USED] == used.sum() == 12
    assert fit[FIT_MEAN_RANGE] == pytest.approx(ranges.mean())
    exact = slow.log_evidence(best, np.sqrt(C.trace()), anchors, ranges, variances)
    assert fit[FIT_LOG_LIKELIHOOD] == pytest.approx(exact, abs=0.02)


def test_straight_path_has_a_mirror_image_and_a_bend_has_none():
    rng = np.random.default_rng(0)
    assert fitted(straight(), measured(straight(), rng), np.full(12, SIGMA**2))[1][FIT_MARGIN] < 1e-6
    assert fitted(bend(), measured(bend(), rng), np.full(12, SIGMA**2))[1][FIT_MARGIN] > 100


def test_trilateration_is_consistent():
    rng = np.random.default_rng(7)
    nees = []
    for _ in range(1000):
        anchors = bend()
        _, fit, _, _ = fitted(anchors, measured(anchors, rng), np.full(12, SIGMA**2))
        C = np.array([[fit[2], fit[3]], [fit[3], fit[4]]])
        nees.append((BEACON - fit[:2]) @ np.linalg.solve(C, BEACON - fit[:2]))
    low, high = chi2_mean_bounds(2, 1000, 0.999)
    assert low < np.mean(nees) < high


def test_outliers_are_left_out_and_named():
    rng = np.random.default_rng(1)
    anchors = bend(20)
    ranges = measured(anchors, rng)
    ranges[[3, 8, 15]] += [4.0, 9.0, 2.5]  # multipath is always too long
    found, fit, used, _ = fitted(anchors, ranges, np.full(20, SIGMA**2), limit=10.8)
    assert found
    np.testing.assert_array_equal(np.flatnonzero(~used), [3, 8, 15])
    C = np.array([[fit[2], fit[3]], [fit[3], fit[4]]])
    assert (BEACON - fit[:2]) @ np.linalg.solve(C, BEACON - fit[:2]) < 14
    plain = fitted(anchors, ranges, np.full(20, SIGMA**2))[1]
    assert np.hypot(*(BEACON - plain[:2])) > 4 * np.hypot(*(BEACON - fit[:2]))


def wait(path, config=None, particles=3, rng=None):
    """Feed one beacon range by range; returns the buffer and what started after which range."""
    rng = rng or np.random.default_rng(0)
    waiting = WaitingRanges(particles, config or DelayedInitialisation(), np.inf)
    ranges, started = measured(path, rng), None
    for k, (p, r) in enumerate(zip(path, ranges)):
        waiting.add(np.array([4]), np.array([k]), np.array([r]), np.array([SIGMA**2]), np.tile(p, (particles, 1)))
        for started in waiting.ready(np.array([4]), np.full(particles, 1 / particles)):
            return waiting, k + 1, started
    return waiting, len(path), started


def test_a_beacon_waits_until_it_is_sharp_and_alone():
    waiting, k, start = wait(bend(40))
    assert start is not None
    assert 5 < k < 40  # not with the least number, since the first metres are nearly straight
    assert len(waiting) == 0
    np.testing.assert_array_equal(start.observations, np.arange(k))
    assert start.solved.all()
    assert np.hypot(*(start.mean[0] - BEACON)) < 1.0
    waiting, _, start = wait(straight(40))
    assert start is None
    assert len(waiting) == 40
    np.testing.assert_array_equal(waiting.slots, [4])
    assert wait(bend(40), DelayedInitialisation(spread=0.01))[1] > k
    for bad in ({"min_ranges": 2}, {"spread": 0.0}, {"support": 1.5}):
        with pytest.raises(ConfigError):
            DelayedInitialisation(**bad)


def test_every_range_is_spent_once():
    """With the path known, the landmark after any number of ranges is the least-squares fit of all of them."""
    rng = np.random.default_rng(2)
    anchors = bend(60)
    ranges = measured(anchors, rng)
    config = RbpfEkfConfig(particles=1, association="known")
    p = ParticleSet(config, np.zeros(3), (-np.pi, np.pi), 100.0, np.random.default_rng(0))
    before = np.zeros(2)
    for a, r in zip(anchors, ranges):
        p.step(
            np.array([*(a - before), 0.0]), np.eye(3) * 1e-16, np.array([[r, 0.0, SIGMA**2, np.inf]]), np.zeros(1, int)
        )
        before = a
    assert p.hits[0, 0] == 60
    np.testing.assert_array_equal(p.assoc[0, :60], 0)
    _, fit, _, _ = fitted(anchors, ranges, np.full(60, SIGMA**2))
    np.testing.assert_allclose(p.mean[0, 0], fit[:2], atol=0.02)
    np.testing.assert_allclose(p.cov[0, 0], fit[2:5], rtol=0.1)


def test_paths_that_explain_the_ranges_gain_weight(monkeypatch):
    """Two particles, one of which drifted: the ranges that make the landmark say so."""
    config = RbpfEkfConfig(particles=2, association="known", ess_fraction=1e-6)
    monkeypatch.setattr("graphslam_frontends.landmarks.filter.DELAYED", DelayedInitialisation(support=0.4))
    p = ParticleSet(config, np.zeros(3), (-np.pi, np.pi), 100.0, np.random.default_rng(0))
    anchors, rng = bend(40), np.random.default_rng(3)
    before, started = np.zeros(2), False
    for a, r in zip(anchors, measured(anchors, rng)):
        p.pose[1, :2] += [0.05, -0.05]  # it believes in another path
        p.step(
            np.array([*(a - before), 0.0]), np.eye(3) * 1e-16, np.array([[r, 0.0, SIGMA**2, np.inf]]), np.zeros(1, int)
        )
        before = a
        if not started:
            assert p.weights[0] == 0.5 or p.hits[0, 0] > 0  # nothing is charged before
        started = p.hits[0, 0] > 0
    assert started
    assert p.weights[0] > 0.9


def blind(log):
    """The same log with the bearings taken away."""
    z = log["landmarks"]
    ranges = LandmarkObservations.range_only(
        times=z.times, offsets=z.offsets, ranges=z.ranges, range_sigma=z.sigmas[:, 0], ids=z.ids, max_range=z.max_range
    )
    return replace(log, streams={**log.streams, "landmarks": ranges})


@pytest.fixture(scope="module")
def judged():
    """Local maps of the good sensor from ranges alone, with their NEES."""
    motion = MotionNoise(speed=0.3, steering=np.deg2rad(3.0))
    config = RbpfEkfConfig(association="known", motion=motion, stopping=StoppingConfig(scans=60), min_hits=3)
    submaps, results = [], []
    for seed in range(2):
        log = blind(simulate("landmark-field", seed=seed, preset="C", layout_seed=1)).slice(0.0, 400.0)
        mine = [s for s in RbpfEkf(config).submaps(log, seed=SeedTree(seed)) if s.report["scans"] == 60]
        submaps += mine
        results += [submap_nees(s, log.truth) for s in mine]
    return submaps, results


def test_range_only_maps_are_consistent(judged):
    """Joint, exit pose and landmarks: none overconfident, none too modest."""
    _, results = judged
    assert len(results) > 60
    dof = sum(r.joint_dof for r in results)
    assert dof > 700
    low, high = chi2_mean_bounds(dof, 1, 0.999)
    assert low < sum(r.joint for r in results) < high
    low, high = chi2_mean_bounds(3, len(results), 0.999)
    assert low < np.mean([r.exit for r in results]) < high
    # landmarks of one map share its drift: their median is robust to that, and near the χ² median of 1.386
    assert 1.0 < np.median(np.concatenate([r.landmarks for r in results])) < 1.8


def test_ranges_alone_make_landmarks_and_the_rest_is_counted(judged):
    submaps, _ = judged
    assert np.mean([len(s.landmarks) for s in submaps]) > 3
    for s in submaps:
        r = s.report
        assert r["beacons_without_landmark"] > 0
        assert r["ranges_unspent"] > 0
        assert r["used"] + r["trimmed"] + r["not_associated"] == r["observations"]
        assert r["not_associated"] >= r["ranges_unspent"]
        assert r["chi2_bearing"] == 0.0
        assert r["dof"] == r["used"] - 2 * len(s.landmarks)


def drive(path):
    """A smoothing problem along ``path`` with exact odometry of 2 cm and 5 mrad, one beacon from every place."""
    rng = np.random.default_rng(5)
    Q = np.diag([0.02, 0.02, 0.005]) ** 2
    poses = np.column_stack([path, np.zeros(len(path))])
    u = np.diff(np.vstack([np.zeros(3), poses]), axis=0)
    u = se2_compose(u, rng.multivariate_normal(np.zeros(3), Q, len(u)))
    z = np.column_stack(
        [measured(path, rng), np.zeros(len(path)), np.full(len(path), SIGMA**2), np.full(len(path), np.inf)]
    )
    k = np.arange(len(path))
    problem = SmoothingProblem(u, np.tile(Q, (len(u), 1, 1)), k, np.zeros(len(k), int), z, np.zeros(3), 0.0, 1)
    return problem, poses


def mirrored(point, a, b):
    d = (b - a) / np.hypot(*(b - a))
    return a + 2 * d * (d @ (point - a)) - (point - a)


def test_a_landmark_in_the_wrong_mirror_is_put_right():
    path = bend(30)
    path[:, 1] *= 0.25  # nearly straight: the mirror image is a minimum of its own
    problem, poses = drive(path)
    wrong = problem.smooth(poses, mirrored(BEACON, path[0], path[-1])[None])
    assert np.hypot(*(wrong.gaussian.mean[3:] - BEACON)) > 5
    resolved = resolve_mirror_ambiguity(problem, wrong, DelayedInitialisation())
    assert (resolved.swapped, resolved.ambiguous) == (1, 0)
    assert resolved.smoothed.chi2 < wrong.chi2 - 16
    right = problem.smooth(poses, BEACON[None])
    np.testing.assert_allclose(resolved.smoothed.gaussian.mean, right.gaussian.mean, atol=1e-3)
    again = resolve_mirror_ambiguity(problem, right, DelayedInitialisation())
    assert again.swapped == again.ambiguous == again.vague == 0
    assert again.smoothed is right


def test_a_landmark_that_cannot_be_distinguished_from_its_mirror_goes():
    problem, poses = drive(straight(30))
    resolved = resolve_mirror_ambiguity(problem, problem.smooth(poses, BEACON[None]), DelayedInitialisation())
    assert resolved.ambiguous == 1
    assert len(resolved.smoothed.gaussian.mean) == 3
    assert not resolved.smoothed.landmark_kept.any()
    assert not resolved.smoothed.kept.any()


def test_a_landmark_that_the_free_path_leaves_vague_goes():
    problem, poses = drive(bend(30))
    first = problem.smooth(poses, BEACON[None])
    sigma = np.sqrt(np.linalg.eigvalsh(first.gaussian.covariance[3:, 3:])[-1])
    ratio = sigma / problem.observations[:, 0].mean()
    assert resolve_mirror_ambiguity(problem, first, DelayedInitialisation(spread=1.05 * ratio)).vague == 0
    assert resolve_mirror_ambiguity(problem, first, DelayedInitialisation(spread=0.2 * ratio)).vague == 1


def test_single_map_filter_takes_ranges_too():
    log = blind(simulate("landmark-field", seed=0, preset="C", layout_seed=1)).slice(0.0, 50.0)
    config = RbpfSlamConfig(association="known", particles=30)
    *_, end = rbpf_snapshots(log, config, seed=SeedTree(0), cuts=[100, 200])
    truth = dict(zip(log.truth.landmark_ids, log.truth.landmarks))
    error = end.landmarks - [truth[i] for i in end.landmark_ids]
    assert len(end) > 15
    assert np.median(np.hypot(*error.T)) < 3.0
    assert np.hypot(*(end.pose - log.truth.trajectory.interpolate([end.time])[0])[:2]) < 5.0


def test_ranges_without_identities_are_refused():
    log = blind(simulate("landmark-field", seed=0, preset="quick"))
    with pytest.raises(MissingDataError, match="ranges alone"):
        prepare_log(log, RbpfEkfConfig(association="likelihood"), DropCounter())
    noise = RbpfEkfConfig(association="known").noise
    assert noise is None
    data = prepare_log(log, RbpfEkfConfig(association="known"), DropCounter())
    assert np.isinf(data.rows[:, 3]).all()
    assert np.isinf(data.smoothing_variances[:, 1]).all()
