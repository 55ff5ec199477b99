"""The command line: JSON alone on stdout, exit codes, one clear line per error."""

from __future__ import annotations

import gzip
import json
import logging
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.cli.terminal import log_to_stderr
from graphslam.app.worlds import simulate
from graphslam.core.progress import Bar
from graphslam.core.trajectory import Trajectory
from graphslam.io.log_store import save_log
from graphslam.io.tum import read_tum, write_tum
from tests.command_line import graphslam


def in_a_process(*args: object, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    command = [sys.executable, "-m", "graphslam", *map(str, args)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, env={**os.environ, **(env or {})}
    )


def refused(*args: object, saying: str, env: dict[str, str] | None = None) -> None:
    """Exit 1, nothing on stdout, one line on stderr that says what is wrong; before it, at most bars of progress."""
    found = in_a_process(*args, env=env) if env else graphslam(*args)
    code, out, err = found.returncode, found.stdout, found.stderr
    assert code == 1, (out, err)
    assert out == ""
    bars = "read: ", "front end: ", "compiling "
    lines = [x for x in err.splitlines() if x.strip() and not x.startswith(bars)]
    assert len(lines) == 1, err
    assert saying in lines[0]
    assert lines[0].startswith("graphslam: ")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """A finished run of a simulated log, made by the command line itself."""
    root = tmp_path_factory.mktemp("cli")
    made = graphslam("simulate", "landmark-field", "--preset", "quick", "--seed", 2, "--out", root / "log", "--json")
    assert made.returncode == 0, made.stderr
    assert json.loads(made.stdout)["streams"]["landmarks"] > 100
    done = in_a_process("run", root / "log", "--out", root / "run", "--set", "frontend.particles=20", "--json")
    assert done.returncode == 0, done.stderr
    value = json.loads(done.stdout)
    assert {"metrics", "report", "out"} <= set(value)
    return root / "run"


def test_join_and_compare_print_the_documented_json(run_folder):
    keys = {
        "method",
        "objective",
        "objective_polished",
        "seconds",
        "peak_mb",
        "states",
        "landmarks",
        "nnz",
        "dof",
        "nees_unpolished",
        "nees",
        "nees_plain",
        "nees_dof",
        "ci_unpolished",
        "ci",
        "rmse_poses",
        "rmse_landmarks",
        "factors",
        "before",
        "after",
    }
    done = graphslam("join", run_folder, "--method", "eif-sequential", "--json", "--out", run_folder.parent / "joined")
    assert done.returncode == 0, done.stderr
    value = json.loads(done.stdout)
    (row,) = value["methods"]
    assert [line["code"] for line in value["verdict"]] == ["state", "chi2", "nees"]
    assert "converged to a least-squares optimum" in value["verdict"][0]["text"]
    assert f"; {row['dof']} dof]" in value["verdict"][1]["text"]
    assert row["nees_unpolished"] != row["nees"]
    assert set(row) == keys
    assert row["objective_polished"] <= row["objective"]
    joined = np.load(run_folder.parent / "joined" / "joined.npz")
    assert len(joined["landmarks"]) == len(joined["landmark_ids"]) == row["landmarks"]
    assert str(joined["state"]) == "vector"
    A = sp.csc_matrix(tuple(joined[f"information_{part}"] for part in ("data", "indices", "indptr")))
    assert A.shape == (row["states"], row["states"])
    assert (np.diag(np.linalg.inv(A.toarray())) > 0).all()
    nodes = read_tum(run_folder.parent / "joined" / "nodes.tum", dim=2)
    np.testing.assert_allclose(nodes.poses, joined["poses"], atol=1e-8)
    alone = graphslam("join", run_folder, "--method", "ekf", "--no-polish", "--out", run_folder.parent / "filtered")
    assert "not refined" in alone.stdout
    assert np.load(run_folder.parent / "filtered" / "joined.npz")["covariance"].shape == A.shape
    done = graphslam("compare", run_folder / "submaps", "--methods", "batch,eif-tree", "--no-memory", "--json")
    value = json.loads(done.stdout)
    rows = value["methods"]
    assert value["verdict"][0]["text"].endswith("the same for all 2 methods.")
    assert [r["method"] for r in rows] == ["batch", "eif-tree"]
    assert rows[0]["objective_polished"] == pytest.approx(rows[1]["objective_polished"], rel=1e-6)
    assert all(r["nees"] > 0 for r in rows)


def test_eval_scores_a_trajectory_against_the_truth(run_folder):
    done = graphslam("eval", run_folder / "trajectory.tum", run_folder / "truth.tum", "--align", "none", "--json")
    assert done.returncode == 0, done.stderr
    value = json.loads(done.stdout)
    assert 0 < value["ate"]["rmse"] < 2
    assert 0 < value["rpe"]["rmse"] < 2
    short = graphslam("eval", run_folder / "trajectory.tum", run_folder / "truth.tum", "--delta", "9000", "--json")
    assert short.returncode == 0
    assert json.loads(short.stdout)["rpe"] is None
    assert "--delta" in short.stderr


def test_human_output_is_a_table(run_folder):
    done = graphslam("compare", run_folder, "--methods", "batch", "--no-memory")
    assert done.returncode == 0
    assert done.stdout.splitlines()[0].split()[:2] == ["method", "objective"]


def test_data_list_and_info():
    listed = json.loads(graphslam("data", "list", "--json").stdout)["data"]
    assert {"victoria-park", "posegraphs"} <= {r["name"] for r in listed}
    info = json.loads(graphslam("data", "info", "victoria-park", "--json").stdout)
    assert "Guivant" in info["citation"]


def test_doctor_finds_this_machine_in_order():
    done = graphslam("doctor", "--json")
    assert done.returncode == 0, done.stderr
    states = {c["check"]: c["state"] for c in json.loads(done.stdout)["checks"]}
    assert states["gtsam"] == "ok"
    assert states["front ends"] == "ok"
    if find_spec("open3d"):  # the extra is installed: it must import, also where the system has no libusb
        assert states["extra open3d"] == "ok"
    elif os.environ.get("CI"):
        pytest.fail("CI installs the extra open3d, and Open3D is not there")


def test_wrong_usage_exits_2():
    assert graphslam("run").returncode == 2
    assert graphslam("fly").returncode == 2
    assert graphslam("solve").returncode == 2


def test_unknown_names_are_one_line(tmp_path, run_folder):
    refused("run", "victoria-parc", "--out", tmp_path / "r", saying="victoria-parc")
    refused("data", "info", "nothing", saying="unknown data set")
    refused("join", run_folder, "--method", "magic", saying="magic")
    refused("simulate", "atlantis", "--out", tmp_path / "w", saying="landmark-field")
    refused("run", run_folder.parent / "log", "--out", tmp_path / "r", "--frontend", "none", saying="front end")
    refused(
        "run",
        run_folder.parent / "log",
        "--out",
        tmp_path / "r",
        "--set",
        "frontend.partikles=3",
        saying="frontend.partikles",
    )
    refused("eval", run_folder / "trajectory.tum", run_folder / "truth.tum", "--align", "sideways", saying="--align")


def test_missing_data_says_how_to_get_it(tmp_path):
    env = {"GRAPHSLAM_DATA": str(tmp_path), "GRAPHSLAM_CACHE": str(tmp_path / "cache")}
    refused("run", "victoria-park", "--out", tmp_path / "r", saying="missing", env=env)


def test_truncated_logs_are_refused(tmp_path, data_dir):
    """Half a laser file, half a gzip stream, a log whose stream is cut."""
    root = tmp_path / "victoria_park_raw"
    root.mkdir()
    source = data_dir / "victoria_park_raw"
    for file in source.iterdir():
        if not file.name.startswith("LASER"):
            (root / file.name).write_bytes(file.read_bytes())
    laser = gzip.decompress((source / "LASER.txt.gz").read_bytes())
    (root / "LASER.txt").write_bytes(laser[: len(laser) // 50 + 3])
    refused("run", root, "--out", tmp_path / "r", saying="LASER.txt")
    (root / "LASER.txt").unlink()
    packed = (source / "LASER.txt.gz").read_bytes()
    (root / "LASER.txt.gz").write_bytes(packed[: len(packed) // 3])
    refused("run", root, "--out", tmp_path / "r", saying="LASER.txt.gz")
    log = tmp_path / "log"
    save_log(simulate("landmark-field", preset="quick", seed=0), log)
    stream = next(log.glob("*landmarks*.npz"))
    stream.write_bytes(stream.read_bytes()[:2000])
    refused("run", log, "--out", tmp_path / "r", saying=stream.name)


def test_time_going_backwards_and_nan_ranges_are_counted_drops(tmp_path, data_dir):
    """Isolated bad records of a raw log are dropped and counted in run.json, and the run goes on."""
    root = tmp_path / "victoria_park_raw"
    root.mkdir()
    source = data_dir / "victoria_park_raw"
    values = np.array(gzip.decompress((source / "LASER.txt.gz").read_bytes()).split(), dtype=float).reshape(-1, 362)[
        :400
    ]
    values[50, 0] = values[40, 0]  # a stamp that goes back
    values[60, 100] = np.nan  # one beam
    values[70, 1:] = np.nan  # a whole scan
    (root / "LASER.txt").write_text(" ".join(format(v, "g") for v in values.ravel()))
    for name in ("DRS", "GPS"):
        text = gzip.decompress((source / f"{name}.txt.gz").read_bytes()).decode().splitlines()
        (root / f"{name}.txt").write_text("\n".join(text[:3600] if name == "DRS" else text[:200]))
    done = graphslam("run", root, "--out", tmp_path / "r", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "r" / "run.json").read_text())
    assert report["records_read"]["laser"] == 400
    laser = {k: v for k, v in report["records_dropped"].items() if k.startswith("laser")}
    assert sum(v for k, v in laser.items() if not k.startswith("laser beams") and "beyond" not in k) == 2
    assert sum(v for k, v in laser.items() if k.startswith("laser beams")) == 1


def test_impossible_submap_stores_are_refused(tmp_path, run_folder):
    submaps = tmp_path / "s" / "submaps"
    submaps.mkdir(parents=True)
    for file in (run_folder / "submaps").iterdir():
        (submaps / file.name).write_bytes(file.read_bytes())
    with np.load(submaps / "000000.npz") as a:
        arrays = dict(a)
    broken = {**arrays, "covariance": np.zeros_like(arrays["covariance"])}
    np.savez(submaps / "000000.npz", **broken)
    refused("join", submaps, saying="not positive definite")
    np.savez(submaps / "000000.npz", **{**arrays, "format": "graphslam.submap/99"})
    refused("compare", submaps, "--no-memory", saying="graphslam.submap/99")
    np.savez(submaps / "000000.npz", **arrays)
    index = json.loads((submaps / "index.json").read_text())
    (submaps / "index.json").write_text(json.dumps({**index, "format": "other/1"}))
    refused("join", submaps, saying="other/1")


def test_tum_files_with_backward_time_are_refused(tmp_path):
    write_tum(tmp_path / "a.tum", Trajectory(np.arange(3.0), np.zeros((3, 3))))
    lines = (tmp_path / "a.tum").read_text().splitlines()
    (tmp_path / "b.tum").write_text("\n".join([lines[0], lines[2], lines[1]]))
    refused("eval", tmp_path / "a.tum", tmp_path / "b.tum", saying="b.tum")


def test_help_has_a_short_name_everywhere():
    for verb in ((), ("run",), ("data",), ("data", "list")):
        short, long = (graphslam(*verb, option) for option in ("-h", "--help"))
        assert (short.returncode, short.stdout) == (0, long.stdout)
        assert "-v, --verbose" in short.stdout
        assert "-q, --quiet" in short.stdout


@pytest.mark.parametrize(
    ("options", "level", "hidden"),
    [
        (("data", "list"), logging.WARNING, False),
        (("-q", "data", "list"), logging.ERROR, True),
        (("data", "-q", "list"), logging.ERROR, True),
        (("data", "list", "-q"), logging.ERROR, True),
        (("-v", "data", "list"), logging.INFO, False),
        (("data", "list", "--json", "-v"), logging.INFO, False),
    ],
)
def test_verbose_and_quiet_stand_before_and_after_the_verb(options, level, hidden):
    try:
        assert CliRunner().invoke(app, options).exit_code == 0
        assert (logging.getLogger().level, Bar.hidden) == (level, hidden)
    finally:
        log_to_stderr()


def test_a_quiet_run_writes_nothing_to_stderr(tmp_path):
    log = tmp_path / "log"
    graphslam("simulate", "landmark-field", "--preset", "quick", "--out", log)
    end = "--frontend", "rbpf-ekf", "--set", "frontend.particles=5", "--out", tmp_path / "run", "--resume"
    assert graphslam("run", log, *end).stderr.startswith("read: ")
    again = graphslam("run", log, *end, "-q")
    assert again.stderr == ""
    assert "resumed: all" in again.stdout
    assert "times_real_time" not in again.stdout
