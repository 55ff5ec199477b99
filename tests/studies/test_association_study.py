"""The study of association ambiguity: figures equal counts made one by one, and its trials are what it says of them."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from graphslam.core.errors import UnknownNameError
from graphslam.evaluate.consistency import nees, vector_pose_error
from graphslam_studies import association_trial
from graphslam_studies.association_ambiguity import PAIRS, QUICK, STUDY, WORLDS, local_nees, paired
from graphslam_studies.association_trial import FIVE_SIGMA_3DOF, LOCAL, SINGLE, Trial, run_trial
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study, fingerprint
from tests.pictures import full_pictures

CONFIG = QUICK["rows-quick"]


@pytest.fixture(autouse=True, scope="module")
def _full_pictures() -> Iterator[None]:
    with full_pictures():
        yield


def rows_of(world: str, runs: int) -> pd.DataFrame:
    rows = [
        (world, run, m.algorithm, m.submap, m.quantity, m.value)
        for run in range(runs)
        for m in STUDY.trial(world, True)(run)
        if not m.timing
    ]
    return pd.DataFrame(rows, columns=["world", "run", "algorithm", "submap", "quantity", "value"])


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return pd.concat([rows_of(world, 3) for world in QUICK], ignore_index=True)


def mean(table: pd.DataFrame, quantity: str, algorithm: str) -> float:
    of = table[(table["quantity"] == quantity) & (table["algorithm"] == algorithm)]
    return float(of["value"].mean())


def test_it_is_a_study_that_can_be_sent_elsewhere():
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("association-ambiguity") is STUDY
    assert STUDY.worlds(False) == tuple(WORLDS) == ("clutter", "pairs", "rows", "hard")
    assert STUDY.default_trials(False) >= 20
    trial = STUDY.trial("rows-quick", True)
    assert fingerprint(pickle.loads(pickle.dumps(trial))) == fingerprint(trial)
    assert fingerprint(STUDY.trial("hard-quick", True)) != fingerprint(trial)
    with pytest.raises(UnknownNameError, match="clutter"):
        STUDY.trial("meadow", False)
    names = {*LOCAL, *SINGLE}
    assert {n for pair in PAIRS for n in pair} <= names


def test_same_seed_same_figures(table):
    again = [(m.algorithm, m.submap, m.quantity, m.value) for m in run_trial(CONFIG, 1) if not m.timing]
    of = table[(table["world"] == "rows-quick") & (table["run"] == 1)]
    assert np.array_equal(np.array([r[3] for r in again]), of["value"].to_numpy(), equal_nan=True)
    assert [r[:3] for r in again] == list(zip(of["algorithm"], of["submap"], of["quantity"]))


def test_every_algorithm_reports_and_known_identities_make_no_mistake(table):
    assert set(table["algorithm"]) == {*CONFIG.local, *CONFIG.single}
    for quantity in ("wrong_share", "wrong_merges", "missed_merge_share", "local_spurious", "map_duplicated", "failed"):
        assert mean(table, quantity, "known") == 0.0, quantity
    for quantity in ("pair_precision", "pair_recall", "local_pair_precision", "local_pair_recall"):
        assert mean(table, quantity, "known") == 1.0, quantity
    assert mean(table, "used_share", "known") > 0.9


def test_the_worlds_confuse_and_joint_compatibility_helps(table):
    """Nearest neighbour shifts along the row; taking all observations of a scan together does so far less."""
    nearest, joint = mean(table, "wrong_share", "ekf-nn"), mean(table, "wrong_share", "ekf-jcbb")
    assert nearest > 0.04
    assert joint < 0.5 * nearest
    assert mean(table, "used_share", "ekf-nn") < 0.9 * mean(table, "used_share", "known")


def test_figures_equal_counts_one_by_one():
    trial = Trial(CONFIG, 2)
    truth = trial.truth_ids
    figures = {m.quantity: m.value for m in trial.judge_local("ekf-nn") if m.submap == -1}
    submaps = trial.submaps("ekf-nn")
    scans = len(trial.observations.times)
    assert sum(s.report["scans"] for s in submaps) == scans
    assert len({s.report["scans"] for s in submaps[:-1]}) == 1  # equal cuts

    wrong = used = right = 0
    entries = []  # (submap, landmark, identity by majority)
    for s in submaps:
        seen: dict[int, list[int]] = {}
        for o, j in s.landmarks.detections.tolist():
            seen.setdefault(j, []).append(int(truth[o]))
        for j in range(len(s.landmarks)):
            what = min(set(seen[j]), key=lambda t, held=seen[j]: (-held.count(t), t))
            wrong += sum(t != what for t in seen[j])
            right += sum(t == what for t in seen[j] if t >= 0)
            used += len(seen[j])
            entries.append((s.key, j, what))
    assert figures["wrong_share"] == pytest.approx(wrong / used)
    assert wrong > 0
    assert figures["used_share"] == pytest.approx((used - wrong) / np.sum(truth >= 0))
    assert figures["used_share"] == pytest.approx(right / np.sum(truth >= 0))

    joined = trial.join(submaps)
    ids = [int(joined.submap_ids[k][j]) for k, j, _ in entries]
    pairs = [(a, b) for a in range(len(entries)) for b in range(a + 1, len(entries)) if entries[a][0] != entries[b][0]]
    merged = [(a, b) for a, b in pairs if ids[a] == ids[b]]
    false = [(a, b) for a, b in merged if entries[a][2] != entries[b][2] or entries[a][2] < 0]
    same = [(a, b) for a, b in pairs if entries[a][2] == entries[b][2] >= 0]
    missed = [(a, b) for a, b in same if ids[a] != ids[b]]
    assert (figures["merges"], figures["wrong_merges"]) == (len(merged), len(false))
    assert figures["missed_merge_share"] == pytest.approx(len(missed) / len(same))

    end = trial.log.truth.trajectory.interpolate(np.array([submaps[-1].interval[1]]))
    e = vector_pose_error(joined.poses[-1:], end)
    assert figures["end_error"] == pytest.approx(float(np.hypot(e[0, 0], e[0, 1])))
    d2 = float(nees(e[0], joined.pose_covariance(len(submaps))))
    assert figures["end_nees"] == pytest.approx(d2)
    assert figures["diverged"] == float(d2 > FIVE_SIGMA_3DOF)


def test_one_that_gives_up_is_a_figure_and_not_the_end_of_the_study(monkeypatch):
    few = replace(CONFIG, local=("ekf-nn", "known"), single=())
    monkeypatch.setitem(association_trial.LOCAL, "ekf-nn", ("ekf", {"association": "hearsay"}))
    figures = {(m.algorithm, m.quantity): m.value for m in run_trial(few, 0) if m.submap == -1}
    assert figures["ekf-nn", "failed"] == figures["ekf-nn", "diverged"] == 1.0
    assert ("ekf-nn", "wrong_share") not in figures
    assert figures["known", "failed"] == 0.0


def test_report_and_figures(table, tmp_path):
    timings = table[:0].copy()
    report = STUDY.report(table, timings)
    summary = report["summary"].set_index(["world", "algorithm"])
    of = table[(table["world"] == "hard-quick") & (table["algorithm"] == "rbpf-40") & (table["quantity"] == "map_rmse")]
    assert summary.loc[("hard-quick", "rbpf-40"), "map_rmse"] == pytest.approx(of["value"].mean())
    spread = report["spread"].set_index(["world", "algorithm"]).loc[("hard-quick", "rbpf-40"), "map_rmse"]
    assert spread == pytest.approx(1.96 * of["value"].std() / np.sqrt(3))
    made = STUDY.figures(table, timings, tmp_path)
    assert {p.name for p in made} == {"wrong_share.png", "used_share.png", "missed_merge_share.png", "map_rmse.png"}
    assert all(p.stat().st_size > 10_000 for p in made)


def test_consistency_of_local_maps_is_judged_from_both_sides(table):
    rows = local_nees(table).set_index(["world", "algorithm"])
    for world in QUICK:
        # a curved way that is poorly known makes a Cartesian Gaussian a little overconfident, whoever is who
        assert 0.7 < rows.loc[(world, "known"), "nees_over_n"] < 1.7
        assert rows.loc[(world, "rbpf-paper"), "verdict"] == "overconfident"
        assert rows.loc[(world, "rbpf-paper"), "nees_over_n"] > 5.0
    assert rows.loc[("rows-quick", "known"), "submaps"] == sum(
        (table["world"] == "rows-quick") & (table["algorithm"] == "known") & (table["quantity"] == "local_pose_nees")
    )


def test_paired_comparison_of_a_hand_case():
    rows = [
        ("w", run, a, -1, "map_rmse", v)
        for run, (x, y) in enumerate([(1.0, 2.0), (2.0, 2.0), (3.0, 12.0)])
        for a, v in (("ekf-jcbb", x), ("ekf-nn", y))
    ]
    found = paired(pd.DataFrame(rows, columns=["world", "run", "algorithm", "submap", "quantity", "value"]))
    (row,) = found.to_dict("records")
    assert (row["algorithm"], row["against"], row["runs"]) == ("ekf-jcbb", "ekf-nn", 3)
    assert (row["lower_in"], row["equal_in"], row["ratio_runs"]) == (2, 1, 3)
    assert row["difference"] == pytest.approx(-10 / 3)
    assert row["ratio"] == pytest.approx((0.5 * 1.0 * 0.25) ** (1 / 3))
    log = np.log([0.5, 1.0, 0.25])
    assert np.log(row["ratio_high"] / row["ratio_low"]) == pytest.approx(2 * 1.96 * log.std(ddof=1) / np.sqrt(3))
