"""Records fed one by one give the run over the stored log, to the last byte; what is known on the way is there."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run.outputs import SAME_BYTES
from graphslam.app.run.slam import Slam
from graphslam.app.worlds import mesh_world
from graphslam.backend.back_end import Observer
from graphslam.core.errors import ConfigError, DataError, MissingDataError, UnknownNameError
from graphslam.core.geometry import se2_between
from graphslam.core.log import SensorLog
from graphslam.core.plan_view import plan_path
from graphslam.core.point_clouds import PointClouds
from graphslam.core.poses import remove_roll_pitch
from graphslam.core.records import Odometry
from graphslam.core.se3 import se3_between
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from graphslam_frontends.base import PoseEstimate
from graphslam_frontends.lidar_odometry.front_end import FIRST
from graphslam_studies.sim.lidar import LidarConfig, drawn_imu, simulate_lidar
from tests.frontends.landmarks.test_preparing import in_portions

QUIET = {"calibrate": {"use": "none"}}
LANDMARKS: dict[str, Any] = {**QUIET, "gps": {"use": "every-second", "every": 2.0}}
CLOUDS: dict[str, Any] = {"frontend": {"submap": {"length": 1.5, "points": 300, "reach": 15.0}}}
BEAMS: dict[str, Any] = {
    **QUIET,
    "frontend": {
        "filter": {"particles": 4},
        "steps": {"max_range": 8.0},
        "segslam": {"segmentation": {"min_seconds": 3.0, "min_length": 2.0, "max_length": 4.0}},
    },
}
LOOKS = BEAMS | {"backend": {"loops": True, "look_every": 1}}


def landmarks() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)


def clouds() -> SensorLog:
    config = LidarConfig(rate=4.0, points=2000, lines=32)
    return simulate_lidar(mesh_world("building", seed=2), 2, config, most=4.5)


def carried() -> SensorLog:
    """With an IMU beside the lidar."""
    noise = drawn_imu(2)
    config = LidarConfig(rate=4.0, points=2000, lines=32, sway=0.06, bob=0.03, imu=noise)
    return simulate_lidar(mesh_world("building", seed=2), 2, config, most=5.0)


def wheeled() -> SensorLog:
    """With odometry of wheels at 25 Hz beside the lidar, of which some scans see nothing."""
    log = clouds()
    assert log.truth is not None
    truth = plan_path(log.truth.trajectory)
    times = np.arange(truth.times[0], truth.times[-1], 0.04)
    poses = truth.interpolate(times)
    noise = np.random.default_rng(5).normal(size=(len(times), 3)) * [1e-3, 1e-3, 1e-4]
    steps = np.concatenate([np.zeros((1, 3)), se2_between(poses[:-1], poses[1:])]) + noise
    wheels = Odometry(
        times=times, increments=steps, covariances=np.tile(np.diag([1e-6, 1e-6, 1e-8]), (len(times), 1, 1))
    )
    seen = log["clouds"]
    assert isinstance(seen, PointClouds)
    points = [seen.cloud(k) * (0.01 if k in (9, 10, 11) else 1.0) for k in range(len(seen))]
    before = [seen.ages(k) for k in range(len(seen))]
    blind = PointClouds.from_arrays(
        seen.times,
        np.concatenate(points),
        np.cumsum([0, *(len(p) for p in points)]),
        None if before[0] is None else np.concatenate([a for a in before if a is not None]),
        origin=seen.origin,
        T_base_sensor=seen.T_base_sensor,
    )
    return replace(log, streams={"clouds": blind, "wheels": wheels})


def beams() -> SensorLog:
    whole = simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.02, max_range=8.0))
    begin, _ = whole.interval
    return whole.slice(begin, begin + 24.0)


def same_files(folder: Path) -> dict[str, bytes]:
    files = {str(p.relative_to(folder)): p for p in folder.rglob("*") if p.is_file()}
    return {n: p.read_bytes() for n, p in files.items() if any(fnmatch(n, like) for like in SAME_BYTES)}


def fed(log: SensorLog, slam: Slam, seed: int = 0) -> None:
    for name, part in in_portions(log, seed):
        slam.add(part, name)


@pytest.mark.parametrize(
    ("frontend", "log", "config"),
    [
        ("ekf", landmarks, LANDMARKS),
        ("rbpf-ekf", landmarks, {**LANDMARKS, "frontend": {"particles": 10}}),
        ("lidar-odometry", clouds, CLOUDS),
        ("lidar-odometry", carried, CLOUDS),
        ("lidar-odometry", wheeled, CLOUDS),
        ("segslam", beams, LOOKS),
    ],
    ids=["ekf", "rbpf-ekf", "lidar-odometry", "lidar-odometry-imu", "lidar-odometry-wheels", "segslam"],
)
def test_a_fed_run_is_the_run_over_the_stored_log(
    frontend: str, log: Any, config: dict[str, Any], tmp_path: Path
) -> None:
    log = log()
    with gs.Slam(frontend, name=log.name, seed=4, out=tmp_path / "fed", config=config) as slam:
        fed(log, slam)
        before = len(slam.submaps)
        assert (before > 0) == (not slam.waits_for)
        run = slam.finish()
    stored = gs.run(
        slam.log,
        frontend=frontend,
        seed=4,
        out=tmp_path / "stored",
        config={"preset": "none", **config},
        progress=False,
    )
    a, b = same_files(tmp_path / "fed"), same_files(tmp_path / "stored")
    assert len([n for n in a if n.startswith("submaps/")]) > len(run.submaps) >= max(before, 1)
    assert {"run.json", "config.toml", "graph.g2o", "trajectory.tum"} <= set(a)
    assert set(a) == set(b)
    assert [n for n in a if a[n] != b[n]] == []
    bridged = sum(s.report.get("scans_bridged", 0) for s in run.submaps)
    assert (bridged > 0) == (frontend == "lidar-odometry" and "wheels" in log.streams)
    if frontend not in ("ekf", "lidar-odometry"):
        return
    # the records themselves are those that were given
    gs.run(log, frontend=frontend, seed=4, out=tmp_path / "own", config={"preset": "none", **config}, progress=False)
    own = same_files(tmp_path / "own")
    unnamed = [n for n in a if fnmatch(n, "submaps/*.npz") or n in ("graph.g2o", "trajectory.tum", "landmarks.csv")]
    assert [n for n in unnamed if a[n] != own[n]] == []
    assert stored.metric("submaps") == run.metric("submaps")


def test_what_was_fed_is_on_the_map_before_the_end_and_looking_at_it_changes_nothing() -> None:
    log, ends = landmarks(), []
    looked, blind = (gs.Slam("ekf", config=LANDMARKS) for _ in range(2))
    with pytest.raises(MissingDataError, match="no submap is finished"):
        _ = looked.map
    for name, part in in_portions(log, 1):
        looked.add(part, name)
        blind.add(part, name)
        if len(looked.submaps) > len(ends):
            ends.append(looked.path.times[-1])
            assert ends[-1] == looked.submaps[-1].interval[1] <= part.times[-1]
            assert len(looked.map.landmarks)
    assert len(ends) > 1
    truth = log.truth
    assert truth is not None
    here = truth.trajectory.interpolate(np.array([ends[-1]]))[0]
    assert np.hypot(*(looked.path.poses[-1] - here)[:2]) < 0.5
    a, b = looked.finish(), blind.finish()
    assert a.map.trajectory.poses.tobytes() == b.map.trajectory.poses.tobytes()
    assert looked.map is a.map
    assert looked.finish() is a


class Poses(Observer):
    """Keeps the pose after every scan."""

    def __init__(self) -> None:
        self.seen: list[PoseEstimate] = []

    def pose_estimated(self, estimate: PoseEstimate) -> None:
        self.seen.append(estimate)


def test_segslam_has_a_pose_after_every_scan_with_its_covariance_and_lag() -> None:
    log, poses, asked, searching = beams(), Poses(), [], 0
    assert log.truth is not None
    slam = gs.Slam("segslam", config=LOOKS, observers=[poses])
    assert slam._slam is not None
    for time, name, k in log.events():
        slam.add(log[name].take(slice(k, k + 1)), name)
        searching += slam._slam._adding is not None
        if name == "scanner" and poses.seen:
            asked.append(time)
    assert searching > 20  # a search for loops is spread over many records
    assert slam.estimate is not None
    assert slam.estimate.time == poses.seen[-1].time
    assert len(poses.seen) == len(asked) > 100
    assert len(slam.submaps) > 0
    assert {e.anchor for e in poses.seen} >= {0, 1}
    start = log.truth.trajectory.interpolate(np.array([beginning := poses.seen[0].filtered]))[0]
    assert beginning < 2.0
    first = remove_roll_pitch(start)
    off = []
    for time, e in zip(asked, poses.seen, strict=True):
        assert time - 0.1 <= e.time <= time + 0.1  # at the scan, not at the last filtered step
        assert 3.9 <= e.lag <= 8.0
        assert np.linalg.eigvalsh(e.covariance).min() > 0
        there = log.truth.trajectory.interpolate(np.array([e.time]))[0]
        off.append(np.linalg.norm(se3_between(se3_between(first, there), e.pose)[:3]))
    assert np.median(off) < 0.3
    assert max(off) < 0.8  # 24 m of path
    assert gs.Slam("ekf").estimate is None


def test_beams_that_were_used_leave_the_memory() -> None:
    log = clouds()
    bytes_of_all = sum(c.nbytes for c in log["clouds"])
    most, slam = 0, gs.Slam("lidar-odometry", config=CLOUDS)
    tracemalloc.start()
    for name, part in in_portions(log, 0, most=1):
        slam.add(part, name)
        held = slam._feed.held_records
        most = max(most, held["clouds"])
    kept = sum(t.size for t in tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/io/*")]).traces)
    tracemalloc.stop()
    assert most <= FIRST
    assert kept < 0.1 * bytes_of_all
    run = slam.finish()  # and they are all there where the end asks for them
    assert all(np.array_equal(a, b) for a, b in zip(run.log["clouds"], log["clouds"], strict=True))


def test_a_record_that_cannot_be_used_is_refused_and_others_follow() -> None:
    log, slam = landmarks(), gs.Slam("ekf", config=QUIET)
    first, second = (log["controls"].take(slice(k, k + 1)) for k in (0, 1))
    slam.add(second, "controls")
    slam.add(first, "controls")  # late, and once more twice: dropped and counted
    slam.add(log["controls"].take(slice(0, 2)), "controls")
    assert slam.dropped == {"controls: records that came late or twice": 3}
    with pytest.raises(DataError, match="another kind"):
        slam.add(log["landmarks"].take(slice(3, 4)), "controls")
    other = replace(log["controls"].take(slice(2, 3)), geometry=gs_geometry(3.3))
    with pytest.raises(DataError, match="wheelbase"):
        slam.add(other, "controls")
    slam.add(log["controls"].take(slice(2, None)), "controls")
    slam.add(log["landmarks"])
    run = slam.finish()
    assert set(run.log.streams) == {"controls", "landmark-observations"}
    assert len(run.log["controls"].times) == len(log["controls"].times) - 1
    assert run.log.dropped["controls: records that came late or twice"] == 3
    with pytest.raises(DataError, match="after the end"):
        slam.add(second, "controls")


def gs_geometry(wheelbase: float) -> Any:
    from graphslam.core.records import AckermannGeometry

    return AckermannGeometry(wheelbase=wheelbase)


def test_a_front_end_that_fails_closes_it(tmp_path: Path) -> None:
    log = landmarks()
    nameless = replace(log["landmarks"], ids=None)
    slam = gs.Slam("ekf", out=tmp_path / "run", config={**QUIET, "frontend": {"association": "known"}})
    slam.add(nameless, "landmarks")
    with pytest.raises(MissingDataError, match="identities"):
        slam.add(log["controls"], "controls")
    with pytest.raises(DataError, match="closed"):
        slam.finish()
    gs.Slam("ekf", out=tmp_path / "run", config=QUIET).close()  # the lock was given back


def test_what_needs_the_whole_log_is_named() -> None:
    assert "ekf-slam" in gs.Slam("ekf-slam").waits_for
    assert "imu" in gs.Slam("lidar-odometry", config={"imu": {"use": "auto"}}).waits_for
    assert "calibration" in gs.Slam("ekf", config={"calibrate": {"use": "always"}}).waits_for
    assert gs.Slam("ekf").waits_for == ""
    with pytest.raises(UnknownNameError):
        gs.Slam("kis-icp")
    with pytest.raises(UnknownNameError):
        gs.Slam("ekf", config={"preset": "nowhere"})
    with pytest.raises(ConfigError):
        gs.Slam("ekf", config={"frontend": {"particle": 3}})
