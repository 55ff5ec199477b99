"""Bad input of steps is counted or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, GeometryError, MissingDataError
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.range_scans import RangeScans
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps
from tests.frontends.step_logs import odometry_of, planar_log, room_log, spoiled


@pytest.fixture(scope="module")
def room() -> SensorLog:
    return room_log()


def test_readings_that_say_nothing_are_counted(room: SensorLog) -> None:
    scans, clean = room["scanner"], make_steps(room)
    ranges = scans.ranges.copy()
    ranges[3, 4] = np.nan
    ranges[5] = np.nan
    ranges[7, :2] = [0.01, -1.0]
    ranges[9] = 8.0
    ranges[11, 0] = np.inf
    drops = DropCounter()
    steps = make_steps(spoiled(room, scanner=replace(scans, ranges=ranges)), drops=drops)
    assert drops.counts == {
        "scanner: beams without a reading": 16,
        "scanner: scan without a reading": 1,
        "scanner: nearer than 0.1 m": 2,
        "scanner: scan without a hit (kept)": 1,
    }
    assert len(steps.points) == len(clean.points) - 18
    assert np.sum(~steps.returns) >= np.sum(~clean.returns) + 10
    assert np.all(np.isfinite(steps.points))


@pytest.mark.parametrize("value", [np.nan, 8.0])
def test_a_scanner_that_sees_nothing_gives_steps_all_the_same(room: SensorLog, value: float) -> None:
    scans = replace(room["scanner"], ranges=np.full_like(room["scanner"].ranges, value))
    drops = DropCounter()
    steps = make_steps(spoiled(room, scanner=scans), drops=drops)
    assert len(steps) == 10
    assert not np.any(steps.returns)
    if np.isnan(value):
        assert len(steps.points) == 0
        assert drops.counts["steps: step without a beam (kept)"] == 10
    else:
        np.testing.assert_allclose(np.linalg.norm(steps.points - steps.origins, axis=1), 8.0)
        assert drops.counts["scanner: scan without a hit (kept)"] == len(scans.times)


def test_a_pause_of_the_scanner_leaves_empty_steps(room: SensorLog) -> None:
    scans = room["scanner"]
    drops = DropCounter()
    steps = make_steps(spoiled(room, scanner=scans.take((scans.times < 1.0) | (scans.times > 2.6))), drops=drops)
    assert len(steps) == 10
    assert drops.counts["steps: step without a beam (kept)"] == 3
    assert np.all(np.linalg.norm(steps.odometry.increments[1:, :3], axis=1) > 0.1)
    points, origins, met = steps.scan(4)
    assert points.shape == origins.shape == (0, 3)
    assert met.shape == (0,)


def test_gaps_and_jumps_of_recorded_odometry(room: SensorLog) -> None:
    o, path = room["odometry"], room.truth.trajectory
    keep = (path.times < 1.01) | (path.times > 2.99)
    sparse = odometry_of(Trajectory(path.times[keep], path.poses[keep]))
    drops = DropCounter()
    steps = make_steps(spoiled(room, odometry=sparse), drops=drops)
    assert drops.counts == {"spoiled/odometry: gap bridged": 1}
    doubt = np.sqrt(steps.odometry.covariances[:, 3, 3])
    assert doubt[5] > 0.1  # 20 % of a metre a second, over a fifth of the gap, which is white in it
    assert doubt[1] < 0.01
    whole = steps.errors.between(1, 8)[1]
    assert 0.35 < np.sqrt(whole[3, 3]) < 0.6  # 20 % of some 2 m
    with pytest.raises(DataError, match=r"gap without records: 2\.\d+ s after record 50.*at most 1.5 s"):
        make_steps(spoiled(room, odometry=o.take(keep)), StepConfig(longest_record=1.5))
    late = replace(o, times=o.times + 3600.0 * (o.times > 2.0))
    scans = room["scanner"]
    jumped = replace(scans, times=scans.times + 3600.0 * (scans.times > 2.0))
    with pytest.raises(DataError, match="gap without records: 3600"):
        make_steps(spoiled(room, odometry=late, scanner=jumped))
    never = replace(o, times=o.times + 1e9 * (o.times > 2.0))
    jumped = replace(scans, times=scans.times + 1e9 * (scans.times > 2.0))
    with pytest.raises(DataError, match="gap without records"):
        make_steps(spoiled(room, odometry=never, scanner=jumped))


def test_clocks_that_differ(room: SensorLog) -> None:
    scans = room["scanner"]
    drops = DropCounter()
    steps = make_steps(spoiled(room, scanner=replace(scans, times=scans.times + 1.0)), drops=drops)
    assert drops.counts["scanner: beams without odometry at their time"] > 150
    assert len(steps) == 8
    with pytest.raises(DataError, match="are the clocks the same"):
        make_steps(spoiled(room, scanner=replace(scans, times=scans.times + 100.0)))


def test_refusals(room: SensorLog) -> None:
    scanner, odometry = room["scanner"], room["odometry"]
    with pytest.raises(MissingDataError, match="no scanner"):
        make_steps(SensorLog(name="blind", streams={"odometry": odometry}))
    with pytest.raises(MissingDataError, match="no motion"):
        make_steps(SensorLog(name="lame", streams={"scanner": scanner}))
    with pytest.raises(MissingDataError, match="single record"):
        make_steps(SensorLog(name="one", streams={"scanner": scanner, "odometry": odometry.take(slice(0, 1))}))
    with pytest.raises(MissingDataError, match="empty"):
        make_steps(SensorLog(name="none", streams={"scanner": scanner, "odometry": odometry.take(slice(0, 0))}))
    with pytest.raises(ConfigError, match="3 dimensions, the motion of wheels 2"):
        make_steps(SensorLog(name="mixed", streams={"scanner": scanner, "wheels": planar_log()["wheels"]}))
    with pytest.raises(ConfigError, match="holds no beams"):
        make_steps(room, StepConfig(scanners=("odometry",)))
    with pytest.raises(ConfigError, match="motion from scanner"):
        make_steps(room, StepConfig(motion=("scanner",)))
    with pytest.raises(MissingDataError, match="no stream 'gyro'"):
        make_steps(room, StepConfig(motion=("gyro",)))
    for bad in (
        {"period": 0.0},
        {"period": np.nan},
        {"max_range": -1.0},
        {"most_points": 0},
        {"yaw_bias": np.inf},
        {"min_range": -0.1},
        {"max_range": 0.05},
        {"longest_record": 0.0},
    ):
        with pytest.raises(ConfigError, match="steps: "):
            StepConfig(**bad)


def test_a_scan_with_no_record(room: SensorLog) -> None:
    empty = room["scanner"].take(slice(0, 0))
    assert isinstance(empty, RangeScans)
    steps = make_steps(spoiled(room, scanner=empty))
    assert len(steps) == 10
    assert len(steps.points) == 0
    with pytest.raises(DataError, match="no record of the scanner"):
        make_steps(spoiled(room, scanner=empty), StepConfig(period=None))


def test_steps_check_themselves(room: SensorLog) -> None:
    steps = make_steps(room)
    points = steps.points.copy()
    points[7, 1] = np.nan
    for error, bad in (
        (DataError, {"points": points}),
        (GeometryError, {"points": steps.points[:, :2]}),
        (DataError, {"offsets": steps.offsets[:-1]}),
        (DataError, {"offsets": steps.offsets[::-1]}),
        (GeometryError, {"returns": steps.returns.astype(float)}),
        (DataError, {"times": steps.times + 1.0}),
        (DataError, {"max_range": 0.0}),
        (GeometryError, {"tilt": np.zeros((3, 2))}),
    ):
        with pytest.raises(error):
            replace(steps, **bad)
    assert isinstance(replace(steps, name="other"), Steps)
