"""The study ``submap-ends``: drawn worlds, what ends a submap, and tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.submap_ends import CASES, PAIRS, STUDY, EndsConfig, drawn_field, paired_table, run_trial

COLUMNS = ["world", "run", "algorithm", "submap", "quantity", "value"]


def tidy(cases: tuple[str, ...], seeds: tuple[int, ...] = (1, 2)) -> tuple[pd.DataFrame, pd.DataFrame]:
    rows: tuple[list[tuple[object, ...]], list[tuple[object, ...]]] = ([], [])
    for run, seed in enumerate(seeds):
        for m in run_trial(replace(STUDY.quick["quick"], cases=cases), seed):
            rows[m.timing].append(("quick", run, m.algorithm, m.submap, m.quantity, m.value))
    return pd.DataFrame(rows[0], columns=COLUMNS), pd.DataFrame(rows[1], columns=COLUMNS)


def test_it_is_a_study_whose_pairs_are_among_its_cases() -> None:
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("graphslam_studies.submap_ends:STUDY") is STUDY
    assert {name for pair in PAIRS for name in pair} <= set(CASES)
    assert len(set(PAIRS)) == len(PAIRS)


def test_worlds_are_drawn_from_the_seed() -> None:
    fields = [drawn_field(EndsConfig(), seed) for seed in range(40)]
    assert drawn_field(EndsConfig(), 3) == fields[3] != fields[4]
    assert all(1.1 <= f.laps <= 1.5 for f in fields)  # the loop is closed
    bearings = np.degrees([f.sigma_bearing for f in fields])
    assert bearings.min() < 1.5
    assert bearings.max() > 4.0


def test_each_strategy_ends_submaps_by_its_criterion() -> None:
    table, timings = tidy(("paper/fixed-60", "paper/features-6", "paper/features-15", "paper/rule-30-early"))
    report = STUDY.report(table, timings)
    sizes = report["submaps"].set_index("algorithm")
    assert (sizes["failed"] == 0).all()
    assert sizes.loc["paper/fixed-60", ["ended_features", "ended_diversity", "ended_no-features"]].sum() == 0
    # all but the last, which ends with the log
    assert sizes.loc["paper/features-6", "ended_features"] == sizes.loc["paper/features-6", "submaps"] - 1
    assert sizes.loc["paper/rule-30-early", "ended_diversity"] > 0
    assert sizes.loc["paper/features-15", "submaps"] < sizes.loc["paper/features-6", "submaps"]
    assert set(report["maps"]["algorithm"]) == {*sizes.index, *(f"{name}+polish" for name in sizes.index)}
    assert (report["maps"]["runs"] == 2).all()
    assert (report["seconds"]["value"] > 0).all()


def test_a_ratio_of_pairs_leaves_out_runs_that_failed() -> None:
    a, b = "paper/rule-30", "paper/fixed-60"
    ratios = [(2.0, 1.0), (8.0, 1.0), (1.0, None)]
    rows = [("w", run, name, -1, "feature_rms", value) for run, (x, y) in enumerate(ratios)
            for name, value in ((a, x), (b, y)) if value is not None]  # fmt: skip
    (row,) = paired_table(pd.DataFrame(rows, columns=COLUMNS), pd.DataFrame(columns=COLUMNS)).to_dict("records")
    assert (row["a"], row["b"], row["runs"], row["a smaller in"]) == (a, b, 2, 0)
    assert row["a/b"] == pytest.approx(4.0)
    assert (row["low"], row["high"]) == (pytest.approx(2.0), pytest.approx(8.0))
