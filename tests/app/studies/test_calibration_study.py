"""The study ``calibration``: its quick world, and that its tables hold what they say."""

from __future__ import annotations

import json

from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.studies.calibration import STUDY
from graphslam.app.studies.definition import find_study


def test_quick_study_maps_a_drawn_robot_three_ways(tmp_path) -> None:
    assert find_study("calibration") is STUDY
    args = ["study", "calibration", "--quick", "--trials", "1", "--out", str(tmp_path / "s"), "--json"]
    result = CliRunner().invoke(app, args)
    assert result.exit_code == 0, result.output
    reports = json.loads(result.stdout)["reports"]
    honest = {r["algorithm"]: r["nees_poses"] for r in reports["maps"]}
    assert set(honest) == {"stated", "calibrated", "oracle"}
    assert honest["calibrated"] < 0.2 * honest["stated"]
    found = {r["quantity"]: r["median"] for r in reports["found"]}
    assert 0.8 < found["range_sigma_ratio"] < 1.2
    assert abs(found["clock_error"]) < 0.05
