"""Drives in closed loop: the quick study on the command line, a stop before a curb, and what counts as harm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam_studies.montecarlo.study import open_study
from graphslam_studies.terrain_drives import (
    FORGETTING,
    STUDY,
    DriveTrialConfig,
    draw_course,
    harm_of,
    run_drive_trial,
    struck,
)
from graphslam_studies.terrain_learning import FIRST_SEED

CURB = DriveTrialConfig(maps=("bands",), targets=("curb-15",), begin=4.0, beyond=2.5, longest=30.0)


def test_the_quick_one_on_the_command_line(tmp_path: Path) -> None:
    args = ["study", "terrain-drives", "--quick", "--trials", "1", "--out", str(tmp_path / "s"), "--json"]
    out = CliRunner().invoke(app, args)
    assert out.exit_code == 0, out.output
    json.loads(out.stdout)
    found = open_study(tmp_path / "s").table.set_index("quantity")["value"]
    assert found["arrived"] == found["right"] == 1.0
    assert found[["fall", "curb", "crash", "steep"]].sum() == 0.0
    assert 0.9 < found["detour"] < 1.6
    assert found["coverage"] > 0.9
    report = (tmp_path / "s" / "report.md").read_text()
    for text in ("threshold", "sweep", "braking", "speed bound"):
        assert text in report


def test_it_stops_before_a_curb_that_reaches_across() -> None:
    seed = next(s for s in range(50) if draw_course(s, CURB).street.passage is None)
    assert draw_course(seed, CURB).best is None
    found = {m.quantity: m.value for m in run_drive_trial(CURB, seed)}
    assert found["right"] == 1.0
    assert found["arrived"] == found["curb"] == found["way"] == 0.0


def test_harm_is_what_the_vehicle_touches_first() -> None:
    seed = next(s for s in range(50) if draw_course(s, CURB).street.passage is None)
    course = draw_course(seed, CURB)
    v, at = CURB.trial.vehicle, course.street.target_at
    way = np.column_stack([np.linspace(at - 3.0, at + 1.0, 200), np.zeros(200)])
    assert harm_of(way[way[:, 0] < at - 0.5 * v.width - 0.1], course, v) == ""
    assert harm_of(way, course, v) == "curb"
    down = draw_course(seed, replace(CURB, targets=("drop",)))
    if down.street.passage is None:
        assert harm_of(way, down, v) == "fall"


def test_drives_have_seeds_of_their_own() -> None:
    assert STUDY.default_trials(False) < FIRST_SEED


def test_a_person_is_struck_only_while_the_robot_moves() -> None:
    config = replace(CURB, movers=1, pace=(1.0, 1.0))
    course = draw_course(3, config)
    [person] = course.movers
    time = next(t for t in np.arange(0.0, 60.0, 0.1) if abs(person.state(np.array([t]))[0][0, 1]) < 0.05)
    x = person.start[0] + np.linspace(-0.5, 0.0, 50)  # 1 m/s, ends where the person is after half a second
    drives = np.column_stack([x, np.zeros(50)])
    v = config.trial.vehicle
    assert struck(drives, time - 0.5, course.movers, v)
    assert not struck(drives[-1:].repeat(50, axis=0), time - 0.5, course.movers, v)
    assert not struck(drives - [3.0, 0.0], time - 0.5, course.movers, v)


def test_a_map_that_forgets_shows_less_of_who_left() -> None:
    config = DriveTrialConfig(maps=FORGETTING, targets=("nothing",), movers=2)
    found = {(m.algorithm, m.quantity): m.value for m in run_drive_trial(config, 300)}
    assert found["bands", "ghost"] > 0.3
    assert found["bands, forgets", "ghost"] < 0.5 * found["bands", "ghost"]
