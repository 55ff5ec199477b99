"""The front end ``lidar-odometry``: submaps of a log, the same when resumed; a whole run by the public verbs."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.report.report import make_report
from graphslam.app.worlds import mesh_world
from graphslam.core import se3
from graphslam.core.errors import ConfigError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.io.log_store import load_log, save_log
from graphslam.refine.config import RefineConfig
from graphslam.refine.scans import Scans
from graphslam.sim.ring_hall import ring_hall
from graphslam_frontends.lidar_odometry.front_end import LidarFrontEnd, LidarFrontEndConfig, LidarSubmapConfig
from graphslam_studies.sim.lidar import LidarConfig, simulate_lidar

FRONT = LidarFrontEnd(LidarFrontEndConfig(submap=LidarSubmapConfig(length=2.0, points=500)))


@pytest.fixture(scope="module")
def log():
    config = LidarConfig(rate=4.0, points=3000, lines=32)
    return simulate_lidar(mesh_world("building", seed=2), 2, config, most=14.0)


@pytest.fixture(scope="module")
def submaps(log):
    return list(FRONT.submaps(log, seed=SeedTree(0)))


def test_submaps_follow_each_other_and_the_truth(log, submaps):
    assert len(submaps) > 2
    truth, nees = log.truth.trajectory, []
    for a in submaps:
        begin, end = truth.interpolate(np.array(a.interval))
        off = se3.se3_log(se3.se3_between(a.exit_pose, se3.se3_between(begin, end)))
        nees.append(off @ np.linalg.solve(a.exit_covariance, off) / 6)
        assert np.linalg.norm(off[3:]) < 0.05
        assert a.uses == {"clouds"}
        assert a.grid is not None
        assert a.cloud is not None
        assert len(a.cloud) <= 500 * a.report["scans"] + 500
        assert a.report["scans_lost"] == 0
    for a, b in pairwise(submaps):
        assert a.interval[1] == b.interval[0]
    assert np.mean(nees) < 3.0
    # every scan is in one map
    assert sum(len(a.cloud.origins) for a in submaps) == len(log["clouds"])


def test_resumed_submaps_are_the_same(log, submaps):
    rest = list(FRONT.submaps(log, seed=SeedTree(0), after=submaps[1]))
    assert [a.key for a in rest] == [a.key for a in submaps[2:]]
    for a, b in zip(rest, submaps[2:]):
        assert a.exit_pose.tobytes() == b.exit_pose.tobytes()
        assert a.exit_covariance.tobytes() == b.exit_covariance.tobytes()
        assert a.cloud.points.tobytes() == b.cloud.points.tobytes()
        assert a.report == b.report


def test_steps_of_the_path_weigh_no_more_than_an_even_motion(log, submaps):
    steps = FRONT.steps(log)
    assert len(steps) == len(log["clouds"])
    fresh = LidarFrontEnd(FRONT.config).steps(log)
    assert fresh.odometry.increments.tobytes() == steps.odometry.increments.tobytes()
    sigma = np.sqrt(np.diagonal(steps.odometry.covariances[1:], axis1=1, axis2=2))
    # the path's own are a hundred times smaller
    assert sigma.min() > 10.0 * np.sqrt(np.diag(submaps[0].exit_covariance)).max()


def test_a_log_without_clouds_is_refused():
    with pytest.raises(MissingDataError, match="no stream of point clouds"):
        list(FRONT.submaps(SensorLog(name="bare", streams={}), seed=SeedTree(0)))
    for wrong in ({"length": 0.0}, {"scans": 0}, {"voxel_size": -1.0}):
        with pytest.raises(ConfigError):
            LidarSubmapConfig(**wrong)


def test_times_of_points_are_stored_with_a_log(log, tmp_path):
    save_log(log, tmp_path / "log")
    back = load_log(tmp_path / "log")["clouds"]
    np.testing.assert_array_equal(back.ages(5), log["clouds"].ages(5))
    assert log["clouds"].ages(5).max() > 0.09


def test_scans_that_the_odometry_matched_are_refined_only_if_forced(log, tmp_path):
    """The odometry has matched them already; verdict and report say that the path of the graph is the result."""
    options = {"frontend": {"submap": {"length": 2.0, "points": 500}}}
    run = gs.run(log, frontend="lidar-odometry", out=tmp_path / "run", config=options, progress=False)
    assert run.refined is None
    line = next(f for f in run.verdict if f.code == "refine-nothing-new")
    assert line.level == ""
    assert "Scan agreement: odometry" in line.text
    assert "has matched the same scans" in make_report(run.folder).html
    assert not (run.folder / "trajectory_graph.tum").exists()
    assert (run.folder / "map.ply").exists()
    assert Scans.load(run.folder / "scans.npz").matched
    options |= {"refine": {"use": "always"}, "map": {"fuse": False}}
    forced = gs.run(log, frontend="lidar-odometry", config=options, progress=False)
    assert forced.refined is not None
    assert forced.metric("path_rmse_aligned") < 0.03
    assert forced.metric("path_rmse_aligned_graph") == pytest.approx(run.metric("path_rmse_aligned"))
    with pytest.raises(ConfigError, match="known: True, False, always"):
        RefineConfig(use="sometimes")


def test_scans_of_two_traversals_agree_more_after_a_refinement():
    drive = simulate_lidar(ring_hall(seed=9), 2, LidarConfig(rate=2.0, points=3000, lines=32))
    options = {"frontend": {"submap": {"points": 500}}, "map": {"fuse": False}, "refine": {"use": "always"}}
    run = gs.run(drive, frontend="lidar-odometry", config=options, progress=False)
    assert run.refined is not None
    assert run.metric("refine_pairs_passes") > 0.2 * run.metric("refine_pairs")
    assert run.metric("refine_agreement") > run.metric("refine_agreement_graph") + 0.004


def test_lost_scans_are_a_line_of_the_verdict(log):
    clouds = log["clouds"]
    rows = [clouds.cloud(k)[: 0 if 20 <= k < 26 else None] for k in range(len(clouds))]
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
    spoilt = type(clouds).from_arrays(clouds.times, np.concatenate(rows), offsets)
    submaps = list(FRONT.submaps(replace(log, streams={"clouds": spoilt}), seed=SeedTree(0)))
    reported = [f["code"] for a in submaps for f in a.report.get("findings", [])]
    assert "scans-lost" in reported
    assert sum(a.report["scan_states"].get("empty", 0) for a in submaps) == 6
    wide = max(np.sqrt(a.trajectory.covariances[:, 3, 3].max()) for a in submaps)
    assert wide > 10.0 * min(np.sqrt(a.exit_covariance[3, 3]) for a in submaps)


def codes(log, rows):
    """Findings of scans without times of points."""
    clouds = log["clouds"]
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
    plain = type(clouds).from_arrays(clouds.times[: len(rows)], np.concatenate(rows), offsets)
    submaps = FRONT.submaps(replace(log, streams={"clouds": plain}), seed=SeedTree(0))
    return [f["code"] for s in submaps for f in s.report.get("findings", ())]


def test_points_without_times_are_reported_once_where_the_motion_bends_scans(log, submaps):
    """The same scans without their times, and with; and of a lidar that stands there is nothing to tell."""
    clouds = log["clouds"]
    assert codes(log, [clouds.cloud(k) for k in range(len(clouds))]).count("points-without-times") == 1
    assert "points-without-times" not in [f["code"] for s in submaps for f in s.report.get("findings", ())]
    assert "points-without-times" not in codes(log, [clouds.cloud(0)] * 20)
