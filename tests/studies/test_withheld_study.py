"""The study ``withheld-fixes``: which positions are used, steady motion, and the quick worlds of recorded logs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.records import Gps
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.montecarlo.study import open_study
from graphslam_studies.withheld_fixes import STUDY, scores_steady, steady_motion, used_of


def walked(rng: np.random.Generator, density: float, n: int = 240) -> Gps:
    """Fixes each second of a body whose acceleration is white noise of that density."""
    v = np.array([5.0, 0.0, 0.0]) + np.cumsum(0.1**0.5 * density * rng.standard_normal((10 * n, 3)), axis=0)
    p = np.cumsum(0.1 * v, axis=0)[::10]
    noisy = p + 0.07 * rng.standard_normal(p.shape)
    return Gps(times=np.arange(n) + 0.0, positions=noisy, sigma=np.full(n, 0.07), lever=np.zeros(3))


def test_it_is_a_study():
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("withheld-fixes") is STUDY
    assert STUDY.default_trials(False) == 1


def test_used_are_one_in_so_many_seconds_and_the_last():
    times = np.arange(0.0, 4.01, 0.05)
    used = times[used_of(times, 1.0)]
    np.testing.assert_allclose(used, [0.0, 1.0, 2.0, 3.0, 4.0], atol=0.051)
    np.testing.assert_array_equal(used_of(np.array([0.0, 1.0, 2.0, 3.0]), 2.0), [True, False, True, True])


def test_the_density_is_that_of_the_motion(rng):
    for density in (0.3, 2.0):
        assert steady_motion(walked(rng, density)).noise.accelerometer == pytest.approx(density, rel=0.2)
    assert steady_motion(walked(rng, 2.0), 0.5).noise.accelerometer == pytest.approx(1.0, rel=0.2)


def test_steady_motion_is_consistent_where_it_is_true(rng):
    """Every second fix withheld, acceleration as white as it is said to be."""
    found = scores_steady(walked(rng, 1.0, 160), 2.0, 1.0)
    assert 0.75 < found["nees"] < 1.3
    assert found["rmse"] < found["straight"]
    overconfident = scores_steady(walked(rng, 1.0, 160), 2.0, 0.2)
    assert overconfident["nees"] > 2.0


def test_the_quick_one_on_recorded_logs(data_dir: Path, tmp_path: Path):
    args = ["study", "withheld-fixes", "--quick", "--out", str(tmp_path / "s"), "--json"]
    out = CliRunner().invoke(app, args)
    assert out.exit_code == 0, out.output
    json.loads(out.stdout)
    table = open_study(tmp_path / "s").table
    flight, drive = (table[table["world"] == w].set_index("quantity")["value"] for w in ("euroc-quick", "kitti-quick"))
    assert flight["rmse"] < 0.05
    assert flight["rmse"] < 0.7 * flight["straight"]
    assert 0.1 < flight["nees"] < 2.5
    assert drive["rmse"] < 0.7 * drive["straight"]
    assert drive["nees_plane"] < 4.0
