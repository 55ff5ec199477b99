"""The study ``terrain``: its quick mode on the command line, what it counts, and tables learnt elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.errors import ConfigError
from graphslam.maps.terrain.line_kernels import OVERHANG, STEP
from graphslam.maps.terrain.pyramid import Pyramid
from graphslam.maps.terrain.tables import read_tables
from graphslam.maps.terrain.vehicle import CELLS, LineSensor, Vehicle
from graphslam_studies.montecarlo.study import open_study
from graphslam_studies.terrain import STUDY
from graphslam_studies.terrain_learning import FIRST_SEED, learn_tables
from graphslam_studies.terrain_trial import BOX, FixedGrid, TerrainTrialConfig, coarser


def test_the_quick_one_on_the_command_line(tmp_path: Path) -> None:
    args = ["study", "terrain", "--quick", "--trials", "1", "--out", str(tmp_path / "s"), "--json"]
    out = CliRunner().invoke(app, args)
    assert out.exit_code == 0, out.output
    json.loads(out.stdout)
    table = open_study(tmp_path / "s").table
    mine = table[table["algorithm"] == "multigrid"].set_index(["world", "quantity", "submap"])["value"]
    assert mine["quick", "seen_curb-10", 225] == 1.0
    assert mine["quick", "blocked_nothing", 225] == 0.0
    assert mine["quick-fixed", "seen_curb-15", 225] == 1.0
    assert mine["quick", "false_flat", -1] <= 0.01
    report = (tmp_path / "s" / "report.md").read_text()
    for text in ("climbable step", "threshold", "braking", "coverage", "single-equal"):
        assert text in report


def test_tables_of_the_package_were_learnt_elsewhere() -> None:
    seeds = read_tables().provenance["seeds"]
    assert min(seeds) >= FIRST_SEED > STUDY.default_trials(False)


def test_tables_say_what_was_taught() -> None:
    few = TerrainTrialConfig(start=4.5)
    made = learn_tables(seeds=(7,), targets=("curb-15", "hole-1.0"), config=few, progress=False)
    step, support = made.ratios / 256
    assert np.all(step[:2, 10:14].mean(axis=1) > 0.5)  # 10 cm and more speak for a hazard …
    assert np.all(step[:2, 0] < 0.0)  # … and level ground against it
    assert support[0, 30] > 0.5 > support[0, 0]
    assert made.provenance["seeds"] == [7]
    with pytest.raises(ConfigError, match="at least one drive"):
        learn_tables(seeds=())


def test_a_fixed_grid_adds_a_hit_or_a_miss_a_line_and_cell() -> None:
    grid = FixedGrid(Pyramid(BOX, read_tables(), Vehicle(), LineSensor(), (0.2,) * len(CELLS)))
    rows = [
        (0, 1, 3, 3, STEP, 9), (0, 1, 3, 3, STEP, 1),  # one line: a hit
        (1, 1, 3, 3, STEP, 1), (2, 1, 3, 3, STEP, 1),  # two misses
        (3, 1, 4, 3, OVERHANG, 1),
    ]  # fmt: skip
    grid.add(np.array(rows, np.int32))
    assert grid.hits.sum() == 2
    assert grid.misses.sum() == 2
    equal, octomap = grid.verdict((0.4, 0.4)), grid.verdict((0.85, 0.4))
    assert equal.hazard.sum() == 4  # the second cell, in cells of 0.1 m
    assert octomap.hazard.sum() == 8
    assert equal.known.sum() == 8


def test_coarser_labels() -> None:
    truth = np.array([[0, 0, -1, 0], [0, 0, 0, 0], [3, 0, -1, -1], [0, -1, -1, -1]])
    assert coarser(truth, 2).tolist() == [[0, -1], [3, -1]]
