"""The front end ``kiss-icp``: poses of the package, covariances of ours."""

from __future__ import annotations

import builtins
import sys
from dataclasses import replace

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.worlds import mesh_world
from graphslam.core import se3
from graphslam.core.errors import ConfigError, MissingExtraError
from graphslam.core.log import SensorLog
from graphslam_frontends.kiss_icp.front_end import KissIcpConfig, KissIcpOdometry
from graphslam_frontends.lidar_odometry.window_covariance import WindowCovariance
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_studies.sim.lidar import drawn_lidar, simulate_lidar

pytest.importorskip("kiss_icp")


def drive(seed: int, world: str, seconds: float) -> SensorLog:
    """A lidar of 16,000 points a scan at 10 Hz: with few points KISS-ICP slips."""
    config = replace(drawn_lidar(seed), points=16000, rate=10.0, sweep=0.05)
    return simulate_lidar(mesh_world(world, seed=seed), seed, config, most=seconds)


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return drive(8, "garage", 6.0)


def test_a_run_maps_with_the_path_of_the_package(log: SensorLog) -> None:
    options = {"refine": {"use": False}, "map": {"fuse": False}}
    run = gs.run(log, frontend="kiss-icp", config=options, seed=0)
    assert run.submaps
    for m in run.submaps:
        assert m.uses == {"clouds"}
        assert not m.assisting_streams
        assert m.grid is not None
        assert m.cloud is not None
        assert np.linalg.eigvalsh(m.exit_covariance).min() > 0.0
    assert run.metric("path_rmse_aligned") < 0.1
    again = gs.run(log, frontend="kiss-icp", config=options, seed=1)
    for a, b in zip(run.submaps, again.submaps, strict=True):
        assert a.exit_pose.tobytes() == b.exit_pose.tobytes()
        assert a.exit_covariance.tobytes() == b.exit_covariance.tobytes()


def test_poses_are_those_of_the_package(log: SensorLog) -> None:
    clouds, config = log["clouds"], KissIcpConfig(deskew=False)
    ours, package = KissIcpOdometry(config), config.registration()
    for k in range(20):
        ours.step(clouds.cloud(k), float(clouds.times[k]), clouds.ages(k))
        package.register_frame(clouds.cloud(k), np.zeros(0))
        T = package.last_pose
        assert np.allclose(ours.pose[:3], T[:3, 3], atol=1e-12)
        assert np.allclose(se3.quat_to_matrix(ours.pose[3:]), T[:3, :3], atol=1e-9)


def test_errors_over_ten_scans_are_as_large_as_the_covariance_says() -> None:
    nees = []
    for seed, world in ((2, "building"), (5, "building"), (8, "garage"), (9, "building")):
        log = drive(seed, world, 5.0)
        clouds = log["clouds"]
        truth = log.truth.trajectory.interpolate(clouds.times)
        odometry, begin, start = KissIcpOdometry(KissIcpConfig()), 0, None
        for k in range(len(clouds)):
            odometry.step(clouds.cloud(k), float(clouds.times[k]), clouds.ages(k))
            if k == 0 or k - begin == 9:
                if k:
                    pair = (start, odometry.pose)
                    C = relative_covariance(pair, pair, odometry.errors.joint)
                    moved = se3.se3_between(truth[begin], truth[k])
                    e = se3.se3_log(se3.se3_between(se3.se3_between(*pair), moved))
                    nees.append(float(e @ np.linalg.solve(C, e)) / 6.0)
                odometry.errors.begin()
                begin, start = k, odometry.pose
    # correlated, from four lidars: bounds that half of the covariance, and twice of it, would miss
    assert len(nees) == 20
    assert 0.5 < np.mean(nees) < 1.4
    assert 0.2 < np.median(nees) < 0.65


def test_an_offset_is_followed_as_one_error() -> None:
    rng = np.random.default_rng(4)
    motion = se3.se3_exp(np.array([0.0, 0.02, 0.1, 0.3, 0.0, 0.1]))
    H = rng.standard_normal((3, 6, 6))
    H = H @ H.swapaxes(1, 2) * 1e3

    def run(scale: float, weight: float) -> np.ndarray:
        errors, pose = WindowCovariance(), np.array([0.0, 0, 0, 0, 0, 0, 1])
        errors.lay(0)
        errors.begin()
        for k in range(3):
            pose = se3.se3_compose(pose, motion)
            information = weight * H[: len(errors.ends)]
            off = scale * np.array([1e-3, -2e-3, 1e-3, 0.01, 0.02, -0.01]) * (k + 1)
            errors.step(pose, motion, 0.01 * np.eye(6), information, weight * np.eye(6), np.zeros((6, 6)), off)
            errors.lay(k + 1, alone=True)
        return errors.joint

    for weight in (1e-9, 1.0):
        none, once, twice = (run(s, weight) for s in (0.0, 1.0, 2.0))
        assert np.linalg.matrix_rank(once - none, tol=1e-12) == 1
        assert np.allclose(twice - none, 4.0 * (once - none), atol=1e-14)
    # with no match at all the offsets add up, each seen from the last pose
    back = se3.se3_adjoint(se3.se3_inverse(motion))
    step = np.array([1e-3, -2e-3, 1e-3, 0.01, 0.02, -0.01])
    total = back @ (back @ step + 2 * step) + 3 * step
    difference = run(1.0, 1e-12) - run(0.0, 1e-12)
    assert np.allclose(difference[6:, 6:], np.outer(total, total), atol=1e-9)


def test_the_extra_is_named_where_the_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: object, **kwargs: object) -> object:
        if name.partition(".")[0] == "kiss_icp":
            raise ImportError("no module")
        return real(name, *args, **kwargs)  # type: ignore[arg-type]

    for name in [m for m in sys.modules if m.partition(".")[0] == "kiss_icp"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"graphslam-submaps\[kiss-icp\]"):
        KissIcpConfig().registration()


def test_bad_parameters_are_refused() -> None:
    with pytest.raises(ConfigError, match="min_range"):
        KissIcpConfig(min_range=5.0, max_range=4.0)
    with pytest.raises(ConfigError, match="voxel_size"):
        KissIcpConfig(voxel_size=-1.0)
