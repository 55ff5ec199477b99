"""Sensor records, the log that holds them, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError, MissingDataError
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.records import (
    AckermannGeometry,
    Gps,
    LandmarkObservations,
    LaserScans,
    Odometry,
    SteeringControls,
    VelocityControls,
    check_times,
)
from graphslam.core.trajectory import Trajectory

CAR = AckermannGeometry(wheelbase=4.0)


def laser(**changes: Any) -> LaserScans:
    values: dict[str, Any] = {
        "times": [0.0, 1.0, 2.0],
        "ranges": np.full((3, 4), 5.0),
        "bearings": [-1.0, 0.0, 1.0, 2.0],
        "max_range": 80.0,
    }
    return LaserScans(**{**values, **changes})


def controls(**changes: Any) -> SteeringControls:
    values: dict[str, Any] = {"times": [0.0, 1.0], "speed": [1.0, 1.0], "steering": [0.0, 0.1], "geometry": CAR}
    return SteeringControls(**{**values, **changes})


def velocities(**changes: Any) -> VelocityControls:
    values: dict[str, Any] = {"times": [0.0, 1.0], "speed": [1.0, 1.0], "yaw_rate": [0.0, 0.1]}
    return VelocityControls(**{**values, **changes})


def gps(**changes: Any) -> Gps:
    values: dict[str, Any] = {"times": [0.5, 1.5], "positions": np.zeros((2, 2)), "sigma": [1.0, 1.0], "lever": [0, 0]}
    return Gps(**{**values, **changes})


def odometry(**changes: Any) -> Odometry:
    values: dict[str, Any] = {
        "times": [0.0, 1.0],
        "increments": np.zeros((2, 3)),
        "covariances": np.tile(np.eye(3), (2, 1, 1)),
    }
    return Odometry(**{**values, **changes})


def landmarks(**changes: Any) -> LandmarkObservations:
    values: dict[str, Any] = {
        "times": [0.0, 1.0, 2.0],
        "offsets": [0, 2, 2, 3],
        "ranges": [1.0, 2.0, 3.0],
        "bearings": [0.1, 0.2, 0.3],
        "sigmas": np.full((3, 2), 0.1),
        "ids": [5, 6, 5],
    }
    return LandmarkObservations(**{**values, **changes})


MAKERS = [laser, controls, velocities, gps, odometry, landmarks]


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (lambda t: t[::-1], "does not increase at record 1"),
        (lambda t: np.r_[t[0], t[:-1]], "does not increase at record 1"),
        (lambda t: np.r_[t[:-1], np.nan], "not finite"),
        (lambda t: np.r_[t[:-1], np.inf], "not finite"),
    ],
    ids=["backwards", "repeated", "nan", "inf"],
)
def test_bad_stamps_are_refused(make: Any, spoil: Any, what: str) -> None:
    good = make()
    with pytest.raises(DataError, match=what):
        make(times=spoil(np.array(good.times)))


@pytest.mark.parametrize(
    ("make", "changes", "what"),
    [
        (laser, {"bearings": [0.0, 1.0, 0.5, 2.0]}, "beam bearings"),
        (laser, {"bearings": [0.0, 1.0]}, "beam bearings"),
        (laser, {"times": [0.0, 1.0]}, "wrong shape"),
        (laser, {"T_base_sensor": [0.0, 0.0]}, "T_base_sensor"),
        (controls, {"speed": [1.0, np.nan]}, "speed of record 1 is not finite"),
        (velocities, {"yaw_rate": [np.inf, 0.0]}, "yaw_rate of record 0 is not finite"),
        (controls, {"steering": [np.inf, 0.0]}, "steering of record 0 is not finite"),
        (controls, {"steering": [0.0]}, "steering has the wrong shape"),
        (gps, {"sigma": [1.0, 0.0]}, "sigma of GPS record 1 is not positive"),
        (gps, {"sigma": [-1.0, 1.0]}, "sigma of GPS record 0 is not positive"),
        (gps, {"sigma": [1.0, np.nan]}, "sigma of record 1 is not finite"),
        (gps, {"positions": [[0.0, np.nan], [0.0, 0.0]]}, "position of record 0 is not finite"),
        (gps, {"lever": [0.0, 0.0, 0.0]}, "lever has the wrong shape"),
        (odometry, {"increments": [[0.0, 0.0, np.nan], [0, 0, 0]]}, "increment of record 0"),
        (odometry, {"covariances": np.eye(3)}, "covariances has the wrong shape"),
        (odometry, {"increments": np.zeros((2, 7))}, "covariances has the wrong shape"),
        (landmarks, {"offsets": [0, 2, 3]}, "offsets"),
        (landmarks, {"offsets": [0, 2, 1, 3]}, "offsets"),
        (landmarks, {"offsets": [1, 2, 2, 3]}, "offsets"),
        (landmarks, {"offsets": [0, 2, 2, 4]}, "offsets"),
        (landmarks, {"ranges": [1.0, np.nan, 3.0]}, "ranges of record 1 is not finite"),
        (landmarks, {"ids": [1, 2]}, "ids and observations differ"),
        (landmarks, {"bearings": [1.0, 2.0]}, "bearings has the wrong shape"),
        (landmarks, {"sigmas": [[0.1, 0.1], [0.1, 0.0], [0.1, 0.1]]}, "sigma of observation 1 is not positive"),
    ],
)
def test_bad_records_are_refused(make: Any, changes: dict, what: str) -> None:
    with pytest.raises((DataError, GeometryError), match=what):
        make(**changes)


@pytest.mark.parametrize(
    "geometry", [{"wheelbase": 0.0}, {"wheelbase": np.nan}, {"wheelbase": 2.0, "model": "tank"}], ids=str
)
def test_impossible_vehicle_is_refused(geometry: dict) -> None:
    with pytest.raises(GeometryError):
        AckermannGeometry(**geometry)


def test_stamp_error_says_what_was_found() -> None:
    with pytest.raises(DataError, match=r"2\.000000 after 3\.000000"):
        check_times([1.0, 3.0, 2.0])


def test_take_keeps_scans_whole() -> None:
    cut = landmarks().take(np.array([False, True, True]))
    assert cut.times.tolist() == [1.0, 2.0]
    assert cut.offsets.tolist() == [0, 0, 1]
    assert cut.ranges.tolist() == [3.0]
    assert cut.ids.tolist() == [5]
    empty = landmarks().take(slice(0, 0))
    assert len(empty.times) == 0
    assert empty.offsets.tolist() == [0]


def test_a_scan_without_returns_is_a_scan() -> None:
    assert np.isnan(laser(ranges=np.full((3, 4), np.nan)).ranges).all()
    s = landmarks()
    assert s.scan(1) == slice(2, 2)


def log(**streams: Any) -> SensorLog:
    return SensorLog(name="test", streams=streams or {"laser": laser(), "controls": controls(), "gps": gps()})


def test_events_come_in_order_of_time_and_ties_in_order_of_name() -> None:
    events = list(log().events())
    assert [t for t, _, _ in events] == sorted(t for t, _, _ in events)
    assert events == [
        (0.0, "controls", 0),
        (0.0, "laser", 0),
        (0.5, "gps", 0),
        (1.0, "controls", 1),
        (1.0, "laser", 1),
        (1.5, "gps", 1),
        (2.0, "laser", 2),
    ]


def test_interval_slice_and_membership() -> None:
    l = log()
    assert l.interval == (0.0, 2.0)
    assert l.duration == 2.0
    assert "gps" in l
    assert "imu" not in l
    assert l.of_type(Gps) == "gps"
    assert l.of_type(Odometry) is None
    cut = l.slice(0.5, 1.0)
    assert [len(cut[n].times) for n in ("laser", "controls", "gps")] == [1, 1, 1]
    assert "1.00" in cut._repr_html_()


def test_a_missing_stream_names_those_that_are_there() -> None:
    with pytest.raises(MissingDataError, match="laser, controls, gps"):
        log()["imu"]


def test_an_empty_log_has_no_interval() -> None:
    with pytest.raises(MissingDataError, match="empty"):
        _ = log(gps=gps().take(slice(0, 0))).interval


def test_drops_are_counted_by_stream_and_reason() -> None:
    drops = DropCounter()
    drops.drop("gps", "sigma is zero", 3)
    drops.drop("gps", "sigma is zero")
    drops.drop("laser", "nothing", 0)
    assert dict(drops.counts) == {"gps: sigma is zero": 4}


def test_truth_defaults_to_no_landmarks() -> None:
    truth = Truth(trajectory=Trajectory([0.0], [[0.0, 0.0, 0.0]]))
    assert truth.landmarks.shape == (0, 2)
