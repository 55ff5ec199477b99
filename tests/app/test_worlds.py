"""Worlds of triangles by name: simulated, written with their mesh, read again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.worlds import MESH_WORLDS, mesh_of, mesh_world, world_of, write_simulated
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.se3 import se3_transform
from graphslam.sim.raycast import RayCaster
from tests.reference.ply import read_mesh


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("garage", seed=2, scan_rate=1.0, imu_rate=50.0)


def test_returns_lie_on_the_mesh_in_the_frame_of_the_truth(log: SensorLog) -> None:
    caster = RayCaster(*mesh_of(log))
    scans = log["scanner"]
    origin, directions = scans.head_rays()
    poses = log.truth.trajectory.interpolate((scans.times[:, None] + scans.beam_times).ravel())
    met = (scans.ranges < scans.max_range).ravel()
    points = (origin + directions * scans.ranges[..., None]).reshape(-1, 3)
    off = caster.distances(se3_transform(poses, points)[met])
    assert met.mean() > 0.7
    assert np.sqrt(np.mean(off**2)) < 0.03  # σ 2.5 cm along the beam
    assert np.sqrt(np.mean(off**2)) > 0.01


def test_dead_reckoning_of_the_garage_is_about_nine_metres_off() -> None:
    ends = [
        gs.simulate("garage", layout=layout, seed=s, scan_rate=0.1).meta["drawn"]["end_error_of_yaw_bias"]
        for layout in ("A", "B")
        for s in range(3)
    ]
    assert np.mean(ends) == pytest.approx(9.1, abs=1.5)
    assert 7.0 < min(ends) < max(ends) < 11.2


def test_a_log_knows_its_world(log: SensorLog, tmp_path: Path) -> None:
    root = write_simulated(log, tmp_path / "log")
    back = gs.load(root)
    assert np.array_equal(world_of(back).vertices, mesh_world("garage", seed=2).vertices)
    vertices, triangles = read_mesh(root / "mesh.ply")
    assert vertices.tobytes() == mesh_of(log)[0].tobytes()
    assert np.array_equal(triangles, mesh_of(log)[1])
    assert back["scanner"].ranges.tobytes() == log["scanner"].ranges.tobytes()
    with pytest.raises(ConfigError, match="which world"):
        world_of(SensorLog(name="made", streams={}))


def test_seed_layout_and_world_seed(log: SensorLog) -> None:
    quick = {"scan_rate": 1.0, "imu_rate": 50.0}
    again = gs.simulate("garage", seed=2, layout="A", **quick)
    assert again["scanner"].ranges.tobytes() == log["scanner"].ranges.tobytes()
    same_place = gs.simulate("garage", seed=3, world_seed=2, **quick)
    assert np.array_equal(mesh_of(same_place)[0], mesh_of(log)[0])
    assert same_place["scanner"].ranges.tobytes() != log["scanner"].ranges.tobytes()
    other = gs.simulate("garage", seed=2, layout="B", **quick)
    assert not np.array_equal(other.truth.trajectory.positions[-1], log.truth.trajectory.positions[-1])


@pytest.mark.parametrize(
    ("arguments", "kind", "what"),
    [
        ({"world": "garag"}, UnknownNameError, "did you mean garage"),
        ({"world": "garage", "layout": "Z"}, UnknownNameError, "known: A, B, C, D, drawn-N"),
        ({"world": "building", "layout": "A"}, UnknownNameError, "drawn-N, usual"),
        ({"world": "landmark-field", "layout": "A"}, ConfigError, "no layouts"),
        ({"world": "garage", "seed": -1}, ConfigError, "seed = -1"),
        ({"world": "garage", "world_seed": 1.5}, ConfigError, "world_seed = 1.5"),
        ({"world": "garage", "preset": "fuller"}, UnknownNameError, "full"),
        ({"world": "garage", "bems": 3}, ConfigError, "unknown parameter 'bems'"),
    ],
)
def test_impossible_wishes_are_refused(arguments: dict, kind: type, what: str) -> None:
    with pytest.raises(kind, match=what):
        gs.simulate(**arguments)


def test_from_the_command_line(tmp_path: Path) -> None:
    out = tmp_path / "log"
    arguments = ["simulate", "garage", "--layout", "B", "--seed", "1", "--set", "scan_rate=0.5", "--out", str(out)]
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    log = gs.load(out)
    assert printed["streams"] == {k: len(s.times) for k, s in log.streams.items()}
    assert log.meta["made_with"] == {"name": "garage", "layout": "B", "seed": 1}
    assert printed["meta"]["noise"] == log.meta["noise"]
    assert (out / "mesh.ply").is_file()


@pytest.mark.parametrize("name", sorted(MESH_WORLDS))
def test_every_world_can_be_driven(name: str) -> None:
    log = gs.simulate(name, seed=1, scan_rate=0.2, imu_rate=10.0)
    wanted = 0.03 * log.meta["length"]
    drawn = log.meta["drawn"]
    turned = abs(drawn["gyro_bias"][2]) * log.meta["duration"]
    assert (0.2 if name == "court" else 0.4) < turned <= 1.2  # the court is driven in a minute
    if name == "building":  # a star ends at its middle: its drift is hidden at the end
        assert turned > 0.75
    else:
        assert 0.75 * wanted < drawn["end_error_of_yaw_bias"] < 1.25 * wanted
    assert np.mean(log["scanner"].ranges < 30.0) > 0.6
