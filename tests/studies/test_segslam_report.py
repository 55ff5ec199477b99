"""Tables of the studies of grid front ends, of tables written by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from graphslam_studies import segslam_report as report

COLUMNS = ["world", "run", "algorithm", "submap", "quantity", "value"]


def frame(rows: list[tuple[object, ...]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=COLUMNS)


def runs(world: str, algorithm: str, quantity: str, found: list[float]) -> list[tuple[object, ...]]:
    return [(world, k, algorithm, -1, quantity, v) for k, v in enumerate(found) if not np.isnan(v)]


def errors(world: str = "garage-A") -> pd.DataFrame:
    nan = float("nan")
    rows = runs(world, "dead-reckoning", "failed", [0, 0, 0, 0]) + runs(world, "rbpf-20", "failed", [0, 0, 0, 1])
    rows += runs(world, "segslam-20", "failed", [0, 0, 0, 0])
    rows += runs(world, "dead-reckoning", "final_error", [9.0, 8.0, 9.0, 10.0])
    rows += runs(world, "rbpf-20", "final_error", [1.0, 2.0, 3.0, nan])
    rows += runs(world, "segslam-20", "final_error", [0.2, 0.4, 0.6, 1.6])
    return frame(rows)


def test_table_of_errors() -> None:
    t = report.error_table(errors()).set_index("algorithm")
    s, r = t.loc["segslam-20"], t.loc["rbpf-20"]
    v = np.array([0.2, 0.4, 0.6, 1.6])
    assert (s["mean"], s["std"]) == (pytest.approx(v.mean()), pytest.approx(v.std(ddof=1)))
    half = stats.t.ppf(0.975, 3) * v.std(ddof=1) / 2
    assert s["mean_high"] - s["mean"] == pytest.approx(half)
    assert (s["below"], s["max"], s["median"]) == (0.75, 1.6, 0.5)
    assert (s["paper_mean"], s["paper_std"]) == (0.6, 0.2)
    # one that gave up did not close its loop, and has no error
    assert (r["runs"], r["below"], r["mean"]) == (4, 0.25, 2.0)
    assert t.loc["dead-reckoning", "particles"] == 0
    elsewhere = report.error_table(errors("court")).set_index("algorithm")
    assert np.isnan(elsewhere.loc["segslam-20", "paper_mean"])


def test_ratio_is_over_runs_that_both_finished() -> None:
    (row,) = report.ratio_table(errors()).to_dict("records")
    assert (row["particles"], row["runs"]) == (20, 3)
    assert row["ratio"] == pytest.approx(0.4 / 2.0)
    assert row["low"] <= row["ratio"] <= row["high"]


def test_table_of_times() -> None:
    table = pd.concat([errors(), frame(runs("garage-A", "all", "seconds_recorded", [400.0] * 4))])
    rows = runs("garage-A", "rbpf-20", "seconds_total", [10.0, 8.0, 12.0])
    rows += runs("garage-A", "segslam-20", "seconds_total", [16.0, 20.0, 24.0])
    (row,) = report.time_table(table, frame(rows)).to_dict("records")
    assert (row["particles"], row["rbpf"], row["segslam"]) == (20, 10.0, 20.0)
    assert row["ratio_of_least"] == 2.0
    assert row["segslam_times_real_time"] == 20.0
    assert row["paper_ratio"] == pytest.approx(41 / 47)


def test_table_of_nees_pools_segments_and_bounds_over_runs() -> None:
    rng = np.random.default_rng(0)
    rows: list[tuple[object, ...]] = []
    for run in range(40):
        rows += [("w", run, "segslam-5", -1, "failed", 0.0), ("w", run, "segslam-5", -1, "exit_dof", 4.0)]
        for k in range(8):
            d2 = float(rng.chisquare(4))
            rows.append(("w", run, "segslam-5", k, "exit_nees", d2))
            rows.append(("w", run, "segslam-5", k, "exit_nees_matched", 100.0 * d2))
    t = report.nees_table(frame(rows)).set_index("covariance")
    consistent, paper = t.loc["particles + drift"], t.loc["moment matching (paper)"]
    assert consistent["segments"] == 320
    assert consistent["low"] < 1.0 < consistent["high"]
    assert consistent["honest_low"] < consistent["nees_over_n"] < consistent["honest_high"]
    assert 0.91 < consistent["inside"] < 0.985
    assert paper["nees_over_n"] == pytest.approx(100 * consistent["nees_over_n"])
    assert paper["inside"] < 0.05
    assert paper["low"] > 1.0
    assert "particles + stated motion" not in t.index


def test_table_of_exits() -> None:
    rows: list[tuple[object, ...]] = [("w", 0, "segslam-5", -1, "failed", 0.0)]
    for k, (yaw, x, y, z, length) in enumerate([(0.3, 3.0, 0.0, 0.1, 10.0), (-0.4, -4.0, 0.0, 0.1, 30.0)]):
        for q, v in (("yaw", yaw), ("x", x), ("y", y), ("z", z), ("length", length)):
            rows.append(("w", 0, "segslam-5", k, f"exit_{q}", v))
    (row,) = report.exit_table(frame(rows)).to_dict("records")
    assert (row["segments"], row["length"]) == (2, 20.0)
    assert row["yaw"] == pytest.approx(np.sqrt(0.125))
    assert row["xy"] == pytest.approx(np.sqrt(12.5 / 2))
    assert row["z"] == pytest.approx(0.1)


def test_tables_of_matches_and_loops() -> None:
    w, a = "mine", "segslam-20"
    rows = runs(w, a, "failed", [0, 0, 0]) + runs(w, a, "matches", [5, 0, 7]) + runs(w, a, "false_matches", [0, 0, 2])
    rows += runs(w, a, "intervals", [4, 5, 6]) + runs(w, a, "match_offset_median", [0.1, np.nan, 0.3])
    rows += runs(w, a, "merged_parallels", [0, 0, 1]) + runs(w, a, "loops", [5, 5, 5])
    rows += runs(w, a, "loops_closed", [5, 3, 5]) + runs(w, a, "all_closed", [1, 0, 1])
    rows += runs(w, a, "maps_megabytes", [10, 20, 30])
    (m,) = report.match_table(frame(rows)).to_dict("records")
    assert (m["matches"], m["false_matches"], m["runs_with_false"], m["runs_without_any"]) == (12, 2, 1, 1)
    assert (m["intervals"], m["merged_parallels"]) == (5.0, 1)
    assert m["offset_median"] == pytest.approx(0.2)
    steps = runs(w, a, "seconds_step_first_quarter", [0.01, 0.01, 0.01])
    steps += runs(w, a, "seconds_step_last_quarter", [0.02, 0.03, 0.01])
    (r,) = report.loop_table(frame(rows), frame(steps)).to_dict("records")
    assert (r["loops"], r["loops_closed"], r["runs_all_closed"], r["runs_never_merged"]) == (15, 13, 2, 2)
    assert r["runs_good"] == 1  # closed all and merged none
    assert r["good_low"] < 1 / 3 < r["good_high"]
    assert r["cost_growth"] == pytest.approx(2.0)
    assert r["maps_megabytes"] == 20.0


def test_table_of_entropies_compares_run_by_run() -> None:
    w = "building"
    rows: list[tuple[object, ...]] = []
    for name, found in (("segslam-40", [9.0, 10.0, 11.0]), ("rbpf-40", [12.0, 9.5, 14.0])):
        rows += runs(w, name, "failed", [0, 0, 0]) + runs(w, name, "entropy_min", found)
        rows += runs(w, name, "entropy_samples", [20, 20, 3])
    t = report.entropy_table(frame(rows)).set_index("algorithm")
    r = t.loc["rbpf-40"]
    assert r["ratio"] == pytest.approx(30 / 35.5)
    assert r["ratio_low"] < r["ratio"] < r["ratio_high"]
    assert r["champion_lower_in"] == 2
    assert r["paper_ratio"] == pytest.approx(10755 / 13561)
    assert np.isnan(t.loc["segslam-40", "ratio"])
    assert t.loc["segslam-40", "entropy_min"] == pytest.approx(10.0)


def test_means_have_students_interval_and_one_run_has_none() -> None:
    t = report.means_table(errors(), ("final_error", "ate_aligned")).set_index("algorithm")
    assert t.loc["dead-reckoning", "final_error"] == 9.0
    assert "ate_aligned" not in t.columns
    one = errors()
    one = one[one["run"] == 0]
    t = report.means_table(one, ("final_error",)).set_index("algorithm")
    assert np.isnan(t.loc["segslam-20", "final_error_low"])
