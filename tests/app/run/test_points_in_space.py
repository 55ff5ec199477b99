"""Landmark submaps in space through `run`: odometry, points, GPS and an IMU in one graph, compared by every method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps
from graphslam.core.se3 import quat_rotate, se3_between, so3_log

GRAVITY = 9.81
NOISE = ImuNoise(
    gyro=2e-3, gyro_bias=2e-3, gyro_walk=1e-5, accelerometer=2e-2, accelerometer_bias=2e-2, accelerometer_walk=1e-4
)
CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


def flight(seed: int) -> SensorLog:
    """The point field with a level GPS frame, and the readings of a unit that turns and accelerates evenly in steps."""
    log = gs.simulate("point-field", seed=seed, seconds=60.0, points=150)
    assert log.truth is not None
    path, rng = log.truth.trajectory, np.random.default_rng(seed)
    t, x = path.times, path.poses
    dt = float(np.mean(np.diff(t)))
    turn = so3_log(se3_between(x[:-1], x[1:])[:, 3:]) / dt
    # the speed of a step is that of its middle: the mean force of step k brings the one before to the one after
    v = np.gradient(x[:, :3], dt, axis=0)
    force = quat_rotate(x[:-1, 3:] * CONJUGATE, np.diff(v, axis=0) / dt + np.array([0.0, 0.0, GRAVITY]))
    bias = np.concatenate([NOISE.gyro_bias * rng.standard_normal(3), NOISE.accelerometer_bias * rng.standard_normal(3)])
    rate = turn + bias[:3] + NOISE.gyro / np.sqrt(dt) * rng.standard_normal(turn.shape)
    force = force + bias[3:] + NOISE.accelerometer / np.sqrt(dt) * rng.standard_normal(force.shape)
    imu = Imu(times=t[1:], angular_rate=rate, specific_force=force, noise=NOISE)
    at = np.arange(5, len(t) - 1, 20)
    fixes = x[at, :3] + np.array([100.0, -50.0, 3.0]) + 0.5 * rng.standard_normal((len(at), 3))
    gps = Gps(times=t[at] + 1e-3, positions=fixes, sigma=np.full(len(at), 0.5), lever=np.zeros(3))
    return replace(log, streams={**log.streams, "imu": imu, "gps": gps})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> gs.Run:
    out = tmp_path_factory.mktemp("space") / "run"
    options = {"gps": {"use": "all", "baseline": 3.0}, "imu": {"use": "auto", "longest": 60.0}}
    return gs.run(flight(3), frontend="points", config=options, out=out, progress=False)


def test_every_sensor_is_in_the_graph(run: gs.Run) -> None:
    assert run.graph is not None
    groups = {r.group for r in run.graph.records.values()}
    assert {"submap", "gps", "imu", "imu-bias"} <= groups
    assert run.map.dim == 3
    assert run.map.landmarks.shape[1] == 3
    assert 0.3 < run.metric("nees_per_dof") < 2.0
    table = np.genfromtxt(Path(str(run.folder)) / "landmarks.csv", delimiter=",", names=True)
    assert {"x", "y", "z", "cov_zz"} <= set(table.dtype.names)


def test_every_method_has_all_of_it(run: gs.Run) -> None:
    table = gs.compare(run, memory=False)
    assert run.graph is not None
    np.testing.assert_allclose(table["objective_polished"], run.graph.objective().total, rtol=1e-9)
    assert len(set(table["factors"])) == 1
