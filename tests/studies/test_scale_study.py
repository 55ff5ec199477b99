"""The study ``scale``: what it says in its small worlds must be so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from graphslam_studies.montecarlo.definition import find_study
from graphslam_studies.scale import STUDY
from graphslam_studies.scale_trial import averaged_passes, pass_labels
from graphslam_studies.sim.laps import LapsConfig, draw_laps


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    rows = []
    for world in STUDY.worlds(True):
        for m in STUDY.trial(world, True)(4):
            if not m.timing:
                rows.append((world, 0, m.algorithm, m.submap, m.quantity, m.value))
    return pd.DataFrame(rows, columns=["world", "run", "algorithm", "submap", "quantity", "value"])


def figure(table: pd.DataFrame, name: str, quantity: str) -> float:
    (value,) = table[(table["algorithm"] == name) & (table["quantity"] == quantity)]["value"]
    return float(value)


def test_methods_agree_with_the_direct_one(table: pd.DataFrame) -> None:
    assert find_study("scale") is STUDY
    for name in ("direct", "gn", "gn, block Jacobi", "blocks", "cg, two levels", "gn, forward pass"):
        assert abs(figure(table, name, "gap")) < 1e-3
        assert figure(table, name, "to_optimum") < 1e-3
        assert figure(table, name, "residual") < 1e-3
    # the preconditioner is what conjugate gradients need, as Gauss-Newton does
    assert figure(table, "gn", "products") < 0.5 * figure(table, "gn, block Jacobi", "products")
    assert figure(table, "cg, two levels", "products") < 0.5 * figure(table, "cg, block Jacobi", "products")
    assert figure(table, "cg, none", "to_optimum") > 100 * figure(table, "cg, two levels", "to_optimum")
    # a small residual is not a small error, and keyframes alone are no answer
    assert figure(table, "keyframes alone", "gap") > 10.0
    assert figure(table, "keyframes alone", "to_optimum") > 1e-3


def test_approximations_cost_what_they_cost(table: pd.DataFrame) -> None:
    assert figure(table, "2.00% wrong unions", "to_optimum") > 3 * figure(
        table, "2.00% wrong unions, split", "to_optimum"
    )
    assert figure(table, "2.00% wrong unions, split", "split") >= 1
    assert figure(table, "exact", "split") == 0
    for worse in ("10.0% of the links kept", "passes averaged"):
        assert figure(table, worse, "to_optimum") > 1e-3


def test_stability_against_what_is_linearised_once(table: pd.DataFrame) -> None:
    """With small errors of the turns all agree; with large ones only what is linearised again finds the optimum."""
    once, again = "information form, linearised once", "relinearised"
    assert figure(table, f"{once}; 0.5 mrad", "to_optimum") < 0.005
    assert figure(table, f"{once}; 20 mrad", "to_optimum") > 0.01
    for turn in ("0.5", "20"):
        for way in (again, f"{again}, forward pass"):
            assert figure(table, f"{way}; {turn} mrad", "to_optimum") < 1e-4
        # links are stable as well, but count measurements several times and are no optimum
        assert 1e-3 < figure(table, f"links fixed once; {turn} mrad", "to_optimum") < 0.3


def test_report_and_figures(table: pd.DataFrame, tmp_path: Path) -> None:
    report = STUDY.report(table, table.iloc[:0])
    assert list(report) == list(STUDY.worlds(True))
    row = report["laps-240"].set_index("method").loc["gn"]
    assert row["to_truth"] == figure(table, "gn", "to_truth")
    assert [p.name for p in STUDY.figures(table, table.iloc[:0], tmp_path)] == ["to_optimum.png", "to_truth.png"]


def test_averaged_passes_are_the_means_of_their_observations() -> None:
    problem = draw_laps(LapsConfig(poses=60, laps=2, begin=2, reach=5), seed=2).problem()
    averaged = averaged_passes(problem)
    passes, n = pass_labels(problem.landmark, problem.first, 20)
    at, pose = problem.dead_reckoning(), np.repeat(np.arange(60), np.diff(problem.first))
    full = [k for k in range(n) if (passes == k).sum() == 5]
    assert averaged.measurements == len(full)
    k = full[7]
    middle = int(np.mean(pose[passes == k]))
    mine = [at.position[i] + at.rotation[i] @ z for i, z in zip(pose[passes == k], problem.points[passes == k])]
    wanted = at.rotation[middle].T @ (np.mean(mine, axis=0) - at.position[middle])
    found = averaged.points[averaged.first[middle] : averaged.first[middle + 1]]
    assert np.abs(found - wanted).max(axis=1).min() < 1e-5
    assert averaged.range_sigma == pytest.approx(problem.range_sigma / np.sqrt(5))
