"""``graphslam --help``, ``eval`` and ``init``: what they print, draw and write."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import GROUPS, app
from graphslam.app.config_file import config_file
from graphslam.app.option_table import option_rows
from graphslam.app.run.config import RunConfig
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.core.config import build_config
from graphslam.core.errors import DataError
from graphslam.core.poses import SE2, SE3
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.path_consistency import path_nees
from graphslam.evaluate.trajectory_error import ate
from graphslam.io.tum import read_path, write_kitti, write_tum

LINES = {name: text for group in GROUPS.values() for name, text in group.items()}


def printed(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.stdout


def test_help_has_every_command_once_on_one_line() -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    for title, lines in GROUPS.items():
        assert f"{title}:\n" in shown
        for name, text in lines.items():
            assert len([x for x in shown.splitlines() if x.split(maxsplit=1) == [name, text]]) == 1, name
    assert set(LINES) == {c.name or "" for c in app.registered_commands} | {"data", "study", "terrain-tables"}


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trajectory, Trajectory]:
    """A reference in space, and an estimate of it in another frame."""
    rng = np.random.default_rng(1)
    folder, n = tmp_path_factory.mktemp("paths"), 200
    steps = SE3.exp(np.tile([0.0, 0.0, 0.05, 0.5, 0.0, 0.01], (n, 1)) + 0.002 * rng.standard_normal((n, 6)))
    poses = [SE3.identity]
    for s in steps:
        poses.append(SE3.compose(poses[-1], s))
    reference = Trajectory(0.1 * np.arange(n + 1), np.array(poses))
    noisy = SE3.compose(reference.poses, SE3.exp(0.05 * rng.standard_normal((n + 1, 6))))
    estimate = Trajectory(reference.times, noisy).transformed(SE3.exp(np.array([0.1, -0.2, 0.5, 4.0, 5.0, 6.0])))
    for name, path in (("reference", reference), ("estimate", estimate)):
        write_tum(folder / f"{name}.tum", path)
        write_kitti(folder / f"{name}.txt", path)
    return folder, estimate, reference


@pytest.mark.parametrize("ending", ["tum", "txt"])
def test_eval_of_tum_and_kitti_files_is_the_textbook_figure(
    paths: tuple[Path, Trajectory, Trajectory], ending: str
) -> None:
    """Umeyama's alignment and RMSE in a few lines of NumPy, as evo computes them."""
    folder, estimate, reference = paths
    p, q = estimate.positions, reference.positions
    U, _, Vt = np.linalg.svd((q - q.mean(0)).T @ (p - p.mean(0)))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    wanted = np.sqrt(np.mean(np.sum(((p - p.mean(0)) @ R.T + q.mean(0) - q) ** 2, axis=1)))
    picture = folder / f"{ending}.png"
    command = ["eval", folder / f"estimate.{ending}", folder / f"reference.{ending}", "--save-plot", picture, "--json"]
    value = json.loads(printed(*command))
    assert value["ate"]["rmse"] == pytest.approx(wanted, rel=1e-6)
    assert value["ate"]["pairs"] == len(reference)
    assert "nees" not in value
    assert picture.read_bytes().startswith(b"\x89PNG")
    np.testing.assert_allclose(read_path(folder / "estimate.txt").poses[:, :3], estimate.positions, atol=1e-12)


def test_what_is_no_pose_is_refused_with_its_number(tmp_path: Path) -> None:
    bad = tmp_path / "bad.txt"
    good = "1 0 0 5 0 1 0 6 0 0 1 7\n"
    for text in ("2 0 0 5 0 1 0 6 0 0 1 7\n", "nan 0 0 5 0 1 0 6 0 0 1 7\n", "-1 0 0 5 0 1 0 6 0 0 1 7\n"):
        bad.write_text(good + text)
        done = CliRunner().invoke(app, ["eval", str(bad), str(bad)])
        assert "pose 2" in str(done.exception)


def test_the_plotted_path_is_the_scored_one(paths: tuple[Path, Trajectory, Trajectory]) -> None:
    from graphslam.plots.trajectory import plot_trajectory_error

    _, estimate, reference = paths
    error = ate(estimate, reference)
    aligned = error.aligned(estimate)
    off = np.linalg.norm(aligned.positions - reference.positions, axis=1)
    np.testing.assert_allclose(off, error.translation, atol=1e-9)
    axes = plot_trajectory_error(aligned, reference, error)
    assert {line.get_label() for line in axes.get_lines()} >= {"estimate", "truth"}
    (below,) = [a for a in axes.figure.axes if a is not axes]
    np.testing.assert_array_equal(below.get_lines()[0].get_ydata(), error.translation)


def test_nees_is_one_per_dof_for_right_covariances_and_shows_wrong_ones(rng: np.random.Generator) -> None:
    """The first pose is certain, as the first base of a run is; the frame of the reference is another one."""
    n = 4000
    P = np.diag([0.04, 0.01, 0.0025])
    times = np.arange(n, dtype=float)
    true = SE2.exp(rng.uniform(-1.0, 1.0, (n, 3)) * [20.0, 20.0, 3.0])
    other = Trajectory(times, true).transformed([7.0, -3.0, 2.0])
    for factor in (1.0, 0.5, 2.0):
        poses = SE2.compose(true, SE2.exp(rng.multivariate_normal(np.zeros(3), P, n)))
        poses[0] = true[0]
        claimed = np.tile(factor * P, (n, 1, 1))
        claimed[0] = 0.0
        found = path_nees(Trajectory(times, poses, claimed), other, max_diff=0.01)
        assert found["poses"] == n - 1
        # mean of 4,000 values of variance 2/3: a standard deviation of 1.3 %
        assert found["nees_per_dof"] * factor == pytest.approx(1.0, abs=0.06)
        assert (abs(found["inside_95"] - 0.95) < 0.02) == (factor == 1.0)
    with pytest.raises(DataError, match="too few"):
        path_nees(Trajectory(times, poses, claimed), Trajectory(times + 1e6, true), max_diff=0.01)


@pytest.fixture(scope="module")
def log_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from graphslam.app.worlds import write_simulated

    folder = tmp_path_factory.mktemp("init") / "field"
    write_simulated(gs.simulate("landmark-field", preset="quick", seed=1), folder)
    return folder


def test_init_writes_every_option_and_changes_nothing(log_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "own.toml"
    printed("init", log_folder, "-o", out)
    text = out.read_text()
    assert tomllib.loads(text) == {}
    for row in [*option_rows("rbpf-ekf"), *option_rows()]:
        assert f"# {row.option} = " in text, row.option
    again = CliRunner().invoke(app, ["init", str(log_folder), "-o", str(out)])
    assert "--force" in str(again.exception)
    printed("init", log_folder, "-o", out, "--force")
    assert out.read_text() == text


def test_the_values_of_the_file_are_those_of_the_run(log_folder: Path) -> None:
    """Without the #, the options of the run are the same as without the file."""
    log = gs.load(log_folder)
    text = config_file(log, "field")
    assert "[preset]" in text
    rows = [x[2:] for x in text.splitlines() if x.startswith("# ") and " = " in x and " = …" not in x and x[2] != " "]
    values = tomllib.loads("\n".join(rows))
    assert RunConfig().calibrate.given is None
    frontend = values.pop("frontend")
    del values["calibrate"]["given"]
    for part in ("noise", "smoothing_noise", "biases"):  # left out by default: one option of it would add it
        del frontend[part]
    recommended = recommended_options(log, "rbpf-ekf")
    own = recommended.pop("frontend")
    assert build_config(RunConfig, values) == build_config(RunConfig, recommended)
    assert make_front_end("rbpf-ekf", frontend).config == make_front_end("rbpf-ekf", own).config
