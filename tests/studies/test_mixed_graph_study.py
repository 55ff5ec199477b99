"""The study ``mixed``: one optimum for every method, each sensor where it should be, and a report that says so."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import graphslam as gs
from graphslam.app.compare import DEFAULT_METHODS
from graphslam_studies.mixed_graph import SENSORS, STUDY, with_sensors
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.segslam_report import values


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """One quick world."""
    found = [m for m in STUDY.trial("quick", True)(5) if not m.timing]
    rows = [("quick", 0, m.algorithm, m.submap, m.quantity, m.value) for m in found]
    return pd.DataFrame(rows, columns=["world", "run", "algorithm", "submap", "quantity", "value"])


def test_it_is_a_study() -> None:
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("mixed") is STUDY
    assert (STUDY.default_trials(False), STUDY.default_trials(True)) == (20, 2)


def test_every_method_has_one_optimum_with_each_sensor_and_without(table: pd.DataFrame) -> None:
    objectives = []
    for sensors in SENSORS:
        after = [float(values(table, "quick", m + sensors, "objective_after")[0]) for m in DEFAULT_METHODS]
        assert max(after) - min(after) < 1e-6 * max(after)
        before = [float(values(table, "quick", m + sensors, "objective_before")[0]) for m in DEFAULT_METHODS]
        assert min(before) >= min(after) * (1 - 1e-9)
        objectives.append(min(after))
    assert objectives == sorted(objectives, reverse=True)  # every sensor adds its χ²
    classes = {s: set(table[table["algorithm"] == f"batch{s}"]["quantity"]) for s in SENSORS}
    for sensors in SENSORS:
        assert ("chi2_gps" in classes[sensors]) == ("gps" in sensors)
        assert ("chi2_imu" in classes[sensors]) == ("imu" in sensors)
        assert "chi2_submaps" in classes[sensors]


def test_the_report_scores_poses_and_landmarks(table: pd.DataFrame, tmp_path: Path) -> None:
    report = STUDY.report(table, pd.DataFrame())
    found = report["consistency"].set_index("algorithm")
    assert len(found) == len(SENSORS) * len(DEFAULT_METHODS)
    n = values(table, "quick", "batch", "dof")[0]
    parts = report["parts"]
    assert parts[parts["graph"] == "batch"]["n"].sum() == n
    assert (found["low"] < 1.0).all()
    assert (found["high"] > 1.0).all()
    assert found.loc["batch+gps+imu", "rmse_poses"] <= found.loc["batch", "rmse_poses"]
    assert len(report["verdict"]) == len(SENSORS)
    assert report["verdict"]["verdict"].str.contains("NEES/n").all()
    assert {p.name for p in STUDY.figures(table, pd.DataFrame(), tmp_path)} == {"nees_before.png", "nees_after.png"}


def test_a_graph_without_a_sensor_leaves_the_other_as_it_is() -> None:
    log = gs.simulate("mixed", seed=1, preset="quick")
    options = {"frontend": {"rbpf-ekf": {"association": "known", "particles": 5}}, "map": {"fuse": False}}
    graph = gs.run(log, frontend=["segslam", "rbpf-ekf"], config=options, progress=False).graph
    before = graph.objective()
    assert {r.group for r in with_sensors(graph, "+gps").records.values()} >= {"gps", "submap", "dense-submap"}
    assert not any(r.group.startswith(("gps", "imu")) for r in with_sensors(graph, "").records.values())
    assert graph.objective() == before
