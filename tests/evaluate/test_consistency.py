"""NEES and CI: hand values, and the power of the verdict in both directions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
from scipy import stats

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.geometry import se2_compose, se2_exp
from graphslam.core.log import Truth
from graphslam.core.se3 import se3_compose, se3_exp
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.consistency import (
    Consistency,
    consistency_index,
    joint_nees,
    nees,
    pose_error,
    vector_pose_error,
)
from graphslam.sim.landmark_field import PRESETS, simulate_landmark_field
from graphslam_studies.evaluate.submap_consistency import submap_nees, submaps_consistency, true_submap
from tests.reference.batch_slam import batch_submap

GAUGE = "first base fixed"


def judged(d2: np.ndarray, dof: float, **rest: object) -> Consistency:
    return Consistency(quantity="x", nees=d2, dof=np.array(dof), gauge=GAUGE, **rest)  # type: ignore[arg-type]


def simulated(rng: np.random.Generator, runs: int, k: int, n: int, claim: float, *, shared: bool = False) -> np.ndarray:
    """NEES of an estimator whose true covariance is P and who claims ``claim · P``."""
    A = rng.normal(size=(n, n))
    P = A @ A.T + np.eye(n)
    e = rng.multivariate_normal(np.zeros(n), P, size=(runs, 1 if shared else k))
    e = np.repeat(e, k, axis=1) if shared else e
    return nees(e, np.broadcast_to(claim * P, (runs, k, n, n)))


def test_nees_by_hand() -> None:
    assert nees([3.0, 4.0], [[9.0, 0.0], [0.0, 4.0]]) == pytest.approx(1.0 + 4.0)
    # P = [[2, 1], [1, 2]] has P⁻¹ = [[2, -1], [-1, 2]]/3
    assert nees([1.0, 1.0], [[2.0, 1.0], [1.0, 2.0]]) == pytest.approx(2 / 3)
    assert nees([[1.0, 1.0], [1.0, -1.0]], [[[2.0, 1.0], [1.0, 2.0]]] * 2) == pytest.approx([2 / 3, 2.0])


def test_index_of_eq_20_by_hand() -> None:
    assert consistency_index(7.815, 3) == pytest.approx(1.0, abs=1e-3)  # χ²_3 at 95 % is 7.815
    assert consistency_index(5.991, 2) == pytest.approx(1.0, abs=1e-3)
    assert consistency_index(11.345, 3, confidence=0.99) == pytest.approx(1.0, abs=1e-3)


def test_joint_nees_of_covariance_and_information_agree(rng: np.random.Generator) -> None:
    A = rng.normal(size=(20, 25))
    P, e = A @ A.T, rng.normal(size=20)
    a = joint_nees(e, covariance=P)
    assert a == pytest.approx(float(nees(e, P)), rel=1e-9)
    assert a == pytest.approx(joint_nees(e, information=sp.csc_array(np.linalg.inv(P))), rel=1e-6)
    with pytest.raises(CovarianceError, match="either"):
        joint_nees(e)
    with pytest.raises(CovarianceError, match="not positive"):
        joint_nees(e, information=-sp.eye_array(20))


@pytest.mark.parametrize(
    ("cov", "what"),
    [
        (np.zeros((2, 2)), "covariance 1 is not positive definite"),
        ([[1.0, 0.9], [0.1, 1.0]], "covariance 1 is not symmetric"),
        (np.full((2, 2), np.nan), "covariance 1 is not finite"),
    ],
)
def test_bad_covariance_is_named(cov: np.ndarray, what: str) -> None:
    with pytest.raises(CovarianceError, match=what):
        nees(np.zeros((2, 2)), np.stack([np.eye(2), cov]))


@pytest.mark.parametrize("scale", [1.0, 1e-8])
def test_asymmetry_of_rounding_is_averaged_and_more_is_refused(scale: float) -> None:
    """A millionth of the largest entry; which triangle a factorisation happens to read does not matter."""
    P = scale * np.array([[1.0, 0.5 + 7e-7], [0.5, 1.0]])
    assert nees([1.0, -1.0], P) == pytest.approx(nees([1.0, -1.0], P.T), rel=1e-12)
    assert scale * nees([1.0, -1.0], P) == pytest.approx(4.0, rel=1e-5)
    P = scale * np.array([[1.0, 0.5 + 1.4e-6], [0.5, 1.0]])
    with pytest.raises(CovarianceError, match="covariance 0 is not symmetric"):
        nees([1.0, 1.0], P)
    # nearly singular: the lower triangle alone is not positive definite, their mean is
    P = np.array([[1.0, 1.0 - 6e-7], [1.0 + 1e-7, 1.0]])
    assert nees([1.0, 1.0], P) == pytest.approx(1.0, rel=1e-5)


def test_joint_nees_of_no_error_is_zero_and_of_both_forms_is_refused() -> None:
    assert joint_nees(np.zeros(3), information=sp.eye_array(3)) == 0.0
    assert joint_nees(np.zeros(3), covariance=np.eye(3)) == 0.0
    with pytest.raises(CovarianceError, match="either"):
        joint_nees(np.zeros(2), covariance=np.eye(2), information=sp.eye_array(2))
    with pytest.raises(CovarianceError, match=r"\(3, 3\)"):
        joint_nees(np.zeros(3), covariance=np.eye(2))


def test_covariance_of_another_size_is_refused() -> None:
    with pytest.raises(CovarianceError, match="does not fit"):
        nees(np.zeros(3), np.eye(2))


def test_pose_error_is_the_right_tangent(rng: np.random.Generator) -> None:
    xi = 0.3 * rng.normal(size=(5, 3))
    T = se2_exp(rng.normal(size=(5, 3)))
    assert np.allclose(pose_error(T, se2_compose(T, se2_exp(xi))), xi, atol=1e-12)
    xi = 0.3 * rng.normal(size=(5, 6))
    T = se3_exp(rng.normal(size=(5, 6)))
    assert np.allclose(pose_error(T, se3_compose(T, se3_exp(xi))), xi, atol=1e-12)
    assert np.allclose(vector_pose_error([0, 0, 3.1], [1, 2, -3.1]), [1, 2, 2 * np.pi - 6.2])
    for a, b in ((3, 7), (7, 3), (4, 4), (8, 8), (6, 6)):
        with pytest.raises(DataError, match="differ in kind"):
            pose_error(np.zeros(a), np.zeros(b))


# --- power ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["run", "value"])
def test_consistent_estimator_is_consistent_as_often_as_stated(unit: str, rng: np.random.Generator) -> None:
    """95 % of studies of a consistent estimator pass; the bounds are neither too tight nor too wide."""
    shared = unit == "run"
    verdicts = [judged(simulated(rng, 20, 5, 3, 1.0, shared=shared), 3, unit=unit).verdict for _ in range(400)]
    passed = sum(v == "consistent" for v in verdicts)
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 400, 0.95)
    assert low <= passed <= high
    # both kinds of false alarm occur: the bounds are two-sided
    assert {"overconfident", "conservative"} <= set(verdicts)


@pytest.mark.parametrize("unit", ["run", "value"])
@pytest.mark.parametrize(
    ("claim", "verdict"),
    [(1 / 1.8, "overconfident"), (1.8, "conservative"), (0.1, "overconfident"), (10, "conservative")],
)
def test_inconsistent_estimators_fail(unit: str, claim: float, verdict: str, rng: np.random.Generator) -> None:
    """A covariance that is wrong by 1.8 (σ by 1.34) must be caught with 50 runs, in either direction."""
    for _ in range(20):
        assert judged(simulated(rng, 50, 4, 3, claim, shared=unit == "run"), 3, unit=unit).verdict == verdict


def test_ci_below_one_passes_an_estimator_that_the_verdict_rejects(rng: np.random.Generator) -> None:
    c = judged(simulated(rng, 50, 1, 3, 0.5), 3)
    assert c.as_row()["ci_mean"] < 1.0
    assert c.verdict == "overconfident"


def test_coverage(rng: np.random.Generator) -> None:
    assert judged(simulated(rng, 20_000, 1, 2, 1.0), 2).coverage == pytest.approx(0.95, abs=0.01)
    # coverage of a covariance that is half the true one, in closed form: P(χ²_2 < 5.991/2)
    c = judged(simulated(rng, 20_000, 1, 2, 0.5), 2)
    assert c.coverage == pytest.approx(stats.chi2.cdf(stats.chi2.ppf(0.95, 2) / 2, 2), abs=0.015)


def test_correlated_values_count_once_per_run(rng: np.random.Generator) -> None:
    """100 copies of the same landmark error are one error: ``unit="value"`` would raise false alarms."""
    d2 = [simulated(rng, 10, 100, 2, 1.0, shared=True) for _ in range(100)]
    by_run = sum(judged(d, 2, unit="run").verdict == "consistent" for d in d2)
    by_value = sum(judged(d, 2, unit="value").verdict == "consistent" for d in d2)
    assert by_run >= 85
    assert by_value < 60


def test_curve_finds_the_submap_where_consistency_ends(rng: np.random.Generator) -> None:
    d2 = np.concatenate([simulated(rng, 50, 10, 3, 1.0), simulated(rng, 50, 10, 3, 0.4)], axis=1)
    mean, low, high = judged(d2, 3).curve()
    assert np.mean(mean[:10] < high[:10]) >= 0.8
    assert np.all(mean[10:] > high[10:])
    assert np.all(low < 1)
    assert np.all(high > 1)


def test_missing_values_narrow_the_evidence_not_the_result(rng: np.random.Generator) -> None:
    d2 = simulated(rng, 50, 3, 2, 1.0)
    d2[10:, 2] = np.nan
    mean, low, high = judged(d2, 2).curve()
    assert high[2] - low[2] > high[0] - low[0]
    assert mean[2] == pytest.approx(d2[:10, 2].mean() / 2)
    assert judged(d2, 2).count == 110
    d2[:, 1] = np.nan
    with pytest.raises(DataError, match=r"column has no value.*1"):
        judged(d2, 2).curve()


def test_one_value_a_run_may_come_as_a_plain_row() -> None:
    c = judged(np.array([3.0, 1.0, 2.0]), 2)
    assert (c.runs, c.count) == (3, 3)
    assert c.mean_normalised == pytest.approx(1.0)
    assert (judged(np.array(4.0), 2).runs, judged(np.ones((2, 3)), 2).runs) == (1, 2)
    with pytest.raises(DataError, match="at least one value"):
        judged(np.ones((2, 2, 2)), 2)


def test_a_run_counts_as_one_draw_of_its_least_degrees_of_freedom() -> None:
    """Values of 3 and 2 degrees of freedom in a run: its mean is spread as the widest; missing ones do nothing."""
    dof = np.array([[3.0, 2.0, 1.0], [3.0, 3.0, 1.0]])
    d2 = np.array([[3.0, 4.0, np.nan], [6.0, 3.0, np.nan]])
    c = Consistency(quantity="x", nees=d2, dof=dof, gauge=GAUGE)
    assert c.mean_normalised == pytest.approx(np.mean([(1.0 + 2.0) / 2, (2.0 + 1.0) / 2]))
    assert c.bounds == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 4) / 4))
    assert c.dimension == pytest.approx(11 / 4)
    mean, low, high = Consistency(quantity="x", nees=d2[:, :2], dof=dof[:, :2], gauge=GAUGE).curve()
    np.testing.assert_allclose(mean, [1.5, 1.5])
    np.testing.assert_allclose(low, [stats.chi2.ppf(0.025, 6) / 6, stats.chi2.ppf(0.025, 4) / 4])
    np.testing.assert_allclose(high, [stats.chi2.ppf(0.975, 6) / 6, stats.chi2.ppf(0.975, 4) / 4])
    value = Consistency(quantity="x", nees=d2, dof=dof, gauge=GAUGE, unit="value")
    assert value.mean_normalised == pytest.approx(16 / 11)
    assert value.bounds == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 11) / 11))


def test_runs_weigh_alike_however_many_values_they_have() -> None:
    assert judged(np.array([[1.0, np.nan], [3.0, 3.0]]), 1).mean_normalised == pytest.approx(2.0)


def test_a_column_is_judged_by_the_runs_that_have_it() -> None:
    """A value that is missing does not lend its degrees of freedom."""
    d2 = np.array([[2.0, 1.0], [np.nan, 1.0], [4.0, 1.0]])
    dof = np.array([[2.0, 1.0], [1.0, 1.0], [2.0, 1.0]])
    mean, low, high = Consistency(quantity="x", nees=d2, dof=dof, gauge=GAUGE, confidence=0.8).curve()
    assert mean[0] == pytest.approx(1.5)
    assert (low[0], high[0]) == pytest.approx(tuple(stats.chi2.ppf([0.1, 0.9], 4) / 4))


def test_values_on_the_border_are_consistent_and_outside_their_region() -> None:
    """Eq. 19 asks for D² below the quantile; the verdict for a mean beyond its bounds."""
    edge = float(stats.chi2.ppf(0.95, 2))
    c = judged(np.array([[edge * (1 - 1e-12)], [edge], [edge * (1 + 1e-12)], [0.1]]), 2)
    assert c.coverage == pytest.approx(0.5, abs=0.26)
    low, high = judged(np.ones((3, 1)), 2).bounds
    for value, verdict in ((low * 2, "consistent"), (low * 1.99, "conservative"), (high * 2, "consistent")):
        assert judged(np.full((3, 1), value), 2).verdict == verdict
    assert judged(np.full((3, 1), high * 2.01), 2).verdict == "overconfident"


def test_row_states_gauge_dimension_runs_and_confidence() -> None:
    row = judged(np.full((4, 2), 3.0), 3, confidence=0.9).as_row()
    assert row["gauge"] == GAUGE
    assert (row["dimension"], row["runs"], row["values"], row["confidence"]) == (3.0, 4, 8, 0.9)
    assert row["nees_over_n"] == 1.0
    assert row["low"] == pytest.approx(stats.chi2.ppf(0.05, 12) / 12)
    assert row["high"] == pytest.approx(stats.chi2.ppf(0.95, 12) / 12)
    assert row["ci_consistent"] == row["ci_mean"] == pytest.approx(3 / stats.chi2.ppf(0.9, 3))
    assert GAUGE in judged(np.ones((2, 1)), 3)._repr_html_()


def test_row_has_mean_and_median_of_the_known_indices() -> None:
    q = stats.chi2.ppf(0.95, 3)
    row = judged(np.array([[1.0, 2.0], [6.0, np.nan]]), 3).as_row()
    assert (row["ci_mean"], row["ci_median"]) == pytest.approx((3.0 / q, 2.0 / q))
    assert row["coverage"] == 1.0
    assert row["unit"] == "run"
    assert row["quantity"] == "x"


def test_different_dimensions_are_weighted_by_their_degrees_of_freedom() -> None:
    c = Consistency(quantity="x", nees=[[10.0, 60.0]], dof=np.array([[20, 50]]), gauge=GAUGE, unit="value")
    assert c.mean_normalised == pytest.approx(70 / 70)
    assert c.bounds == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 70) / 70))


@pytest.mark.parametrize(
    ("d2", "dof", "rest"),
    [
        (np.zeros((0, 3)), 3, {}),
        ([[np.nan], [1.0]], 3, {}),
        ([[-1.0]], 3, {}),
        ([[np.inf]], 3, {}),
        ([[1.0]], 0, {}),
        ([[1.0]], 0.99, {}),
        ([[1.0]], 3, {"confidence": 0.0}),
        ([[1.0]], 3, {"confidence": 1.0}),
        ([[1.0]], 3, {"unit": "landmark"}),
    ],
)
def test_impossible_nees_is_refused(d2: list, dof: float, rest: dict) -> None:
    with pytest.raises(DataError):
        judged(np.asarray(d2), dof, **rest)


# --- submaps -------------------------------------------------------------------------------------------------


def test_true_submap_by_hand() -> None:
    """Base at (1, 1) looking along y; the exit one metre ahead; a landmark two metres to the left."""
    truth = Truth(
        trajectory=Trajectory([0.0, 1.0, 2.0], [[0, 0, 0], [1, 1, np.pi / 2], [1, 2, np.pi]]),
        landmark_ids=np.array([8, 3]),
        landmarks=np.array([[5.0, 5.0], [-1.0, 1.0]]),
    )
    m = LandmarkMap(ids=[-1, 3, 99], exit_pose=[1.1, 0, 1.5], positions=np.ones((3, 2)), covariance=np.eye(9))
    s = Submap.from_landmarks(0, m, interval=(1.0, 2.0))
    exit_pose, known, positions = true_submap(s, truth)
    assert np.allclose(exit_pose, [1.0, 0.0, np.pi / 2])
    assert known.tolist() == [False, True, False]
    assert np.allclose(positions, [[0.0, 2.0]])
    r = submap_nees(s, truth)
    assert r.exit == pytest.approx(0.01 + (np.pi / 2 - 1.5) ** 2)
    assert r.landmarks == pytest.approx([1.0 + 1.0])
    assert r.joint == pytest.approx(r.exit + 2.0)
    assert (r.joint_dof, r.without_truth) == (5, 2)


def test_submap_without_landmarks_is_judged_by_its_exit() -> None:
    truth = Truth(trajectory=Trajectory([0.0, 1.0], [[0, 0, 0], [1, 0, 0]]))
    s = Submap(key=0, interval=(0.0, 1.0), exit_pose=[0.9, 0, 0], exit_covariance=0.01 * np.eye(3))
    assert submap_nees(s, truth).exit == pytest.approx(1.0)
    with pytest.raises(DataError, match="outside"):
        submap_nees(Submap(key=1, interval=(1.0, 2.0), exit_pose=[1, 0, 0], exit_covariance=np.eye(3)), truth)


def test_smoothed_submaps_are_consistent_and_scaled_ones_are_not() -> None:
    """The whole chain simulator → smoother → submap → NEES, with power in both directions."""
    log = simulate_landmark_field(PRESETS["demo"], 1)
    cuts = list(range(0, len(log["landmarks"].times), 20))
    submaps = [batch_submap(log, k, a, b) for k, (a, b) in enumerate(pairwise(cuts))]

    def scaled(s: Submap, factor: float) -> Submap:
        m = s.landmarks
        assert m is not None
        P = factor * m.dense_covariance()
        changed = LandmarkMap(ids=m.ids, exit_pose=m.exit_pose, positions=m.positions, covariance=P)
        return Submap.from_landmarks(s.key, changed, interval=s.interval)

    for factor, verdict in ((1.0, "consistent"), (0.7, "overconfident"), (1.4, "conservative")):
        c = submaps_consistency([scaled(s, factor) for s in submaps], log.truth)
        assert c["joint"].verdict == verdict, c["joint"].as_row()
        assert c["joint"].count == len(submaps)
    assert submaps_consistency(submaps, log.truth)["exit"].verdict == "consistent"
