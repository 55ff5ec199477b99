"""Check points: NIS of maps whose covariances are right, gauge, power, words, and rows that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import se2_transform
from graphslam.evaluate.check_points import CheckPoints, check_points, power_of_test
from graphslam.evaluate.gauge import aligned_nees
from graphslam.evaluate.residual_consistency import two_sided_bounds
from graphslam.graph.factor_graph import FactorGraph
from graphslam.solve.batch import BatchSolver
from tests.graph.factors.test_control import planar_rows, spatial_rows, spatial_world
from tests.reference.graph_chain import make_chain
from tests.reference.surveyed import surveyed, table

SIGMA = 0.05
RUNS = 60


def world(seed: int, control: bool, scale: float = 1.0):
    rng = np.random.default_rng([17, seed])
    chain, g = make_chain(rng, m=14, landmarks=20, laps=1.6), FactorGraph()
    for s in chain.submaps:
        g.add_submap(s, covariance_scale=scale)
    if control:
        g.add_sensor(table(planar_rows(chain, rng)))
        g.finish_sensors()
    BatchSolver(g).solve_to_optimum()
    return g, chain, rng


def check_rows(chain, rng, sigma: float = SIGMA) -> list[dict]:
    lever = np.array([0.3, -0.1])
    places = [(10.0 * k, se2_transform(chain.poses[k], lever)) for k in (2, 6, 11, 13)]
    rows = surveyed(places, rng, sigma, lever=lever)
    rows += surveyed([(f"l{k}", chain.landmarks[k]) for k in range(5, 12)], rng, sigma)
    d = np.linalg.norm(chain.landmarks[12] - chain.landmarks[15]) + sigma * rng.standard_normal()
    return [*rows, {"place": "l12", "to": "l15", "distance": d, "sigma": sigma}]


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_pooled_nis_is_chi_square_and_shows_half_the_covariance(control, scale):
    nis = dof = 0.0
    for seed in range(RUNS):
        g, chain, rng = world(seed, control, scale)
        found = check_points(g, table(check_rows(chain, rng, 0.01)))
        assert found.aligned == (0 if control else 3)
        assert found.dof == 23 - found.aligned
        nis, dof = nis + found.nis, dof + found.dof
    low, high = np.array(chi2_mean_bounds(int(dof), 1, 0.999)) / dof
    assert (low < nis / dof < high) == (scale == 1.0)
    if scale < 1.0 and not control:
        assert nis / dof > high


def test_a_frame_that_is_not_known_is_moved_as_a_whole_map_is():
    g, chain, rng = world(0, False)
    rows = surveyed([(f"l{k}", chain.landmarks[k]) for k in range(8)], rng, SIGMA)
    found = check_points(g, table(rows))
    P = g.covariance().joint([f"l{k}" for k in range(8)]) + SIGMA**2 * np.eye(16)
    z, at = np.array([[r["x"], r["y"]] for r in rows]), np.array([g.landmark(k) for k in range(8)])
    none = np.zeros((0, 3))
    assert found.nis == pytest.approx(aligned_nees(none, at, (none, z), P), rel=1e-9)
    assert found.dof == 13


def test_nis_of_a_row_is_its_own():
    g, chain, rng = world(1, True)
    found = check_points(g, table(surveyed([("l5", chain.landmarks[5])], rng, SIGMA)))
    (row,) = found.rows
    assert (row["place"], row["dof"], row["nis"]) == ("l5", 2, pytest.approx(found.nis))
    two = check_points(g, table(surveyed([("l5", chain.landmarks[5]), ("l9", chain.landmarks[9])], rng, SIGMA)))
    assert two.nis != pytest.approx(sum(r["nis"] for r in two.rows), rel=1e-3)  # they share the datum
    free, _, _ = world(1, False)
    one = check_points(free, table(surveyed([("l5", chain.landmarks[5])], rng, SIGMA)))
    assert (one.dof, one.verdict, one.facts()["nis_per_dof"]) == (0.0, "not tested", None)


def test_in_space():
    nis = dof = 0.0
    for seed in range(20):
        rng = np.random.default_rng([3, seed])
        g, made = spatial_world(rng)
        BatchSolver(g).solve_to_optimum()
        t = np.array([2.5, 5.0, 11.0, 17.0, 23.0])
        for frame, aligned in (("survey", 0), ("gps", 4)):  # the second is not known to the map
            found = check_points(g, table(spatial_rows(made, rng, t, frame=frame)))
            assert (found.aligned, found.dof) == (aligned, 15 - aligned)
            nis, dof = nis + found.nis, dof + found.dof
    low, high = np.array(chi2_mean_bounds(int(dof), 1, 0.999)) / dof
    assert low < nis / dof < high


def test_power_is_exact():
    n = 40
    low, high, _ = two_sided_bounds(1.0, n, 0.95)
    half = special.chdtr(n, n * low / 2) + special.chdtrc(n, n * high / 2)
    assert power_of_test(np.full(n, 2.0)) == pytest.approx(half, abs=1e-9)
    assert power_of_test(np.ones(n)) == pytest.approx(0.05, abs=1e-9)
    rng = np.random.default_rng(0)
    eigenvalues = 1.0 + rng.uniform(size=n)
    q = (eigenvalues * rng.standard_normal((40000, n)) ** 2).sum(axis=1) / n
    assert power_of_test(eigenvalues) == pytest.approx(np.mean((q < low) | (q > high)), abs=0.01)
    assert power_of_test(np.zeros(0)) == 0.0
    assert 0.0 <= power_of_test(np.linspace(1.0, 2.0, 1500)) <= 1.0


def test_power_is_that_of_the_map_and_not_of_the_rows():
    g, chain, rng = world(2, True)
    exact, vague = (check_points(g, table(check_rows(chain, rng, s))) for s in (1e-3, 1.0))
    assert exact.dof == vague.dof
    assert exact.power > 0.6 > 0.06 > vague.power
    assert power_of_test(np.full(int(exact.dof), 2.0)) == pytest.approx(exact.power, abs=0.02)


@pytest.mark.parametrize(
    ("ratio", "power", "word"),
    [
        (1.0, 0.9, "consistent"),
        (1.0, 0.7, "not tested"),
        (0.3, 0.9, "conservative"),
        (3.0, 0.9, "overconfident"),
        (12.0, 0.9, "wrong"),
    ],
)
def test_words(ratio, power, word):
    assert CheckPoints("", nis=40.0 * ratio, dof=40.0, power=power).verdict == word


def test_rows_without_a_place_are_refused():
    g, chain, rng = world(3, True)
    rows = surveyed([("l5", chain.landmarks[5]), ("l77", [0.0, 0.0]), (500.0, [0.0, 0.0])], rng, SIGMA)
    found = check_points(g, table(rows))
    assert len(found.rows) == 1
    assert [(line, why.split(";")[0]) for line, why in found.refused] == [
        (3, "no landmark has this id"),
        (4, "the time is outside the map"),
    ]
    assert check_points(g, table(rows[1:])).verdict == "not tested"
