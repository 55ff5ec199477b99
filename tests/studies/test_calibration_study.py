"""The study ``calibration``: its quick world, and that its tables hold what they say."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE2, SE3, group_of
from graphslam.core.records import Odometry
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_studies.calibration import STUDY
from graphslam_studies.calibration_scanned import Added, faulty
from graphslam_studies.montecarlo.definition import find_study


def test_quick_study_maps_a_drawn_robot_three_ways(tmp_path) -> None:
    assert find_study("calibration") is STUDY
    args = ["study", "calibration", "--quick", "--trials", "1", "--out", str(tmp_path / "s"), "--json"]
    result = CliRunner().invoke(app, args)
    assert result.exit_code == 0, result.output
    reports = json.loads(result.stdout)["reports"]
    consistent = {r["algorithm"]: r["nees_poses"] for r in reports["maps"]}
    assert set(consistent) == {"stated", "calibrated", "oracle"}
    assert consistent["calibrated"] < 0.2 * consistent["stated"]
    found = {r["quantity"]: r["median"] for r in reports["found"]}
    assert 0.8 < found["range_sigma_ratio"] < 1.2
    assert abs(found["clock_error"]) < 0.05
    (planted,) = reports["planted"]
    assert planted["error"] == "yaw rate 0.3 deg/s"
    assert planted["within"] == 1.0
    assert planted["false_clock"] == 0.0


def wandering(g, seed: int = 2) -> SensorLog:
    """Odometry of a body that leans by some degrees and wanders, in the plane or in space."""
    rng = np.random.default_rng(seed)
    xi = np.zeros((400, g.dof))
    xi[1:, g.heading] = 0.05 * rng.standard_normal(399)
    xi[1:, g.position.start] = 0.1
    if g.dof == 6:
        xi[1:200, 0] = 0.002
    times = 0.5 * np.arange(400)
    odometry = Odometry(times=times, increments=g.exp(xi), covariances=np.tile(1e-6 * np.eye(g.dof), (400, 1, 1)))
    return SensorLog(name="wandering", streams={"odometry": odometry})


@pytest.mark.parametrize("g", [SE2, SE3], ids=["plane", "space"])
def test_added_errors_are_those_that_were_asked_for(g) -> None:
    log = wandering(g)
    worse = faulty(log, Added(bias=0.01, scale=1.05))["odometry"]
    before, after = (g.log(o.increments) for o in (log["odometry"], worse))
    metres = [np.linalg.norm(xi[1:, g.position], axis=1).sum() for xi in (before, after)]
    assert metres[1] / metres[0] == pytest.approx(1.05, abs=1e-3)
    turn = g.log(g.between(*(chain_odometry(o).poses[-1] for o in (log["odometry"], worse))))
    assert group_of(worse.increments) is g
    wrapped = np.mod(0.01 * 199.5 + np.pi, 2 * np.pi) - np.pi
    if g is SE2:
        assert turn[g.heading] == pytest.approx(wrapped, abs=1e-6)
    else:  # about the vertical: what the body leans by stays
        up = [
            g.transform(np.r_[0, 0, 0, chain_odometry(o).poses[-1, 3:]], np.array([0.0, 0, 1]))[2]
            for o in (log["odometry"], worse)
        ]
        assert up[1] == pytest.approx(up[0], abs=2e-3)
        assert np.linalg.norm(turn[:3]) == pytest.approx(wrapped, rel=0.02)


def test_added_noise_is_that_which_was_drawn() -> None:
    log = wandering(SE2)
    worse = faulty(log, Added(along=0.05, heading=0.02), seed=3)["odometry"]
    e = SE2.log(SE2.between(log["odometry"].increments[1:], worse.increments[1:])) / np.sqrt(0.1)
    assert np.std(e[:, 0]) == pytest.approx(0.05, rel=0.15)
    assert np.std(e[:, 2]) == pytest.approx(0.02, rel=0.15)
    assert Added.drawn(1) != Added.drawn(2)
    assert Added.drawn(1) == Added.drawn(1)
