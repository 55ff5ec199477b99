"""The study ``heights``: pairs in the small world, climbs and tables against what is made by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.core.poses import level_poses
from graphslam_studies.evaluate.segslam_judge import climbs
from graphslam_studies.heights import PAIR, STUDY, exit_table, pair_table
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.refinement_trial import ROBOTS, drawn_garage

COLUMNS = ["world", "run", "algorithm", "submap", "quantity", "value"]


@pytest.fixture(scope="module")
def tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    rows: tuple[list[tuple[object, ...]], list[tuple[object, ...]]] = ([], [])
    for run in range(2):
        for m in STUDY.trial("court-quick", True)(run + 1):
            rows[m.timing].append(("court-quick", run, m.algorithm, m.submap, m.quantity, m.value))
    return pd.DataFrame(rows[0], columns=COLUMNS), pd.DataFrame(rows[1], columns=COLUMNS)


def test_it_is_a_study() -> None:
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("heights") is STUDY
    assert STUDY.worlds(True) == ("court-quick",)
    assert "garage-drawn" in STUDY.worlds(False)


def test_every_algorithm_runs_in_both_ways(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    table, timings = tables
    names = {f"{a} {p}" for a in ("rbpf-5", "segslam-5") for p in PAIR}
    failed = table[table["quantity"] == "failed"]
    assert set(failed["algorithm"]) == names
    assert not failed["value"].any()
    assert not table.duplicated(["run", "algorithm", "submap", "quantity"]).any()
    for kind in ("rbpf-5", "segslam-5"):  # the same run, another path
        old, new = (
            table[(table["algorithm"] == f"{kind} {p}") & (table["quantity"] == "ate_plan")]["value"].to_numpy()
            for p in PAIR
        )
        assert len(old) == len(new) == 2
        assert not np.isclose(old, new).any()
    report = STUDY.report(table, timings)
    pairs = report["pairs"].set_index(["quantity", "algorithm"])
    assert pairs.loc[("height_rmse", "rbpf-5"), "runs"] == 2
    assert set(report["exits"]["block"]) == {"all", "heading", "plan", "height"}
    assert (report["cost"]["endpoint"] > 0).all()


def test_the_first_of_a_pair_is_todays_filter(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    from graphslam_studies.segslam_trial import run_trial

    wanted = {(m.algorithm, m.quantity, m.submap): m.value for m in run_trial(STUDY.quick["court-quick"].grid, 1)
              if not m.timing and m.algorithm == "rbpf-5"}  # fmt: skip
    of = tables[0][(tables[0]["run"] == 0) & (tables[0]["algorithm"] == "rbpf-5 endpoint")]
    assert {("rbpf-5", q, int(k)): v for q, k, v in zip(of["quantity"], of["submap"], of["value"])} == wanted


def test_climbs_of_a_way_made_by_hand() -> None:
    x = np.arange(0.0, 100.0, 0.25)
    true = np.interp(x, [20.0, 40.0, 60.0, 80.0, 85.0], [0.0, 3.0, 3.0, 0.0, 0.5])  # the last is too short to count
    path = np.interp(x, [20.0, 40.0, 60.0, 80.0], [0.0, 2.7, 2.7, -0.6])
    found = climbs(
        level_poses(np.column_stack([x, 0 * x, path]), 0 * x), level_poses(np.column_stack([x, 0 * x, true]), 0 * x)
    )
    assert found.true == pytest.approx([3.0, -3.0], abs=0.05)
    assert found.error == pytest.approx([-0.1, 0.1], abs=0.01)
    level = level_poses(np.column_stack([x, 0 * x, 0 * x]), 0 * x)
    assert len(climbs(level, level).true) == 0


def test_pairs_are_made_of_the_same_runs() -> None:
    rows = [("w", run, f"a {p}", -1, "q", v) for p, of in (("endpoint", (1.0, 2.0, 9.0)), ("upright", (0.5, 2.5)))
            for run, v in enumerate(of)]  # fmt: skip
    (row,) = pair_table(pd.DataFrame(rows, columns=COLUMNS), ("q", "other")).to_dict("records")
    assert row["runs"] == 2  # the third has no rival
    assert (row["endpoint"], row["upright"], row["difference"], row["less"]) == (1.5, 1.5, 0.0, 1)
    assert row["low"] == pytest.approx(-row["high"])
    assert row["high"] == pytest.approx(12.706 * 0.5, rel=1e-3)  # Student's t of one degree, σ / √2 = 0.5


def test_exits_are_identified_by_block() -> None:
    rows: list[tuple[object, ...]] = [("w", 0, "a", -1, "failed", 0.0)]
    for k in range(40):
        rows += [("w", k // 4, "a", k % 4, f"exit_nees{s}", v)
                 for s, v in (("", 4.0), ("_heading", 1.0), ("_plan", 3.0), ("_height", 0.2))]  # fmt: skip
    found = exit_table(pd.DataFrame(rows, columns=COLUMNS)).set_index("block")
    assert found["nees"].to_dict() == pytest.approx({"all": 1.0, "heading": 1.0, "plan": 3.0, "height": 0.2})
    assert found.loc["plan", "nees"] > found.loc["plan", "honest_high"]
    assert found.loc["height", "nees"] < found.loc["height", "honest_low"]


def test_a_drawn_robot_is_that_of_its_seed() -> None:
    config = STUDY.full["garage-drawn"].grid
    a, b = drawn_garage(config, 3), drawn_garage(config, 4)
    assert a == drawn_garage(config, 3)
    assert a.crawler != b.crawler
    for name, (low, high) in ROBOTS.items():
        assert low <= getattr(a.crawler, name) <= high
