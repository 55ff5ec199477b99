"""Which front end and which settings a log gets when nobody names any, by what it holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.run.choice import choose_front_end
from graphslam.app.run.front_ends import preset_of
from graphslam.core.errors import MissingDataError
from graphslam.core.records import LandmarkObservations
from graphslam.io.catalog import load_recording
from tests.io import small_sources as small
from tests.io.bag_worlds import Messages, write_mcap


def chosen(path: Path, **options: object) -> tuple[str, str]:
    log = load_recording(path, **options)
    name = choose_front_end(log).frontend
    return name, preset_of(log, name)[0]


def test_clouds_without_poses_are_followed_and_with_poses_these_are_used(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", table="tum")
    assert chosen(folder) == ("segslam", "clouds")
    assert chosen(folder, poses="none")[0] == "lidar-odometry"


def test_planar_laser_and_tables(tmp_path: Path) -> None:
    assert chosen(small.carmen(tmp_path / "robot.log")) == ("segslam", "planar-laser")
    assert chosen(small.tables(tmp_path / "csv")) == ("rbpf-ekf", "named-landmarks")
    log = load_recording(tmp_path / "csv")
    seen = log["landmarks"]
    some = replace(seen, ids=np.where(np.arange(len(seen.ids)) % 3 == 0, -1, seen.ids))
    assert preset_of(replace(log, streams={**log.streams, "landmarks": some}), "rbpf-ekf") == ("", True)
    ranges = LandmarkObservations.range_only(
        times=seen.times, offsets=seen.offsets, ranges=seen.ranges, ids=seen.ids, range_sigma=0.1
    )
    assert preset_of(replace(log, streams={**log.streams, "landmarks": ranges}), "rbpf-ekf")[0] == "named-ranges"


def test_wheels_in_space_and_a_lidar_of_unknown_place_are_not_what_clouds_are_put_on(tmp_path: Path) -> None:
    m = Messages()

    def bag(name: str, flat: bool, placed: bool) -> Path:
        messages = []
        if placed:
            place = m.transforms(0.0, [("base", "lidar", np.array([0.1, 0, 0.5, 0, 0, 0, 1.0]))])
            messages.append(("/tf_static", "tf2_msgs/msg/TFMessage", small.T0, place))
        for t, pose, xyz in zip(small.stamps(), small.poses(), small.clouds(spacing=0.5)):
            pose = pose * [1, 1, 0, 1, 1, 1, 1] if flat else pose
            messages.append(("/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, xyz, frame="lidar")))
            messages.append(("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, pose, child="base")))
        return write_mcap(tmp_path / f"{name}.mcap", messages)

    assert chosen(bag("good", flat=False, placed=True))[0] == "segslam"
    assert chosen(bag("wheels", flat=True, placed=True))[0] == "lidar-odometry"
    lost = bag("lost", flat=False, placed=False)
    assert load_recording(lost).meta["unplaced"] == ["clouds"]
    assert chosen(lost)[0] == "lidar-odometry"
    assert load_recording(lost, mount=(0, 0, 0, 0, 0, 0)).meta["unplaced"] == []


def test_a_log_that_no_front_end_maps_says_what_would_do(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="laser scans with odometry"):
        choose_front_end(load_recording(small.euroc(tmp_path / "e")))
