"""The study ``smartloc``: what is chosen on one half, scored on the other, and the recorded street beside the goal."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.errors import GraphSlamError
from graphslam.io.catalog import load_recording
from graphslam_studies import smartloc
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.montecarlo.study import open_study
from graphslam_studies.sim.satellites import SatelliteConfig, simulate_satellites
from graphslam_studies.smartloc import CAUCHY, STUDY, Score, chosen, scored, settings_of, windows


def test_it_is_a_study():
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("smartloc") is STUDY
    assert STUDY.worlds(False) == ("first-to-second", "second-to-first")


def test_the_quick_one_runs_by_its_command(tmp_path: Path):
    out = CliRunner().invoke(
        app, ["study", "smartloc", "--quick", "--trials", "1", "--out", str(tmp_path / "s"), "--json"]
    )
    assert out.exit_code == 0, out.output
    printed = json.loads(out.stdout)
    assert "gauss-markov" in str(printed)
    table = open_study(tmp_path / "s").table
    naive, consistent = (
        table[table["algorithm"] == a].set_index("quantity")["value"] for a in ("naive", "gauss-markov")
    )
    assert consistent["nees"] < 0.2 * naive["nees"]
    assert consistent["bias_sigma"] in (2.5, 5.0)
    assert {"rmse", "nees", "sigma", "rmse_chosen", "nees_chosen"} <= set(naive.index)


def test_parts_share_no_record():
    log = simulate_satellites(1, SatelliteConfig(seconds=40.0))
    parts = windows(log, 4)
    for name in ("odometry", "pseudoranges", "reference"):
        np.testing.assert_array_equal(np.concatenate([p[name].times for p in parts]), log[name].times)
        assert [len(p[name].times) for p in parts] == [10, 10, 10, 10]


def test_least_error_among_the_consistent_is_chosen(monkeypatch):
    """And where none is consistent, the one nearest to it."""
    scores = {1.0: Score(2.0, 30.0, 0.3, (0, 0)), 2.0: Score(6.0, 1.3, 5.0, (0, 0)), 3.0: Score(5.0, 0.8, 6.0, (0, 0))}
    monkeypatch.setattr(smartloc, "scored", lambda logs, settings, every: scores[settings["sigma_scale"]])
    assert chosen([], {"sigma_scale": (1.0, 2.0, 3.0)}, 1) == ({"sigma_scale": 3.0}, scores[3.0])
    scores[3.0] = replace(scores[3.0], nees=0.1)
    scores[2.0] = replace(scores[2.0], nees=2.0)
    assert chosen([], {"sigma_scale": (1.0, 2.0, 3.0)}, 1)[0] == {"sigma_scale": 2.0}
    monkeypatch.setattr(smartloc, "scored", lambda *_: (_ for _ in ()).throw(GraphSlamError("none")))
    with pytest.raises(GraphSlamError, match="no settings"):
        chosen([], {"sigma_scale": (1.0,)}, 1)


def test_settings_are_all_combinations():
    assert settings_of({}) == [{}]
    assert len(settings_of(smartloc.GRIDS["gauss-markov"])) == 12


def test_some_of_the_recorded_street(data_dir):
    """Forty seconds of it: with biases the error is less, and the covariance says how large it is."""
    log = load_recording("smartloc-gnss").slice(150.0, 190.0)
    naive = scored([log], {}, 10)
    settings = {CAUCHY: 1.0, "density_scale": 10.0, "bias_sigma": 5.0, "bias_time": 15.0, "bias_every": 1.0}
    consistent = scored([log], settings, 10)
    assert naive.nees > 100.0
    assert consistent.nees < 4.0
    assert consistent.rmse < min(naive.rmse, 12.0)
