"""The study ``exits``: drawn robots, what is told of them, and tables."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.sim.crawler_config import CrawlerConfig
from graphslam_studies.exits import FACTOR, STUDY, assumed_noise, drawn_robot, inside_table
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study

COLUMNS = ["world", "run", "algorithm", "submap", "quantity", "value"]


def test_robots_are_drawn_over_a_factor_of_four_around_every_default() -> None:
    assert drawn_robot(3) == drawn_robot(3) != drawn_robot(4)
    assert drawn_robot(0) == (CrawlerConfig(), 1.0)
    robots = [drawn_robot(n) for n in range(100, 400)]
    for name, factor in FACTOR.items():
        default = 1.0 if name == "speed" else getattr(CrawlerConfig(), name)
        by = np.array([speed if name == "speed" else getattr(robot, name) for robot, speed in robots]) / default
        assert np.all((by > 0.98 / factor) & (by < 1.02 * factor))
        assert np.std(np.log(by)) == pytest.approx(np.log(factor) / np.sqrt(3.0), rel=0.15)
    noise = ("wheel_sigma", "wheel_scale", "range_sigma", "drift", "gyro", "attitude_sigma", "attitude_bias")
    assert min(FACTOR[name] ** 2 for name in noise) >= 4.0


def test_the_estimator_is_reported_what_a_data_sheet_says() -> None:
    robot, _ = drawn_robot(2)
    noise = assumed_noise(robot)
    assert (noise.wheel, noise.wheel_scale, noise.attitude_bias) == (
        robot.wheel_sigma,
        robot.wheel_scale,
        robot.attitude_bias,
    )


def test_the_quick_study_tells_of_the_exits_of_both_filters() -> None:
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("exits") is STUDY
    rows = [("court-quick", 0, m.algorithm, m.submap, m.quantity, m.value)
            for m in STUDY.trial("court-quick", True)(1) if not m.timing]  # fmt: skip
    table = pd.DataFrame(rows, columns=COLUMNS)
    assert not table[table["quantity"] == "failed"]["value"].any()
    found = STUDY.report(table, table.iloc[:0])
    exits = found["exits"].set_index(["algorithm", "block"])["exits"]
    assert exits[("rbpf-5", "all")] == 1  # where the log ends
    assert exits[("segslam-5", "all")] > 1
    assert set(found["inside"]["algorithm"]) == {"rbpf-5", "segslam-5"}


def test_the_share_inside_is_that_of_four_components() -> None:
    rows = [("w", k // 5, "a", k % 5, "exit_nees", v) for k, v in enumerate([1.0, 9.4, 9.6, 2.0, 30.0] * 2)]
    rows.append(("w", 0, "a", -1, "failed", 0.0))
    (row,) = inside_table(pd.DataFrame(rows, columns=COLUMNS)).to_dict("records")
    assert (row["runs"], row["exits"], row["inside"]) == (2, 10, pytest.approx(0.6))
