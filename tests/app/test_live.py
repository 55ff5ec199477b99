"""A live view shows what the run does: read back from its recording, submap by submap."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.live import LiveView, pose_in_space, shown_points
from graphslam.backend.back_end import Observer
from graphslam.core import se3
from graphslam.core.errors import MissingDataError
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.log import SensorLog
from graphslam.io.log_store import save_log
from graphslam.loops.ledger import LoopDecision

PLANE: dict[str, Any] = {"calibrate": {"use": "none"}}
SUBMAPS = {"length": 1.5, "points": 300, "reach": 15.0}
SPACE: dict[str, Any] = {"frontend": {"submap": SUBMAPS}, "refine": {"use": False}}


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=3)


def read_back(file: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows of a recording by entity, in the order in which they were sent, in Rerun's own words."""
    reader = pytest.importorskip("rerun.chunk").RrdReader
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in reader(file).stream():
        rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return {name: sorted(found, key=lambda r: r["rerun.controls.RowId"]) for name, found in rows.items()}


class Seen(Observer):
    """What a view should have shown."""

    def __init__(self) -> None:
        self.paths: list[Array] = []
        self.landmarks: list[Array] = []
        self.bases: list[Array] = []
        self.decisions: list[LoopDecision] = []

    def submap_added(self, submap: Any, graph: Any) -> None:
        self.paths.append(graph.values.poses.copy())
        self.landmarks.append(graph.values.landmarks.copy())
        self.bases.append(graph.values.poses[[s.node for s in graph.submaps]])

    def loop_decided(self, decision: LoopDecision, graph: Any) -> None:
        self.decisions.append(decision)

    def solved(self, solution: Any) -> None:
        self.paths.append(solution.poses)
        self.landmarks.append(solution.landmarks)


def test_a_recording_replays_the_run(log: SensorLog, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    seen, file = Seen(), tmp_path / "run.rrd"
    run = gs.run(log, frontend="ekf", config={"preset": "none", **PLANE}, progress=[LiveView(log.name, file), seen])
    rows = read_back(file)
    paths = rows["/map/path"]
    assert [r["submap"] for r in paths] == [*range(1, len(run.submaps) + 1), len(run.submaps)]
    seconds = [r["seconds"].total_seconds() for r in paths[:-1]]
    np.testing.assert_allclose(seconds, [s.interval[1] for s in run.submaps], atol=1e-6)
    for row, poses in zip(paths, seen.paths, strict=True):
        shown = np.array(row["LineStrips3D:strips"][0])
        np.testing.assert_allclose(shown[:, :2], poses[:, :2], atol=1e-4)
        assert not shown[:, 2].any()
    for row, places in zip(rows["/map/landmarks"], seen.landmarks, strict=True):
        np.testing.assert_allclose(np.array(row["Points3D:positions"])[:, :2], places, atol=1e-4)
    assert rows["/said"][-1]["TextLog:text"] == ["solved"]
    assert len(rows["/map/submap-0"]) == len(run.submaps) + 1


def test_clouds_and_loops_are_where_the_graph_has_them(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from tests.app.run.test_slam import clouds

    seen, file = Seen(), tmp_path / "run.rrd"
    options = {**SPACE, "backend": {"loops": True, "look_every": 2}}
    run = gs.run(
        clouds(),
        frontend="lidar-odometry",
        config=options,
        progress=[LiveView("building", file), seen],
    )
    rows = read_back(file)
    for s in run.submaps:
        (sent,) = rows[f"/map/submap-{s.key}/points"]
        points = np.array(sent["Points3D:positions"])
        np.testing.assert_allclose(points, shown_points(s), atol=1e-4)
        assert 0 < len(points) <= 4000
        first = rows[f"/map/submap-{s.key}"][0]
        pose = np.concatenate([first["Transform3D:translation"][0], first["Transform3D:quaternion"][0]])
        np.testing.assert_allclose(pose, seen.bases[s.key][s.key], atol=1e-5)
    assert {int(n.rpartition("/")[2]) for n in rows if n.startswith("/map/loops/")} == {d.loop for d in seen.decisions}


def test_a_pose_in_the_plane_is_the_same_in_space() -> None:
    pose, points = np.array([1.0, -2.0, 2.5]), np.random.default_rng(0).normal(size=(5, 2))
    x, q = pose_in_space(pose)
    there = se3.se3_transform(np.concatenate([x, q]), np.column_stack([points, np.zeros(5)]))
    np.testing.assert_allclose(there[:, :2], se2_transform(pose, points), atol=1e-12)


def test_without_rerun_it_says_what_to_install(log: SensorLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDataError, match=r"graphslam-submaps\[live\]"):
        LiveView("log", tmp_path / "run.rrd")
    save_log(log, tmp_path / "log")
    done = CliRunner().invoke(app, ["run", str(tmp_path / "log"), "--live", "--out", str(tmp_path / "run")])
    assert done.exit_code == 1
    assert not (tmp_path / "run").exists()


def test_the_command_records(log: SensorLog, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    save_log(log, tmp_path / "log")
    where = ["--out", str(tmp_path / "run"), "--record", str(tmp_path / "run.rrd")]
    done = CliRunner().invoke(
        app, ["run", str(tmp_path / "log"), "--frontend", "ekf", *where, "--set", "calibrate.use=none"]
    )
    assert done.exit_code == 0, done.output
    assert len(read_back(tmp_path / "run.rrd")["/map/path"]) == len(gs.open_run(tmp_path / "run").submaps) + 1
