"""A run with control and check points: its results, its folder, resumed and read again, and the command line."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.run.control import control_findings
from graphslam.app.run.reopened import resolve_from_folder
from graphslam.app.run.summary import summarise_run
from graphslam.app.verdict.checks import findings_from_metrics
from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.errors import DataError, RunFolderError
from graphslam.evaluate.check_points import CheckPoints
from graphslam.graph.factors.control import ControlRecord
from graphslam.io.log_store import save_log
from graphslam.join.graph_problem import JoinProblem
from tests.reference.surveyed import surveyed

FRONT = {"particles": 10}
SIGMA = 0.02


@pytest.fixture(scope="module")
def log():
    return gs.simulate("landmark-field", preset="quick", seed=5)


def truth_rows(log, times, seed: int, sigma: float = SIGMA, **cells) -> list[dict]:
    at = log.truth.trajectory.interpolate(np.asarray(times))[:, :2]
    return surveyed(zip(list(times), at), np.random.default_rng(seed), sigma, **cells)


@pytest.fixture(scope="module")
def rows(log):
    a, b = log.interval
    control = truth_rows(log, np.linspace(a + 3.0, b - 3.0, 5), 1)
    check = truth_rows(log, np.linspace(a + 5.0, b - 5.0, 14), 2)
    ends = log.truth.trajectory.interpolate(np.array([a + 4.0, b - 4.0]))[:, :2]
    far = {"place": a + 4.0, "to": b - 4.0, "distance": float(np.linalg.norm(ends[0] - ends[1])), "sigma": SIGMA}
    return [*control, far, {"place": "l9999", "x": 0, "y": 0, "sigma": 1}], [*check, {**check[0], "sigma": -1}]


@pytest.fixture(scope="module")
def run(log, rows, tmp_path_factory):
    out = tmp_path_factory.mktemp("control") / "run"
    options = {"frontend": FRONT, "control": rows[0], "check": rows[1]}
    return gs.run(log, frontend="rbpf-ekf", config=options, out=out, progress=False)


def test_the_report_the_metrics_and_the_verdict(run):
    control, check = run.report["control_points"], run.report["check_points"]
    assert (control["used"], control["frame"]) == (6, "survey")
    assert [r["line"] for r in control["refused"]] == [8]
    assert len(run.check_points) == len(check["rows"]) == 14
    assert run.metric("check_rmse") == pytest.approx(np.sqrt(np.mean(run.check_points["error"] ** 2)))
    assert run.metric("check_rmse") < 0.2
    assert run.metric("check_nis_dof") == 28.0
    assert check["low"] < check["nis_per_dof"] < check["high"]
    assert 0.05 < check["power"] == run.metric("check_power")
    lines = {f.code: f.text for f in run.verdict}
    assert "line 8: no landmark has this id; got l9999" in lines["control-points-refused"]
    assert "14 of 15 rows used — refused: line 16: sigma is not above 0; got -1" in lines["check-points-refused"]
    assert f"— {check['verdict']}:" in lines["check-points"]
    assert "RMSE at the check points" in run.headline.text or "ground truth" in run.headline.text
    assert set(run.ledger["stream"]) >= {f"control rows/{k}" for k in range(2, 8)}
    T = np.array(control["T_control_map"])
    assert run.map.T_gps_world is None
    assert T.shape == (3,)


def test_rows_at_times_hold_points_of_the_paths_of_submaps(run):
    held = [r for r in run.graph.records.values() if isinstance(r, ControlRecord)]
    assert len(held) == 5
    assert all(r.point is not None for r in held)
    assert {"control", "distance", "path"} <= set(JoinProblem.of_graph(run.graph).factor_counts())


def test_the_folder_holds_it(run, log, rows, tmp_path):
    opened = gs.open_run(run.folder)
    assert opened.check_points.equals(run.check_points)
    assert opened.metric("check_nis_value") == run.metric("check_nis_value")
    graph, solution = resolve_from_folder(run.folder)
    assert solution.objective == pytest.approx(run.solution.objective, rel=1e-9)
    assert sum(isinstance(r, ControlRecord) for r in graph.records.values()) == 5
    page = (run.folder / "report.html").read_text()
    assert "Control and check points" in page
    before = (run.folder / "metrics.json").read_bytes()
    options = {"frontend": FRONT, "control": rows[0], "check": rows[1]}
    again = gs.run(log, frontend="rbpf-ekf", config=options, out=run.folder, resume=True, progress=False)
    assert again.report["resumed_submaps"] == len(run.submaps)
    assert (run.folder / "metrics.json").read_bytes() == before
    other = gs.run(log, frontend="rbpf-ekf", config=options, out=tmp_path / "other", progress=False)
    assert (other.folder / "metrics.json").read_bytes() == before
    with pytest.raises(RunFolderError, match=r"cannot resume, run\.check"):
        gs.run(log, frontend="rbpf-ekf", config=options | {"check": rows[1][:3]}, out=run.folder, resume=True)


def test_without_control_the_frame_is_moved_and_the_map_is_that_of_a_plain_run(run, log, rows):
    plain = gs.run(log, frontend="rbpf-ekf", config={"frontend": FRONT}, progress=False)
    held = gs.run(log, frontend="rbpf-ekf", config={"frontend": FRONT, "check": rows[1]}, progress=False)
    np.testing.assert_array_equal(plain.map.trajectory.poses, held.map.trajectory.poses)
    assert held.report["check_points"]["aligned"] == 3
    assert held.report["check_points"]["dof"] == 25.0
    assert "check_points" not in plain.report
    assert plain.check_points.empty


@pytest.mark.parametrize(
    ("nis", "power", "first"),
    [(1.0, 0.9, "Consistent"), (1.0, 0.5, "Not tested"), (0.1, 0.9, "Conservative"), (3.0, 0.9, "Overconfident"),
     (20.0, 0.9, "Wrong")],
)  # fmt: skip
def test_check_points_give_a_map_that_nothing_else_tests_its_word(nis, power, first):
    rows = [{"line": 2, "error": 0.1, "sigma": 0.1, "nis": 2.0 * nis, "dof": 2}]
    facts = CheckPoints("check.csv", rows, [], 40.0 * nis, 40.0, power).facts()
    report = {"evidence": [], "converged": True, "check_points": facts}
    figures = RunMetrics(report, {"submaps": 3.0, "path_length": 30.0, "check_rmse": 0.1})
    lines = [*control_findings(report), *findings_from_metrics(figures)]
    assert summarise_run(figures, lines).text.startswith(first)


def test_a_refined_path_is_held_by_rows_at_times():
    log = gs.simulate("court", preset="light", seed=1)
    (begin, end), path = log.interval, log.truth.trajectory

    def rows(times, seed):
        at = path.interpolate(times)[:, :3]
        return surveyed(zip(times.tolist(), at), np.random.default_rng(seed), SIGMA)

    control = rows(np.linspace(begin + 3.0, end - 3.0, 6), 1)
    ends = path.interpolate(np.array([begin + 4.0, end - 9.0]))[:, :3]
    far = float(np.linalg.norm(ends[0] - ends[1]))
    control.append({"place": begin + 4.0, "to": end - 9.0, "distance": far, "sigma": SIGMA})
    options = {"control": control, "check": rows(np.linspace(begin + 5.0, end - 5.0, 12), 2)}
    run = gs.run(log, config=options, progress=False)
    assert run.refined is not None
    assert run.refined.refinement.fixes.used == 6
    assert run.map.T_gps_world is None
    lines = {f.code: f.text for f in run.verdict}
    assert "6 of 7 rows hold the refined path" in lines["control-points-refined"]
    assert lines["refine-fixes"].startswith("control points in the refinement: 6")
    check = run.report["check_points"]
    assert (check["aligned"], check["dof"]) == (4, 32.0)
    assert check["low"] < check["nis_per_dof"] < check["high"]
    held = run.ledger[run.ledger["factor"] == "fixes"]
    assert sorted(held["stream"]) == [f"control rows/{k}" for k in range(2, 8)]


def test_tables_without_a_row_stop_the_run(log):
    with pytest.raises(DataError, match=r"rows: no row can be used \(line 2: sigma is not above 0"):
        gs.run(log, config={"check": [{"place": 3.0, "x": 0, "y": 0, "sigma": 0}]}, progress=False)


def write_csv(path: Path, rows: list[dict]) -> Path:
    with path.open("w", newline="") as stream:
        table = csv.DictWriter(stream, ["place", "to", "frame", "x", "y", "distance", "sigma"])
        table.writeheader()
        table.writerows(rows)
    return path


def test_the_command(log, rows, tmp_path):
    save_log(log, tmp_path / "log")
    command = ["run", str(tmp_path / "log"), "--frontend", "rbpf-ekf", "--set", "frontend.particles=10", "--json"]
    for name, table in zip(("control", "check"), rows):
        command += [f"--{name}", str(write_csv(tmp_path / f"{name}.csv", table))]
    done = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    value = json.loads(done.stdout)
    assert value["report"]["control_points"]["source"] == "control.csv"
    assert value["report"]["check_points"]["rows"]
    missing = CliRunner().invoke(app, [*command[:-1], str(tmp_path / "none.csv"), "--out", str(tmp_path / "b")])
    assert "none.csv: no such file" in str(missing.exception)
