"""The sample log: written without a download, read back with the values of the simulation, and mapped."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.worlds import SAMPLE_START, write_sample
from graphslam.core.geometry import se2_compose
from graphslam.io.tum import read_tum
from tests.command_line import graphslam

pytest.importorskip("rosbags")
pytest.importorskip("mcap")


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample")
    bag, truth = write_sample(folder / "sample.mcap")
    assert (bag.name, truth.name) == ("sample.mcap", "sample-truth.tum")
    return bag


def test_sample_has_the_values_of_the_simulation(sample: Path) -> None:
    assert sample.stat().st_size <= 3_000_000
    made, read = gs.simulate("mixed", preset="quick", seed=1), gs.load(sample)
    assert np.allclose(read["laser"].times, made["laser"].times + SAMPLE_START, atol=1e-6)
    far = made["laser"].ranges >= made["laser"].max_range
    assert np.array_equal(read["laser"].ranges >= read["laser"].max_range, far)
    known = ~far & np.isfinite(made["laser"].ranges)
    assert np.array_equal(made["laser"].ranges[known], read["laser"].ranges[known])
    assert np.allclose(read["laser"].bearings, made["laser"].bearings, atol=1e-6)
    assert np.array_equal(made["imu"].angular_rate, read["imu"].angular_rate)
    assert np.array_equal(made["imu"].specific_force, read["imu"].specific_force)
    assert np.allclose(read["imu"].T_base_imu, made["imu"].T_base_imu)
    gps = read["gps"]
    assert np.allclose(gps.sigma, made["gps"].sigma)
    assert np.allclose(gps.lever[:2], made["gps"].lever)
    apart = [np.linalg.norm(g.positions[:, None, :2] - g.positions[None, :, :2], axis=2) for g in (gps, made["gps"])]
    assert np.allclose(*apart, atol=1e-3)  # distances: the origin of the fixes is another
    ends = []
    for wheels in (made["wheels"], read["odometry"]):
        pose = np.zeros(3)
        for step in wheels.increments:
            pose = se2_compose(pose, step)
        ends.append(pose)
    assert np.allclose(*ends, atol=1e-6)
    assert np.hypot(*ends[0][:2]) > 1.0


def test_same_bytes_each_time(sample: Path, tmp_path: Path) -> None:
    bag, truth = write_sample(tmp_path / "sample.mcap")
    assert bag.read_bytes() == sample.read_bytes()
    assert truth.read_bytes() == sample.with_name(truth.name).read_bytes()


def test_sample_is_mapped_to_a_report_and_its_path_is_measured(sample: Path, tmp_path: Path) -> None:
    run = gs.run(sample, out=tmp_path / "run", progress=False)
    assert (tmp_path / "run" / "report.html").is_file()
    assert run.metric("gps_rmse") < 2.0  # σ of a fix is 1.2 m
    truth = sample.with_name("sample-truth.tum")
    done = graphslam("eval", tmp_path / "run", truth, "--json", "--max-diff", "0.06")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    # over 248 m; that of dead reckoning is 0.64 m
    assert found["ate"]["rmse"] < 0.1, found
    assert found["nees"]["inside_95"] > 0.9, found
    assert len(read_tum(truth)) > 2000


def test_command_writes_the_sample_and_says_where(tmp_path: Path) -> None:
    done = graphslam("data", "sample", "--out", tmp_path / "other.mcap", "--json")
    assert json.loads(done.stdout) == {"log": str(tmp_path / "other.mcap"), "truth": str(tmp_path / "other-truth.tum")}
    refused = graphslam("data", "sample", "--out", tmp_path)
    assert refused.returncode == 1
    assert "is a folder" in refused.stderr
