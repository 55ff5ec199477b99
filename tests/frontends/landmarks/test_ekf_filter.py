"""The compressed EKF equals the dense textbook filter: update, association, provisional landmarks, range-only."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, CovarianceError
from graphslam.core.geometry import se2_compose
from graphslam_frontends.landmarks import ekf_filter
from graphslam_frontends.landmarks.ekf_config import EkfFilterConfig
from graphslam_frontends.landmarks.ekf_filter import EkfMap
from graphslam_frontends.landmarks.ekf_kernels import linearise_observation
from tests.reference.ekf_slam import DenseEkf, DenseEkfByDistance, measurement

SENSOR = np.array([0.6, -0.3, 0.1])
FOV = (-np.pi / 2, np.pi / 2)
Q = np.diag([0.05, 0.03, 0.01]) ** 2
NONE = np.zeros(0, dtype=np.int64)


def drive(seed, *, scans=160, laps=1.4, landmarks=30, clutter=0.0, ranges_only=0.0, sigma=(0.1, 0.02)):
    """A circle past landmarks on either side, seen more than once: (u, observations, ids) per scan, and the truth."""
    rng = np.random.default_rng(seed)
    radius, turn = 20.0, laps * 2 * np.pi / scans
    u = np.array([radius * turn, 0.0, turn])
    angle = rng.uniform(0, 2 * np.pi, landmarks)
    out = radius + rng.uniform(2, 6, landmarks) * rng.choice([-1, 1], landmarks)
    world = np.column_stack([out * np.sin(angle), radius - out * np.cos(angle)])
    x, log = np.zeros(3), []
    for _ in range(scans):
        x = se2_compose(se2_compose(x, u), rng.multivariate_normal(np.zeros(3), Q))
        rows, ids = [], []
        for j, l in enumerate(world):
            z = measurement(np.concatenate([x, l]), 0, SENSOR)[0]
            if z[0] < 9 and FOV[0] < z[1] < FOV[1] and rng.random() < 0.9:
                z = z + np.array(sigma) * rng.standard_normal(2)
                bearing = rng.random() >= ranges_only
                rows.append([z[0], z[1] if bearing else 0.0, sigma[0] ** 2, sigma[1] ** 2 if bearing else np.inf])
                ids.append(j)
        for _ in range(rng.poisson(clutter)):
            rows.append([rng.uniform(1, 9), rng.uniform(*FOV), sigma[0] ** 2, sigma[1] ** 2])
            ids.append(-1)
        log.append((u, np.array(rows).reshape(-1, 4), np.array(ids, dtype=np.int64)))
    return log, x, world


@pytest.fixture(autouse=True)
def small_margin(monkeypatch):
    monkeypatch.setattr("graphslam_frontends.landmarks.ekf_filter.ACTIVE_MARGIN", 4.0)


def ekf(**config):
    return EkfMap(EkfFilterConfig(max_range=10.0, **config), SENSOR, FOV, np.inf)


@pytest.fixture
def always_compressed(monkeypatch):
    """Also a map of a few landmarks has a passive part."""
    monkeypatch.setattr(ekf_filter, "_SMALL", 4)


@pytest.mark.parametrize("row", range(2))
def test_jacobian_equals_finite_differences(row):
    x = np.array([1.0, -2.0, 0.7, 5.0, 3.0, -1.0, 4.0])
    H, nu, h = np.empty((2, 5)), np.empty(2), np.empty(12)
    for k in range(2):
        z = np.array([4.0, 0.3, 0.1, 0.1])
        linearise_observation(x, k, z, SENSOR, h, H, nu)
        columns = [0, 1, 2, 3 + 2 * k, 4 + 2 * k]
        for i, c in enumerate(columns):
            e = np.zeros(7)
            e[c] = 1e-6
            slope = (measurement(x + e, k, SENSOR)[0] - measurement(x - e, k, SENSOR)[0])[row] / 2e-6
            assert H[row, i] == pytest.approx(slope, abs=1e-8)
        assert nu[0] == pytest.approx(z[0] - measurement(x, k, SENSOR)[0][0])


@pytest.mark.parametrize("ranges_only", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(2))
def test_compressed_filter_equals_the_dense_one(seed, ranges_only, always_compressed):
    log, _, _ = drive(seed, ranges_only=ranges_only)
    m, slow = ekf(association="known"), DenseEkf(SENSOR)
    for k, (u, obs, ids) in enumerate(log):
        m.step(u, Q, obs, ids)
        slow.known_step(u, Q, obs, list(ids))
        np.testing.assert_allclose(m.pose, slow.x[:3], atol=1e-10)  # at every scan, without folding in
        np.testing.assert_allclose(m.pose_covariance, slow.P[:3, :3], atol=1e-12)
        if k in (70, len(log) - 1):
            slots = m.landmarks(1)
            mean, P = m.joint(slots)
            key_of = {f: key for key, f in m.keys.items()}
            assert [key_of[f] for f in m.founded[slots]] == slow.names
            np.testing.assert_allclose(mean, slow.x, atol=1e-9)
            np.testing.assert_allclose(P, slow.P, atol=1e-11)
    assert m.folds > 5  # or nothing was compressed
    assert m.unfounded > 0 if ranges_only else m.unfounded == 0


@pytest.mark.parametrize("seed", range(3))
def test_nearest_neighbour_filter_equals_the_dense_one_with_clutter(seed, always_compressed):
    log, _, _ = drive(seed, scans=90, laps=0.8, landmarks=14, clutter=0.7)
    m = ekf(association="nearest")
    reach, margin = 0.9 * 10.0, np.deg2rad(1.0)
    slow = DenseEkfByDistance(
        SENSOR, gate=11.8, gate_new=30.0, confirm_hits=3, drop_misses=5, drop_scans=10, reach=reach,
        view=(FOV[0] + margin, FOV[1] - margin),
    )  # fmt: skip
    for u, obs, _ in log:
        m.step(u, Q, obs, np.full(len(obs), -1))
        slow.step(u, Q, obs)
    assert m.foundings == slow.founded
    assert slow.founded > len(slow.names) + 5  # some were dropped
    np.testing.assert_array_equal(m.association(), [-1 if a is None else a for a in slow.association])
    mean, P = m.joint(m.landmarks(1))
    np.testing.assert_allclose(mean, slow.x, atol=1e-9)
    np.testing.assert_allclose(P, slow.P, atol=1e-11)


@pytest.mark.parametrize("association", ["nearest", "jcbb"])
def test_what_is_active_changes_the_time_and_nothing_else(association, monkeypatch):
    """A loop closes onto passive landmarks: they must become active in time, by distance alone."""
    log, _, _ = drive(7, scans=200, clutter=0.5, ranges_only=0.2, sigma=(0.2, 0.05))
    runs = []
    for small in (4, 10_000):
        monkeypatch.setattr(ekf_filter, "_SMALL", small)
        m = ekf(association=association)
        for u, obs, _ in log:
            m.step(u, 4 * Q, obs, np.full(len(obs), -1))
        runs.append((m, m.joint(m.landmarks(2))))
    (a, (mean_a, P_a)), (b, (mean_b, P_b)) = runs
    assert a.folds > 10
    assert b.folds == 0
    np.testing.assert_array_equal(a.association(), b.association())
    np.testing.assert_allclose(mean_a, mean_b, atol=1e-9)
    np.testing.assert_allclose(P_a, P_b, atol=1e-10)


def judged(m, x, world):
    """NEES per degree of freedom of pose and landmarks together, and the extreme eigenvalues of their covariance."""
    slots = m.landmarks(1)
    mean, P = m.joint(slots)
    np.testing.assert_array_equal(P, P.T)
    key_of = {f: key for key, f in m.keys.items()}
    d = np.concatenate([x, world[[key_of[f] for f in m.founded[slots]]].ravel()]) - mean
    d[2] = (d[2] + np.pi) % (2 * np.pi) - np.pi
    return d @ np.linalg.solve(P, d) / len(d), np.linalg.eigvalsh(P)[[0, -1]]


def test_covariance_stays_positive_definite_over_a_loop_closure(always_compressed):
    """A sensor much better than the motion: what broke an unsymmetric update."""
    for seed in range(5):
        log, x, world = drive(100 + seed, sigma=(0.01, 0.002))
        m = ekf(association="known")
        for u, obs, ids in log:
            m.step(u, Q, obs, ids)
        low, high = judged(m, x, world)[1]
        assert low > 1e-8 * high


def test_filter_is_consistent_while_its_heading_is_known(always_compressed):
    """A quarter of the circle, where linearisation costs nothing yet: mean NEES inside two-sided bounds."""
    nees = []
    for seed in range(60):
        log, x, world = drive(200 + seed, scans=40, laps=0.25)
        m = ekf(association="known")
        for u, obs, ids in log:
            m.step(u, Q, obs, ids)
        nees.append(judged(m, x, world)[0])
    # about 20 degrees of freedom each: standard error of the mean sqrt(2 / (60 · 20)) = 0.04; three either side
    assert 0.88 < np.mean(nees) < 1.12


def test_range_only_counts_one_equation_and_one_degree_of_freedom():
    m = ekf(association="known", outlier_gate=11.8)
    seen = np.array([[5.0, 0.2, 0.01, 0.0004]])
    m.step(np.zeros(3), Q, seen, np.array([3]))
    m.step(np.zeros(3), 1e-8 * Q, np.array([[5.05, 0.0, 0.01, np.inf]]), np.array([3]))
    assert m.nis_dof == 1
    assert m.outliers == 0
    before = m.joint(m.landmarks(1))
    # the range variance is 0.01 of the observation and 0.005 of the landmark: 0.38 m is d² 9.6, outside the gate of one
    # degree of freedom (8.98) and inside that of two (11.8)
    r = np.linalg.norm(before[0][3:] - SENSOR[:2])
    m.step(np.zeros(3), 1e-8 * Q, np.array([[r + 0.38, 0.0, 0.01, np.inf]]), np.array([3]))
    assert m.outliers == 1
    assert m.nis_dof == 1
    m.step(np.zeros(3), 1e-8 * Q, np.array([[r + 0.35, 0.0, 0.01, np.inf]]), np.array([3]))
    assert m.nis_dof == 2
    # a range moves a landmark along the line of sight alone
    mean, P = m.joint(m.landmarks(1))
    sight = (before[0][3:] - SENSOR[:2]) / r
    moved = mean[3:] - before[0][3:]
    assert abs(moved @ sight) > 0.05
    assert abs(moved @ [-sight[1], sight[0]]) < 1e-3
    assert np.linalg.eigvalsh(P)[0] > 0


def test_a_landmark_seen_twice_in_a_scan_is_founded_once():
    m = ekf(association="known")
    twice = np.array([[5.0, 0.2, 0.01, 0.0004], [5.1, 0.2, 0.01, 0.0004]])
    m.step(np.zeros(3), Q, twice, np.array([0, 0]))
    np.testing.assert_array_equal(m.association(), [0, -1])
    m.step(np.zeros(3), Q, twice, np.array([0, 0]))
    np.testing.assert_array_equal(m.association(), [0, -1, 0, 0])
    assert m.hits[0] == 3


def test_bad_motion_is_named_at_once():
    m = ekf(association="known")
    seen = np.array([[5.0, 0.2, 0.01, 0.0004]])
    m.step(np.zeros(3), Q, seen, np.array([0]))
    with pytest.raises(CovarianceError, match="scan 1"):
        m.step(np.array([np.nan, 0, 0]), Q, seen, np.array([0]))
    m = ekf(association="known")
    m.step(np.zeros(3), Q, seen, np.array([0]))
    with pytest.raises(CovarianceError, match="positive definite"):
        m.step(np.zeros(3), -100 * np.eye(3), seen, np.array([0]))


@pytest.mark.parametrize(
    "bad",
    [
        {"association": "likelihood"},
        {"gate": 31.0},
        {"gate": 0.0},
        {"min_hits": 0},
        {"max_range": np.inf},
        {"outlier_gate": -1.0},
    ],
)
def test_impossible_configuration_is_refused(bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        EkfFilterConfig(**bad)
