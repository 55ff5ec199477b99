"""Nearest neighbour equals the obvious loop, joint compatibility the exhaustive search; and why the latter is there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from graphslam.core.errors import ConfigError
from graphslam_frontends.landmarks.compatibility import gates_by_dof, pair_observations
from tests.reference.ekf_slam import distance2, exhaustive_joint, measurement, nearest_neighbour

SENSOR = np.array([0.4, 0.1, -0.05])


def problem(rng, *, landmarks=5, observations=4, ranges_only=0.0, spread=4.0):
    """Landmarks close enough to be confused, a correlated Gaussian, and observations drawn from it or from nowhere."""
    truth = np.concatenate([[0.0, 0.0, 0.0], (rng.normal(0, spread, (landmarks, 2)) + [8, 0]).ravel()])
    n = len(truth)
    # pose error moves everything together, as in a real map
    common = rng.normal(0, 0.6, (n, 3))
    P = common @ common.T + np.diag(rng.uniform(0.02, 0.3, n))
    P[2] *= 0.1
    P[:, 2] *= 0.1
    x = truth + rng.multivariate_normal(np.zeros(n), P)
    rows = []
    for j in rng.permutation(landmarks)[:observations]:
        z = measurement(truth, j, SENSOR)[0] + [0.1, 0.02] * rng.standard_normal(2)
        if rng.random() < 0.2:
            z = np.array([rng.uniform(2, 12), rng.uniform(-1, 1)])
        flat = rng.random() < ranges_only
        rows.append([z[0], 0.0 if flat else z[1], 0.01, np.inf if flat else 0.0004])
    return x, P, np.array(rows)


@pytest.mark.parametrize("ranges_only", [0.0, 0.4])
def test_nearest_neighbour_equals_the_obvious_loop(ranges_only):
    rng = np.random.default_rng(1)
    contested = 0
    for _ in range(60):
        x, P, obs = problem(rng, ranges_only=ranges_only)
        got = pair_observations(x, P, obs, SENSOR, gate=11.8, method="nearest")
        np.testing.assert_array_equal(got.landmark, nearest_neighbour(x, P, obs, SENSOR, 11.8))
        gates = gates_by_dof(11.8, 2)
        for o in range(len(obs)):
            d2 = [distance2(x, P, [(o, j)], obs, SENSOR) for j in range(5)]
            assert got.nearest[o] == pytest.approx(min(d / gates[dof] for d, dof in d2))
            best = int(np.argmin([d for d, _ in d2]))
            contested += got.landmark[o] >= 0 and got.landmark[o] != best
        for j in range(5):
            np.testing.assert_allclose(got.polar[j], measurement(x, j, SENSOR)[0], atol=1e-12)
    assert contested > 5  # exclusiveness had something to decide


@pytest.mark.parametrize("ranges_only", [0.0, 0.4])
def test_joint_compatibility_equals_the_exhaustive_search(ranges_only):
    rng = np.random.default_rng(2)
    differs, sizes = 0, []
    for _ in range(40):
        x, P, obs = problem(rng, landmarks=4, ranges_only=ranges_only)
        got = pair_observations(x, P, obs, SENSOR, gate=11.8, method="jcbb")
        match, d2 = exhaustive_joint(x, P, obs, SENSOR, 11.8)
        np.testing.assert_array_equal(got.landmark, match)
        assert got.distance2 == pytest.approx(d2, rel=1e-9, abs=1e-12)
        assert not got.capped
        assert got.nodes <= 5**4
        differs += not np.array_equal(match, nearest_neighbour(x, P, obs, SENSOR, 11.8))
        sizes.append((match >= 0).sum())
    assert differs > 5  # or the problems are too easy to tell the two apart
    assert len(set(sizes)) > 2


def test_joint_compatibility_sees_the_common_error_that_nearest_neighbour_takes_for_matches():
    """A row of features 2 m apart and a vehicle 1.3 m off along it: each observation is nearest to the next feature."""
    row = np.column_stack([np.arange(6) * 2.0 + 3, np.full(6, 4.0)])
    x = np.concatenate([[1.3, 0.0, 0.0], row.ravel()])
    P = np.diag(np.concatenate([[1.5, 0.01, 1e-6], np.full(12, 1e-4)]))
    truth = np.concatenate([np.zeros(3), row.ravel()])
    # two more features off the row have no neighbour to be confused with: they tell the true shift
    x, truth = np.concatenate([x, [5.0, -5.0, 9.0, -4.0]]), np.concatenate([truth, [5.0, -5.0, 9.0, -4.0]])
    P = np.block([[P, np.zeros((15, 4))], [np.zeros((4, 15)), 1e-4 * np.eye(4)]])
    seen = [1, 2, 3, 4, 6, 7]
    obs = np.array([[*measurement(truth, j, np.zeros(3))[0], 0.01, 1e-3] for j in seen])
    nearest = pair_observations(x, P, obs, np.zeros(3), gate=11.8, method="nearest").landmark
    joint = pair_observations(x, P, obs, np.zeros(3), gate=11.8, method="jcbb").landmark
    assert (nearest[:4] != seen[:4]).sum() >= 3
    np.testing.assert_array_equal(joint, seen)


def test_search_stops_at_its_bound_says_so_and_keeps_the_best_so_far():
    rng = np.random.default_rng(3)
    x, P, obs = problem(rng, landmarks=12, observations=10, spread=0.8)
    whole = pair_observations(x, P, obs, SENSOR, gate=11.8, method="jcbb", max_nodes=10**7)
    assert not whole.capped
    assert whole.nodes > 60
    cut = pair_observations(x, P, obs, SENSOR, gate=11.8, method="jcbb", max_nodes=60)
    assert cut.capped
    assert cut.nodes == 60
    used = cut.landmark[cut.landmark >= 0]
    assert 0 < len(used) <= (whole.landmark >= 0).sum()
    assert len(set(used)) == len(used)
    pairs = [(o, j) for o, j in enumerate(cut.landmark) if j >= 0]
    d2, dof = distance2(x, P, pairs, obs, SENSOR)
    assert cut.distance2 == pytest.approx(d2)
    assert d2 <= gates_by_dof(11.8, dof)[dof]


def test_bound_prunes():
    """Well separated landmarks: one test per observation, and what remains of the tree is never looked at."""
    rng = np.random.default_rng(4)
    x = np.concatenate([np.zeros(3), np.column_stack([np.linspace(5, 60, 12), np.full(12, 6.0)]).ravel()])
    P = 1e-3 * np.eye(len(x))
    obs = np.array([[*measurement(x, j, SENSOR)[0], 0.01, 1e-4] for j in range(12)])
    obs[:, 0] += 0.05 * rng.standard_normal(12)
    got = pair_observations(x, P, obs, SENSOR, gate=11.8, method="jcbb")
    np.testing.assert_array_equal(got.landmark, np.arange(12))
    assert got.nodes == 12


@pytest.mark.parametrize("method", ["nearest", "jcbb"])
def test_nothing_to_pair(method):
    x, P = np.zeros(3), np.eye(3)
    got = pair_observations(x, P, np.array([[3.0, 0.0, 0.01, 0.01]]), SENSOR, gate=11.8, method=method)
    np.testing.assert_array_equal(got.landmark, [-1])
    assert got.nearest[0] == np.inf
    x, P = np.array([0, 0, 0, 4.0, 1.0]), np.eye(5)
    assert len(pair_observations(x, P, np.zeros((0, 4)), SENSOR, gate=11.8, method=method).landmark) == 0
    row = np.array([[*measurement(x, 0, SENSOR)[0], 0.01, 0.01]])
    assert pair_observations(x, P, row, SENSOR, gate=11.8, method=method).landmark[0] == 0
    dead = pair_observations(x, P, row, SENSOR, gate=11.8, method=method, alive=np.array([False]))
    assert dead.landmark[0] == -1


def test_gates_have_one_probability():
    g = gates_by_dof(11.8, 8)
    assert g[2] == pytest.approx(11.8)
    np.testing.assert_allclose(stats.chi2.sf(g[1:], np.arange(1, 9)), stats.chi2.sf(11.8, 2))
    with pytest.raises(ConfigError, match="gate"):
        gates_by_dof(np.nan, 2)
