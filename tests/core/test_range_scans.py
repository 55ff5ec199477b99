"""Scans of a spinning head, and inertial records: what they say and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog
from graphslam.core.range_scans import RangeScans

NOISE = ImuNoise(
    gyro=1e-4, gyro_bias=1e-3, gyro_walk=1e-5, accelerometer=1e-3, accelerometer_bias=0.02, accelerometer_walk=1e-4
)


def _scans(**changes: Any) -> RangeScans:
    fields: dict[str, Any] = {
        "times": [0.0, 1.0, 2.0],
        "ranges": np.full((3, 2), 4.0, np.float32),
        "directions": np.array([[1.0, 0, 0], [0, 1.0, 0]]),
        "beam_times": [0.0, 0.5],
        "max_range": 30.0,
        "sigma": 0.02,
        "spin": [0.0, 0.5 * np.pi, np.pi],
        "spin_rate": [np.pi, 0.0, 0.0],
    }
    return RangeScans(**(fields | changes))


def test_beams_turn_with_the_head_and_its_mount() -> None:
    s = _scans()
    _, d = s.head_rays()
    assert d.shape == (3, 2, 3)
    np.testing.assert_allclose(d[:, 0], np.tile([1.0, 0, 0], (3, 1)), atol=1e-12)  # along the axis of the spin
    # the second beam of the first scan leaves half a second later, a quarter turn about x on: y has become z
    np.testing.assert_allclose(d[0, 1], [0, 0, 1.0], atol=1e-12)
    np.testing.assert_allclose(d[1, 1], [0, 0, 1.0], atol=1e-12)
    np.testing.assert_allclose(d[2, 1], [0, -1.0, 0], atol=1e-12)
    turned = _scans(T_base_mount=[1.0, 2.0, 3.0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # 90° about z
    origin, d = turned.head_rays(slice(1, 2))
    np.testing.assert_allclose(origin, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(d[0], [[0, 1.0, 0], [0, 0, 1.0]], atol=1e-12)


def test_streams_can_be_sliced() -> None:
    imu = Imu(
        times=np.arange(3.0), angular_rate=np.zeros((3, 3)), specific_force=np.ones((3, 3)), noise=NOISE,
        attitude=np.arange(6.0).reshape(3, 2),
    )  # fmt: skip
    log = SensorLog(name="x", streams={"scans": _scans(), "imu": imu}).slice(0.5, 1.5)
    assert log["scans"].times.tolist() == [1.0]
    assert log["scans"].spin.tolist() == [0.5 * np.pi]
    assert log["imu"].attitude.tolist() == [[2.0, 3.0]]


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"ranges": np.zeros((3, 2), int)}, DataError, "shape or type"),
        ({"directions": np.array([[1.0, 0, 0], [0, 1.1, 0]])}, GeometryError, "direction of beam 1"),
        ({"beam_times": [0.5, 0.0]}, DataError, "times of the beams"),
        ({"beam_times": [-0.1, 0.0]}, DataError, "times of the beams"),
        ({"spin": [0.0, np.nan, 0.0]}, DataError, "spin is not finite"),
        ({"spin_rate": [0.0]}, GeometryError, "spin_rate has the wrong shape"),
        ({"sigma": 0.0}, DataError, "sigma"),
        ({"max_range": np.inf}, DataError, "max_range"),
        ({"times": [0.0, 2.0, 1.0]}, DataError, "record 2"),
    ],
)
def test_impossible_scans_are_refused(change: dict[str, Any], error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        _scans(**change)


def test_impossible_inertial_records_are_refused() -> None:
    rates = np.zeros((2, 3))
    bad = rates.copy()
    bad[1, 2] = np.inf
    with pytest.raises(DataError, match="angular_rate of record 1"):
        Imu(times=[0.0, 1.0], angular_rate=bad, specific_force=rates, noise=NOISE)
    with pytest.raises(GeometryError, match="attitude"):
        Imu(times=[0.0, 1.0], angular_rate=rates, specific_force=rates, noise=NOISE, attitude=rates)
    with pytest.raises(DataError, match="gyro_walk"):
        ImuNoise(
            gyro=0, gyro_bias=0, gyro_walk=-1.0, accelerometer=0, accelerometer_bias=0, accelerometer_walk=0
        )  # fmt: skip
