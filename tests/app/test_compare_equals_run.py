"""`compare` of a run solves the graph of the run: the same factors and objective, in memory and from the folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run.run import Run
from graphslam.core.errors import MissingDataError
from graphslam.core.poses import compose_increments
from tests.io import small_sources
from tests.io.bag_worlds import Messages, write_ros2


def same(run: Run, folder: Path) -> None:
    """Both sources, every method: the objective of the run, and every factor of its graph."""
    assert run.graph is not None
    best = run.graph.objective().total
    groups: dict[str, int] = {}
    for r in run.graph.records.values():
        groups[r.group] = groups.get(r.group, 0) + 1
    text = ", ".join(f"{k} {v}" for k, v in sorted(groups.items()))
    for source in (run, folder):
        table = gs.compare(source, ["isam2", "eif-tree"], memory=False)
        np.testing.assert_allclose(table["objective_polished"], best, rtol=1e-9, atol=1e-9)
        assert set(table["factors"]) == {text}


MIXED: dict[str, Any] = {"imu": {"use": "auto"}, "gps": {"use": "all"}}


@pytest.mark.parametrize(
    ("world", "preset", "frontend", "config", "groups"),
    [
        ("landmark-field", "quick", "rbpf-ekf", {}, {"submap"}),
        ("garage", "light", "segslam", {"refine": {"use": False}}, {"dense-submap", "levelled"}),
        ("mixed", "quick", ["segslam", "rbpf-ekf"], MIXED, {"submap", "dense-submap", "gps", "imu", "imu-bias"}),
        ("mixed", "quick", ["segslam", "rbpf-ekf"], {"gps": {"use": "none"}}, {"submap", "dense-submap"}),
    ],
)
def test_on_a_simulated_run(
    world: str, preset: str, frontend: Any, config: dict[str, Any], groups: set[str], tmp_path: Path
) -> None:
    log = gs.simulate(world, preset=preset, seed=2)
    run = gs.run(log, frontend=frontend, config=config, out=tmp_path / "run", progress=False)
    assert run.graph is not None
    assert groups <= {r.group for r in run.graph.records.values()}
    same(run, tmp_path / "run")


def test_on_a_plain_table_of_landmarks_that_was_calibrated(tmp_path: Path) -> None:
    """A log of CSV files; calibration adds constant errors of wheels and sensor to the graph."""
    log = gs.simulate("mixed", preset="quick", seed=4)
    wheels, seen = log["wheels"], log["landmarks"]
    path = compose_increments(wheels.increments[1:])
    rows = np.repeat(np.arange(len(seen.times)), np.diff(seen.offsets))
    tables = {
        "odometry": ("t,x,y,theta", np.column_stack([wheels.times, path])),
        "observations": (
            "t,range,bearing,id",
            np.column_stack([seen.times[rows], seen.ranges, seen.bearings, seen.ids]),
        ),
    }
    for name, (header, table) in tables.items():
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header=header, comments="", fmt="%.9g")
    run = gs.run(tmp_path, out=tmp_path / "run", progress=False)
    assert run.graph is not None
    assert "biases" in {r.group for r in run.graph.records.values()}
    same(run, tmp_path / "run")


def test_on_a_ros2_bag(tmp_path: Path) -> None:
    """Clouds and odometry of a bag; refinement is left out, for it does not change the graph."""
    m, messages = Messages(), []
    for t, pose, xyz in zip(small_sources.stamps(), small_sources.poses(), small_sources.clouds(spacing=0.5)):
        messages.append(("/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, xyz, frame="lidar")))
        messages.append(("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, pose, child="base")))
    place = m.transforms(0.0, [("base", "lidar", np.array([0.1, 0, 0.5, 0, 0, 0, 1.0]))])
    messages.append(("/tf_static", "tf2_msgs/msg/TFMessage", small_sources.T0, place))
    bag = write_ros2(tmp_path / "bag", messages)
    run = gs.run(bag, config={"refine": {"use": False}}, out=tmp_path / "run", progress=False)
    same(run, tmp_path / "run")


def test_on_recorded_data(data_dir: Path, tmp_path: Path) -> None:
    run = gs.run("mrclam-dataset7/robot1", out=tmp_path / "run", progress=False)
    same(run, tmp_path / "run")


def test_a_run_folder_without_its_graph_is_refused(tmp_path: Path) -> None:
    """Its submaps alone would be compared without GPS, IMU and loop closures."""
    gs.run(gs.simulate("landmark-field", preset="quick", seed=2), out=tmp_path / "run", progress=False)
    for file in (tmp_path / "run").rglob("graph.npz"):
        file.unlink()
    with pytest.raises(MissingDataError, match="graph of the run is not in its folder"):
        gs.compare(tmp_path / "run", memory=False)
