"""The word on the covariances of a map without truth: it must not point the wrong way, and seldom cry wolf."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from graphslam.app.verdict.checks import findings_from_metrics
from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.records import Gps
from graphslam.evaluate.bias_test import sum_bias_windows
from graphslam.evaluate.covariance_assessment import (
    HALF,
    MAX_NONLINEARITY,
    ConsistencyTest,
    assess_covariances,
    chi_square_ratio_test,
    consistency_tests_as_json,
    consistency_tests_of_json,
    largest_score_test,
    pooled_nonlinearity,
    short_window_tests,
)
from graphslam.evaluate.residual_consistency import CORRELATED, class_consistency
from graphslam.evaluate.whiteness import residual_whiteness
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.registry import make_solver
from tests.reference.graph_chain import make_chain


def walk(rng: np.random.Generator, n: int, keep: float, d: int = 2) -> np.ndarray:
    """A Gauss–Markov series of unit size."""
    out = rng.standard_normal((n, d))
    for k in range(1, n):
        out[k] = keep * out[k - 1] + np.sqrt(1.0 - keep**2) * out[k]
    return out


def test_scores_of_white_residuals_are_standard_normal_and_correlated_ones_are_found(rng):
    times = np.arange(120.0)
    scores = [w.score for _ in range(300) if (w := residual_whiteness(times, rng.standard_normal((120, 2))))]
    assert stats.kstest(scores, "norm").pvalue > 0.01
    found = [residual_whiteness(times, 0.3 * walk(rng, 120, 0.6)) for _ in range(50)]
    assert all(w is not None and w.correlated() for w in found)  # small as they are
    # integrated over all lags (1 + 0.6) / (1 - 0.6) = 4
    assert np.mean([w.tau for w in found if w]) == pytest.approx(4.0, rel=0.25)


def test_what_the_fit_makes_of_white_noise_is_not_called_correlated(rng):
    """Residuals of white noise with its rough part fitted away are alike; the score knows by how much."""
    n = 80
    t = np.arange(float(n))
    rough = np.cos(np.pi * np.outer(t + 0.5, np.arange(50, n)) / n)  # what is left is smooth
    B = np.linalg.qr(rough)[0]
    C = np.eye(n) - B @ B.T
    scores, naive = [], []
    for _ in range(300):
        r = (C @ rng.standard_normal(n))[:, None]
        scores.append(residual_whiteness(t, r, C.reshape(n, 1, n, 1)).score)
        naive.append(residual_whiteness(t, r).score)
    # scaled by the size that was found: the mean is right to a tenth of σ
    assert abs(np.mean(scores)) < 0.15
    assert 0.8 < np.std(scores) < 1.2
    assert np.mean(naive) > 2.0


def test_pauses_are_not_bridged_and_few_residuals_tell_nothing(rng):
    assert residual_whiteness(np.arange(8.0), rng.standard_normal((8, 2))) is None
    times = np.concatenate([np.arange(30.0), 1000.0 + np.arange(30.0)])
    w = residual_whiteness(times, rng.standard_normal((60, 2)))
    assert w is not None
    assert w.pairs == 58


def solved(rng, errors) -> FactorGraph:
    """A chain with a fix each second, whose errors [m] have the size of their σ."""
    chain = make_chain(rng, m=8, landmarks=12)
    times = np.arange(0.5, 80.0, 0.5)
    where = []
    for t in times:
        k = min(int(t // 10), 7)
        T = chain.submaps[k].trajectory.interpolate(np.array([t]))[0]
        c, s = np.cos(chain.poses[k, 2]), np.sin(chain.poses[k, 2])
        where.append(chain.poses[k, :2] + np.array([[c, -s], [s, c]]) @ T[:2])
    fixes = np.array(where) + errors(len(times))
    graph = FactorGraph()
    graph.add_sensor(
        Gps(times=times, positions=fixes, sigma=np.ones(len(times)), lever=np.zeros(2)), config=GpsConfig(baseline=5.0)
    )
    for s in chain.submaps:
        graph.add_submap(s)
    graph.finish_sensors()
    make_solver("batch", graph).solve_to_optimum()
    return graph


def test_fixes_whose_errors_last_are_over_confident_however_small_their_residuals(rng):
    white = [class_consistency(solved(rng, lambda n: rng.standard_normal((n, 2))))["gps"] for _ in range(12)]
    correlated = [class_consistency(solved(rng, lambda n: walk(rng, n, 0.97)))["gps"] for _ in range(6)]
    assert sum(c.as_row()["verdict"] == CORRELATED for c in white) <= 1
    assert all(c.as_row()["verdict"] == CORRELATED for c in correlated)
    # by size alone most of them would be honest or conservative
    assert np.median([c.ratio for c in correlated]) < 1.0
    assert all(c.independent < 0.4 * c.dof for c in correlated)


CONSISTENT = chi_square_ratio_test("map", "map", 1.0, 2000.0) + chi_square_ratio_test("fixes", "fixes", 1.0, 400.0)

SMALL = chi_square_ratio_test("fixes", "fixes", 0.13, 400.0)


@pytest.mark.parametrize(
    ("rows", "fixes", "word"),
    [
        (CONSISTENT, True, "consistent"),
        (CONSISTENT[:1], False, "consistent"),
        (CONSISTENT[:1], True, "not tested"),  # nothing says how good the fixes are
        (chi_square_ratio_test("map", "map", 1.0, 8.0), False, "not tested"),  # half as large again is possible
        ([], False, "not tested"),
        (chi_square_ratio_test("map", "map", 1.3, 2000.0), False, "overconfident"),
        (chi_square_ratio_test("map", "map", 0.6, 2000.0), False, "conservative"),
        (chi_square_ratio_test("map", "map", 0.97, 20000.0), False, "consistent"),  # significant, and of no matter
        # small residuals, and alike from one to the next: never conservative
        ([*CONSISTENT[:1], *SMALL, largest_score_test("next", "fixes", 9.0)], True, "overconfident"),
        ([*CONSISTENT[:1], *SMALL], True, "conservative"),
        (
            [
                *chi_square_ratio_test("map", "map", 0.5, 2000.0),
                largest_score_test("calibration", "map", 6.0, tests=16),
            ],
            False,
            "overconfident",
        ),
    ],
)  # fmt: skip
def test_the_word(rows: list[ConsistencyTest], fixes: bool, word: str) -> None:
    assert assess_covariances(rows, fixes=fixes).verdict == word


def test_power_is_the_share_of_maps_half_as_certain_that_are_detected(rng) -> None:
    dof = 80.0
    (row,) = chi_square_ratio_test("map", "map", 1.0, dof)
    found = assess_covariances([row], fixes=False)
    assert found.verdict == "consistent"
    drawn = HALF * rng.chisquare(dof, 4000) / dof
    words = [assess_covariances(chi_square_ratio_test("map", "map", v, dof), fixes=False).verdict for v in drawn]
    share = words.count("overconfident") / len(drawn)
    assert abs(share - found.power) < 4.0 * np.sqrt(share * (1.0 - share) / len(drawn))
    assert row.power(50) < row.power(2)
    # a test without power cannot carry "consistent", however well it fits
    assert assess_covariances(chi_square_ratio_test("map", "map", 0.6, 20.0), fixes=False).verdict == "not tested"
    # linearised covariances are no better than the tolerance
    assert assess_covariances(chi_square_ratio_test("map", "map", 1.09, 1e5), fixes=False).verdict == "consistent"
    assert assess_covariances(chi_square_ratio_test("map", "map", 1.13, 1e5), fixes=False).verdict == "overconfident"


def test_maps_that_bend_are_promised_nothing() -> None:
    assert assess_covariances(CONSISTENT, fixes=True, nonlinearity=0.9 * MAX_NONLINEARITY).verdict == "consistent"
    found = assess_covariances(CONSISTENT, fixes=True, nonlinearity=1.1 * MAX_NONLINEARITY)
    assert found.verdict == "not tested"
    assert found.bent
    assert not found.missing
    assert (
        assess_covariances([*CONSISTENT[:1], *SMALL], fixes=True, nonlinearity=1.1 * MAX_NONLINEARITY).verdict
        == "not tested"
    )
    # what the log itself contradicts comes first
    wrong = chi_square_ratio_test("map", "map", 1.3, 2000.0)
    assert assess_covariances(wrong, fixes=False, nonlinearity=1.1 * MAX_NONLINEARITY).verdict == "overconfident"
    # a mean over unknowns, of the submaps that say it
    reports = [{"nonlinearity": 0.01, "unknowns": 30}, {"nonlinearity": 0.04, "unknowns": 10}, {}]
    assert pooled_nonlinearity(reports) == pytest.approx(0.0175)
    assert pooled_nonlinearity([{}]) == 0.0


def test_consistent_runs_are_seldom_called_wrong(rng):
    wrong = 0
    for _ in range(400):
        rows = [
            chi_square_ratio_test(f"{k}", "map", rng.chisquare(200 * k) / (200 * k), 200.0 * k)[0] for k in range(1, 8)
        ]
        rows += [largest_score_test(f"s{k}", "map", rng.standard_normal()) for k in range(5)]
        wrong += assess_covariances(rows, fixes=False).verdict in ("overconfident", "conservative")
    assert wrong <= stats.binom.ppf(0.999, 400, 0.05)


def windows(rng, n: int, lasts: float) -> dict[str, object]:
    """What a front end reports of n windows; an error of calibration is drawn anew for each."""
    S = np.tile(rng.uniform(50.0, 150.0, (n, 1)), (1, 8))
    g = np.sqrt(S) * rng.standard_normal((n, 8))
    g[:, 7] += S[:, 7] * lasts * rng.standard_normal(n)
    sums_of = {"score": g, "score2": g**2, "score_information": g * S, "information2": S**2}
    out: dict[str, object] = {k: v.sum(axis=0).tolist() for k, v in sums_of.items()}
    return {
        "systematic": {"windows": n, "chi2": 1000.0, "dof": 1000, "information": np.diag(S.sum(axis=0)).tolist(), **out}
    }


def test_errors_that_last_for_a_window_are_found(rng):
    def named(lasts: float) -> int:
        found = 0
        for _ in range(40):
            rows = short_window_tests(sum_bias_windows([windows(rng, 6, lasts), windows(rng, 6, lasts)]))
            found += next(r for r in rows if r.name.startswith("time-correlated errors")).too_large < 0.01
        return found

    assert named(0.0) <= 3
    assert named(0.4) >= 38


def test_the_line_says_what_it_rests_on_and_survives_the_file():
    rows = json.loads(json.dumps(consistency_tests_as_json(CONSISTENT)))
    assert consistency_tests_of_json(rows) == CONSISTENT
    assert consistency_tests_of_json([{"name": "x"}, 3, None]) == consistency_tests_of_json(None) == []
    lines = {f.code: f for f in findings_from_metrics(RunMetrics({"converged": True, "evidence": rows}, {}))}
    assert lines["trust"].level == "good"
    assert "without ground truth" in lines["trust"].text
    assert "errors match" not in " ".join(f.text for f in lines.values())
    alone = consistency_tests_as_json(chi_square_ratio_test("map", "map", 1.0, 8.0))
    (line,) = [
        f for f in findings_from_metrics(RunMetrics({"converged": True, "evidence": alone}, {})) if f.code == "trust"
    ]
    assert "covariances: not tested" in line.text
    assert line.level == ""
