"""The Combined SLAM study: its figures against figures computed another way, and the tables made of them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.app.compare import map_nees
from graphslam.core.errors import UnknownNameError
from graphslam.evaluate.metrics import map_truth
from graphslam.join.submap_solver import solve_submaps
from graphslam_studies.combined_report import (
    GLOBAL,
    agreement,
    final,
    global_maps,
    local_maps,
    mean_bounds,
    online,
    online_consistency,
    paired,
    report,
    targets,
)
from graphslam_studies.combined_slam import STUDY
from graphslam_studies.combined_trial import TrialConfig, _Trial, run_trial
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.montecarlo.trials import Measurement

CONFIG = TrialConfig("quick", 20)


def tidy(rows: list[Measurement], run: int, *, timing: bool = False) -> pd.DataFrame:
    columns = ["world", "run", "algorithm", "submap", "quantity", "value"]
    return pd.DataFrame(
        [("quick", run, m.algorithm, m.submap, m.quantity, m.value) for m in rows if m.timing == timing],
        columns=columns,
    )


@pytest.fixture(scope="module")
def trials() -> list[list[Measurement]]:
    return [run_trial(CONFIG, seed) for seed in (11, 12)]


@pytest.fixture(scope="module")
def table(trials: list[list[Measurement]]) -> pd.DataFrame:
    return pd.concat([tidy(rows, k) for k, rows in enumerate(trials)], ignore_index=True)


def test_registered_and_complete() -> None:
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("combined-slam") is STUDY
    assert STUDY.worlds(False) == ("A", "B", "C")
    assert STUDY.default_trials(False) >= 20
    with pytest.raises(UnknownNameError):
        STUDY.trial("nowhere", False)


def test_every_algorithm_is_scored_once(table: pd.DataFrame) -> None:
    assert not table.duplicated(["run", "algorithm", "submap", "quantity"]).any()
    assert np.isfinite(table["value"]).all()
    for name in GLOBAL:
        assert len(final(table, name, "feature_rms")) == 2, name
    for name in ("ekf", "rbpf", "ekf-eif", "rbpf-ekf", "rbpf-eif", "default-online", "default-optimum"):
        assert online(table, name, "pose_nees").shape == (2, 13), name


def test_the_same_seed_gives_the_same_figures(trials: list[list[Measurement]]) -> None:
    again = run_trial(CONFIG, 12)
    pd.testing.assert_frame_equal(tidy(again, 1), tidy(trials[1], 1), check_exact=True)


def test_scores_are_those_of_the_compare_verb(table: pd.DataFrame) -> None:
    """Joint NEES of poses and features by ``compare``'s own code, and by hand from its parts."""
    t = _Trial(CONFIG, 11)
    submaps = t._submaps("rbpf-ekf", {"particles": CONFIG.default_particles})
    best = solve_submaps(submaps)
    truth = map_truth(t.log, submaps)
    rows = tidy(list(t.judge.estimate("x", best)), 0)
    e = best.landmarks - truth.landmarks[best.landmark_ids]
    m = len(submaps)
    P = best.joint_covariance()
    by_hand = e.ravel() @ np.linalg.solve(P[3 * m :, 3 * m :], e.ravel())
    assert final(rows, "x", "feature_joint_nees")[0] == pytest.approx(by_hand, rel=1e-6)
    assert final(rows, "x", "feature_rms")[0] == pytest.approx(np.sqrt(np.mean(np.sum(e**2, axis=1))))
    np.testing.assert_allclose(t.judge.end_poses, truth.exit_poses, atol=1e-12)
    d2, dof = map_nees(best, [s.key for s in submaps], truth)
    assert dof == len(P)
    assert d2 > by_hand  # poses add to it
    # the study's own row is that of the polished tree, which is this optimum
    assert final(table, "default-eif+polish", "feature_joint_nees")[0] == pytest.approx(by_hand, rel=1e-4)


def test_all_least_squares_methods_agree_and_the_ekf_is_the_eif(table: pd.DataFrame) -> None:
    row = agreement(table).iloc[0]
    assert row["greatest relative difference"] < 1e-6
    assert row["EKF join - sequential EIF, default maps [m, rad]"] < 1e-6
    assert {
        "default-batch",
        "default-isam2",
        "default-sequence+polish",
        "default-ekf+polish",
        "default-eif+polish",
    } <= set(row["methods"].split(", "))
    assert 0.6 < row["join χ²/dof"] < 1.5


def test_the_optimum_at_every_submap_ends_at_the_optimum(table: pd.DataFrame) -> None:
    end = online(table, "default-optimum", "pose_nees").iloc[:, -1].to_numpy()
    np.testing.assert_allclose(end, final(table, "default-eif+polish", "pose_nees"), rtol=1e-4)
    np.testing.assert_allclose(
        final(table, "default-isam2", "feature_rms"), final(table, "default-eif+polish", "feature_rms"), rtol=1e-4
    )


def test_reports_say_what_the_table_says(table: pd.DataFrame, trials: list[list[Measurement]]) -> None:
    timings = pd.concat([tidy(rows, k, timing=True) for k, rows in enumerate(trials)])
    tables = report(table, timings)
    assert {"Targets of the defaults", "Local maps", "Whole maps at the end", "Run by run", "Seconds"} <= set(tables)
    local = local_maps(table).set_index("maps").loc["local-default"]
    joint = online(table, "local-default", "local_joint_nees").to_numpy()
    assert local["number"] == joint.size
    assert local["joint NEES/n"] == pytest.approx(
        joint.sum() / online(table, "local-default", "local_joint_dof").sum().sum()
    )
    whole = global_maps(table).set_index("algorithm")
    assert whole.loc["ekf-eif", "feature RMS m"] == pytest.approx(final(table, "ekf-eif", "feature_rms").mean())
    along = online_consistency(table).set_index("algorithm").loc["ekf-eif"]
    assert along["final"] == pytest.approx(online(table, "ekf-eif", "pose_nees").mean().iloc[-1] / 7.814728)
    pair = paired(table).set_index(["a", "b", "quantity"]).loc[("ekf-eif", "ekf", "feature_rms")]
    ratio = final(table, "ekf-eif", "feature_rms") / final(table, "ekf", "feature_rms")
    assert pair["geometric mean a/b"] == pytest.approx(np.exp(np.log(ratio).mean()))


def test_targets_can_fail(table: pd.DataFrame) -> None:
    """Overconfident local maps are seen: NEES doubled, targets missed."""
    worse = table.copy()
    worse.loc[worse["quantity"].isin(["local_joint_nees", "feature_joint_nees"]), "value"] *= 2.0
    met = targets(table).set_index("target")["met"]
    missed = targets(worse).set_index("target")["met"]
    assert not missed["local maps: joint NEES/n"]
    assert not missed["optimum: joint feature NEES/n"]
    assert met["optimum: feature RMS / full batch"]


def test_bounds_of_a_mean() -> None:
    low, high = mean_bounds(3, 20)
    draws = np.random.default_rng(0).chisquare(3, (20000, 20)).mean(axis=1) / 3
    assert np.mean((draws > low) & (draws < high)) == pytest.approx(0.95, abs=0.01)
