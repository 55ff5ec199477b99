"""The compiled smoother equals a dense least-squares twin, and its covariance a Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from graphslam.core.geometry import se2_between, se2_compose, se2_inverse, wrap_angle
from graphslam.evaluate.covariance_assessment import MAX_NONLINEARITY
from graphslam_frontends.landmarks.smoothing_kernels import second_order_bias
from graphslam_frontends.landmarks.summarise import SmoothingProblem
from tests.reference.fastslam import measure

SENSOR = np.array([0.5, 0.2, 0.1])
Q = np.diag([0.1, 0.05, 0.02]) ** 2
R = np.array([0.1, 0.02])


def drive(rng, T=12, L=7):
    u = np.tile([1.0, 0.05, 0.1], (T, 1))
    poses, x = [], np.zeros(3)
    for k in range(T):
        x = se2_compose(x, se2_compose(u[k], rng.multivariate_normal(np.zeros(3), Q)))
        poses.append(x)
    landmarks = np.random.default_rng(5).uniform(-7, 13, (L, 2))
    seen = [(k, j) for k in range(T) for j in range(L) if j <= k]  # landmarks come into view one by one
    z = np.array([[*(measure(poses[k], SENSOR, landmarks[j]) + R * rng.standard_normal(2)), *R**2] for k, j in seen])
    k, j = np.array(seen).T
    return np.array(poses), landmarks, u, k, j, z


def dense_residual(v, p, l, u, k, j, z):
    """Whitened residuals for tangent steps v on poses p and landmarks l."""
    T = len(p)
    P, l = se2_compose(p, v[: 3 * T].reshape(T, 3)), l + v[3 * T :].reshape(-1, 2)
    e = se2_compose(se2_inverse(u), se2_between(np.vstack([np.zeros(3), P[:-1]]), P))
    predicted = np.array([measure(P[a], SENSOR, l[b]) for a, b in zip(k, j)])
    d = predicted - z[:, :2]
    d[:, 1] = wrap_angle(d[:, 1])
    return np.concatenate([(e / np.sqrt(np.diag(Q))).ravel(), (d / np.sqrt(z[:, 2:])).ravel()])


@pytest.mark.parametrize("ranges_only", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_smoother_equals_dense_least_squares(seed, ranges_only):
    rng = np.random.default_rng(seed)
    truth, landmarks, u, k, j, z = drive(rng)
    if ranges_only:  # a third of the observations lose their bearing, and one landmark all of them
        blind = (rng.random(len(z)) < 0.33) | (j == 2)
        z[blind, 1], z[blind, 3] = 0.0, np.inf
    T, L = len(truth), len(landmarks)
    start_p, start_l = truth + 0.05 * rng.normal(size=truth.shape), landmarks + 0.2 * rng.normal(size=landmarks.shape)
    s = SmoothingProblem(u, np.tile(Q, (T, 1, 1)), k, j, z, SENSOR).smooth(start_p, start_l)
    assert s.converged
    p, l = s.poses, s.gaussian.mean[3:].reshape(-1, 2)
    f = lambda v: dense_residual(v, p, l, u, k, j, z)  # noqa: E731
    n = 3 * T + 2 * L
    J = np.array([(f(1e-6 * e) - f(-1e-6 * e)) / 2e-6 for e in np.eye(n)]).T
    r = f(np.zeros(n))
    assert s.chi2 == pytest.approx(r @ r, rel=1e-9)
    assert s.chi2 == pytest.approx(s.parts.sum(), rel=1e-9)
    assert s.dof == np.isfinite(z[:, 2:]).sum() - 2 * L
    assert 2 * least_squares(f, np.zeros(n)).cost == pytest.approx(s.chi2, rel=1e-7)  # it is the minimum
    C = np.linalg.inv(J.T @ J)
    for t in range(T):
        np.testing.assert_allclose(s.pose_covariances[t], C[3 * t : 3 * t + 3, 3 * t : 3 * t + 3], rtol=1e-5, atol=1e-9)
    # joint over the exit and the landmarks, exit turned from tangent to the plain vector of eq. 15
    ix = np.r_[3 * T - 3 : n]
    G = np.eye(len(ix))
    c, sn = np.cos(p[-1, 2]), np.sin(p[-1, 2])
    G[:2, :2] = [[c, -sn], [sn, c]]
    np.testing.assert_allclose(s.gaussian.covariance, G @ C[np.ix_(ix, ix)] @ G.T, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("off", [0.0, 1e-6, 1e-3])
def test_a_landmark_under_the_sensor_is_not_placed_by_its_bearing(off):
    """The derivative of a bearing by the place grows without bound: the covariance became indefinite by rounding."""
    truth, landmarks, u, k, j, z = drive(np.random.default_rng(8))
    spot = se2_compose(truth[6], SENSOR)
    landmarks[3] = spot[:2] + [off, 0.0]
    exact = np.array([measure(truth[a], SENSOR, landmarks[b]) for a, b in zip(k, j)])
    z[:, :2] = exact
    args = (u, np.tile(Q, (len(truth), 1, 1)))
    with_it = SmoothingProblem(*args, k, j, z, SENSOR).smooth(truth, landmarks)
    rest = (k != 6) | (j != 3)
    without = SmoothingProblem(*args, k[rest], j[rest], z[rest], SENSOR).smooth(truth, landmarks)
    a, b = (np.sqrt(np.diag(x.gaussian.covariance)[9:11]) for x in (with_it, without))
    assert np.all(np.linalg.eigvalsh(with_it.gaussian.covariance) > 0.0)
    assert np.all(a <= 1.05 * b)  # each where its own optimum is
    # one observation has its range, and where it is nearer than that no more than as much across
    assert np.all(a > 0.4 * np.minimum(b, R[0]))


def test_bends_are_what_samples_of_the_relative_place_show():
    """Twin: the relative place of each observation is drawn from its dense covariance, and seen."""
    truth, landmarks, u, k, j, z = drive(np.random.default_rng(4), T=8, L=4)
    s = SmoothingProblem(u, np.tile(Q, (len(truth), 1, 1)), k, j, z, SENSOR).smooth(truth, landmarks)
    p, l, T = s.poses, s.landmarks, len(truth)
    n = 3 * T + 2 * len(l)
    f = lambda v: dense_residual(v, p, l, u, k, j, z)  # noqa: E731
    J = np.array([(f(1e-6 * e) - f(-1e-6 * e)) / 2e-6 for e in np.eye(n)]).T
    C = np.linalg.inv(J.T @ J)

    def place(v, o):  # of the landmark in the frame of its sensor
        at = se2_compose(se2_compose(p[k[o]], v[3 * k[o] : 3 * k[o] + 3]), SENSOR)
        d = l[j[o]] + v[3 * T + 2 * j[o] :][:2] - at[:2]
        c, sn = np.cos(at[2]), np.sin(at[2])
        return np.array([c * d[0] + sn * d[1], -sn * d[0] + c * d[1]])

    found, rng = second_order_bias(p, l, s.evidence), np.random.default_rng(5)
    for o in range(0, len(k), 5):
        F = np.array([(place(1e-6 * e, o) - place(-1e-6 * e, o)) / 2e-6 for e in np.eye(n)]).T
        step = rng.multivariate_normal(np.zeros(2), F @ C @ F.T, 200_000)
        q = place(np.zeros(n), o)
        both = np.stack([q + step, q - step])  # first orders cancel
        r, b = np.linalg.norm(both, axis=2), np.arctan2(both[..., 1], both[..., 0])
        by = np.column_stack([r.mean(axis=0) - np.linalg.norm(q), wrap_angle(b - np.arctan2(q[1], q[0])).mean(axis=0)])
        error = by.std(axis=0) / np.sqrt(len(by))
        np.testing.assert_array_less(np.abs(found[o] - by.mean(axis=0)), 5.0 * error + 0.01 * np.abs(found[o]))
        assert found[o, 0] > 10.0 * error[0]  # the samples do tell it from nothing


def test_maps_bend_where_bearings_are_vague_beside_ranges():
    """Nearly nothing is left of it where ranges are vague and bearings sure."""
    truth, landmarks, u, k, j, _ = drive(np.random.default_rng(6))
    args = (u, np.tile(Q, (len(truth), 1, 1)), k, j)
    exact = np.array([measure(truth[a], SENSOR, landmarks[b]) for a, b in zip(k, j)])
    vague = np.column_stack([exact, np.tile([0.02**2, 0.1**2], (len(k), 1))])
    precise = np.column_stack([exact, np.tile([0.3**2, 0.01**2], (len(k), 1))])
    maps = [SmoothingProblem(*args, v, SENSOR).smooth(truth, landmarks) for v in (vague, precise)]
    per = [s.nonlinearity() / len(s.gaussian.mean) for s in maps]
    assert per[0] > MAX_NONLINEARITY
    assert per[1] < 0.01 * per[0]


def test_covariance_is_confirmed_by_monte_carlo():
    nees, chi2, dof = [], [], 0
    for trial in range(300):
        truth, landmarks, u, k, j, z = drive(np.random.default_rng(1000 + trial))
        s = SmoothingProblem(u, np.tile(Q, (len(truth), 1, 1)), k, j, z, SENSOR).smooth(truth, landmarks)
        x = np.concatenate([truth[-1], landmarks.ravel()])
        nees.append(s.gaussian.mahalanobis2(x))
        chi2.append(s.chi2)
        dof = s.dof
    n = len(x)
    # mean of 300 χ²_n / n: standard error sqrt(2 / (300 n)) = 0.020; bounds at ±4 of them, two-sided
    assert 0.92 < np.mean(nees) / n < 1.08
    assert 0.95 < np.mean(chi2) / dof < 1.05


def test_trimming_removes_planted_outliers_and_counts_them():
    rng = np.random.default_rng(1)
    truth, landmarks, u, k, j, z = drive(rng, T=15)
    bad = rng.choice(len(z), 5, replace=False)
    z[bad, 1] += 0.5
    s = SmoothingProblem(u, np.tile(Q, (len(truth), 1, 1)), k, j, z, SENSOR, trim=16.0).smooth(truth, landmarks)
    assert set(bad) <= set(np.flatnonzero(~s.kept))
    assert (~s.kept).sum() <= 7
    assert 0.7 < s.chi2 / s.dof < 1.3


def test_landmark_left_without_observations_goes():
    truth, landmarks, u, k, j, z = drive(np.random.default_rng(2))
    last = j == j.max()
    z[last, 0] += np.linspace(5, 25, last.sum())  # nonsense ranges, none agreeing with another
    s = SmoothingProblem(u, np.tile(Q, (len(truth), 1, 1)), k, j, z, SENSOR, trim=16.0, min_hits=3).smooth(
        truth, landmarks
    )
    assert not s.landmark_kept[j.max()]
    assert len(s.gaussian.mean) == 3 + 2 * s.landmark_kept.sum()
    assert not s.kept[last].any()
