"""What a newcomer types in the first hour, and reads."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app, error_line
from graphslam.app.run.run import Run
from graphslam.core.errors import ConfigError, MissingDataError, SolverError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam_frontends.landmarks.config import RbpfEkfConfig
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf

FEW = {"frontend": {"particles": 10}}


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=1)


@pytest.fixture(scope="module")
def run(log: SensorLog, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return gs.run(log, out=tmp_path_factory.mktemp("first") / "run", config=FEW, progress=False)


def test_units_are_in_the_help() -> None:
    text = " ".join(CliRunner().invoke(app, ["eval", "--help"], env={"COLUMNS": "200"}).output.split())
    assert "[m]" in text
    assert "[s]" in text


def test_help_loads_nothing_heavy() -> None:
    heavy = ("scipy", "pandas", "numba", "gtsam", "matplotlib")
    code = f"import sys, graphslam.app.cli; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_shells_complete_verbs() -> None:
    program = "from graphslam.app.cli import main; main()"
    asked = {
        "_GRAPHSLAM_COMPLETE": "complete_bash",
        "COMP_WORDS": "graphslam exp",
        "COMP_CWORD": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.argv[0] = 'graphslam'; {program}"],
        env={**os.environ, **asked}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["export"]


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("run my log --out r", "resume with: graphslam run my log --out r --resume"),
        ("run a --resume --out r", "resume with: graphslam run a --resume --out r"),
        ("-v demo", "resume with: graphslam -v demo"),
        ("study x --out s", "resume with: graphslam study x --out s"),
        ("report r", "unchanged"),
    ],
)
def test_ctrl_c_says_how_to_go_on(typed: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["graphslam", *typed.split()])
    assert error_line(KeyboardInterrupt()).endswith(said)


def test_ctrl_c_in_a_run_is_one_line_that_says_how_to_go_on(tmp_path: Path) -> None:
    """The real program, a real signal, after the first submap; and what it says to type goes on to the end."""
    log, out = tmp_path / "log", tmp_path / "run"
    CliRunner().invoke(app, ["simulate", "landmark-field", "--preset", "demo", "--out", str(log)])
    typed = ["run", str(log), "--set", "frontend.particles=150", "--out", str(out)]
    command = [sys.executable, "-m", "graphslam"]

    def hear() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

    with subprocess.Popen([*command, *typed], stderr=subprocess.PIPE, text=True, preexec_fn=hear) as run:
        until = time.monotonic() + 240.0
        while not any((out / "submaps").glob("*")) and run.poll() is None and time.monotonic() < until:
            time.sleep(0.01)
        run.send_signal(signal.SIGINT)
        errors = run.communicate()[1]
    assert run.returncode == 130, errors
    last = errors.splitlines()[-1]
    assert last.startswith("graphslam: interrupted; finished submaps are saved; resume with:")
    assert last.endswith(f"{' '.join(typed[2:])} --resume")
    assert "Traceback" not in errors
    more = subprocess.run([*command, *typed, "--resume", "--json"], capture_output=True, text=True, check=True)
    assert json.loads(more.stdout)


def test_a_run_prints_the_figures_that_are_asked_for_first(run: Run, tmp_path: Path) -> None:
    gs_log = tmp_path / "log"
    CliRunner().invoke(app, ["simulate", "landmark-field", "--preset", "quick", "--out", str(gs_log)])
    typed = ["run", str(gs_log), "--set", "frontend.particles=5", "--out", str(tmp_path / "r")]
    short = CliRunner().invoke(app, typed).stdout
    figures = short.split("more metrics")[0].splitlines()
    assert len(figures) < 20
    assert any(line.startswith("nees_per_dof") for line in figures)
    every = CliRunner().invoke(app, [*typed[:-1], str(tmp_path / "s"), "--all"]).stdout
    assert "frontend_scans" in every
    assert "frontend_scans" not in short


def test_a_wrong_name_is_reported_before_anything_is_read() -> None:
    with pytest.raises(UnknownNameError, match="front end 'segslamm'; did you mean segslam"):
        gs.run("no-such-log", frontend="segslamm")
    with pytest.raises(UnknownNameError, match="solver 'isam3'"):
        gs.run("no-such-log", solver="isam3")


def test_a_front_end_is_given_by_name_as_a_class_or_as_an_object(log: SensorLog, run: Run) -> None:
    made = [
        gs.run(log, frontend=f, config=c, progress=False)
        for f, c in [("rbpf-ekf", FEW), (RbpfEkf, FEW), (RbpfEkf(config=run_config(run)), {})]
    ]
    for other in made:
        assert np.array_equal(other.map.node_poses, run.map.node_poses)
        assert other.report["frontend"] == "rbpf-ekf"
    with pytest.raises(ConfigError, match="given as an object, which has its options"):
        gs.run(log, frontend=RbpfEkf(), config=FEW, progress=False)
    for wrong in (3, dict):
        with pytest.raises(ConfigError, match="inherits from"):
            gs.run(log, frontend=wrong, progress=False)  # type: ignore[arg-type]


def run_config(run: Run) -> RbpfEkfConfig:
    from graphslam.app.run.files import read_options
    from graphslam.core.config import build_config

    assert run.folder is not None
    made: RbpfEkfConfig = build_config(RbpfEkfConfig, read_options(run.folder)["frontend"])
    return made


class Unregistered(RbpfEkf):
    """A front end of somebody, tried out before it is installed."""

    name: ClassVar[str] = "unregistered"


def test_a_front_end_that_is_not_installed_can_be_tried(log: SensorLog) -> None:
    assert gs.run(log, frontend=Unregistered, config=FEW, progress=False).report["frontend"] == "unregistered"


def test_values_say_in_a_line_what_they_are(log: SensorLog, run: Run) -> None:
    for value in (run, run.map, run.map.trajectory, run.truth, run.solution, run.graph, log, log.truth):
        assert len(repr(value)) < 200, type(value)
    assert "e+0" not in repr(run.metrics)
    assert "e+0" not in run.metrics._repr_html_()


def test_an_opened_run_has_its_graph_and_solution(run: Run) -> None:
    assert run.folder is not None
    opened = gs.open_run(run.folder)
    assert not opened.holds("graph")
    assert opened.solution is not None
    assert run.solution is not None
    np.testing.assert_array_equal(opened.solution.poses, run.solution.poses)
    np.testing.assert_allclose(opened.solution.covariance(2), run.solution.covariance("x2"), rtol=1e-9)
    assert opened.graph is not None
    assert len(opened.graph.submaps) == len(run.submaps)
    assert opened.holds("graph")
    assert opened.fused is None  # landmark submaps have no grids


def test_a_marginal_is_asked_for_by_number_or_name(run: Run) -> None:
    assert run.solution is not None
    np.testing.assert_array_equal(run.solution.covariance(1), run.solution.covariance("x1"))
    assert run.solution.covariance(0).tolist() == np.zeros((3, 3)).tolist()
    with pytest.raises(SolverError, match="no variable 'x999'"):
        run.solution.covariance(999)


def test_a_missing_log_is_still_named() -> None:
    with pytest.raises((UnknownNameError, MissingDataError), match="no-such-log"):
        gs.run("no-such-log")
