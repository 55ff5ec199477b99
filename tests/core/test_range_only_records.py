"""Range-only observations: an infinite bearing σ says so, everything else is checked as before, the store keeps it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations
from graphslam.io.log_store import load_log, save_log

TIMES, OFFSETS = np.array([0.0, 0.2, 0.4]), np.array([0, 2, 2, 3])


def ranges_only(**changes):
    values = {"times": TIMES, "offsets": OFFSETS, "ranges": [3.0, 4.0, 5.0], "range_sigma": 0.3, "ids": [7, 1, 7]}
    return LandmarkObservations.range_only(**{**values, **changes})


def test_constructor_states_that_there_is_no_bearing():
    z = ranges_only(range_sigma=[0.1, 0.2, 0.3], max_range=30.0)
    np.testing.assert_array_equal(z.has_bearing, [False] * 3)
    np.testing.assert_array_equal(z.bearings, 0.0)
    np.testing.assert_array_equal(z.sigmas, [[0.1, np.inf], [0.2, np.inf], [0.3, np.inf]])
    cut = z.take([0, 2])
    np.testing.assert_array_equal(cut.ranges, [3.0, 4.0, 5.0])
    assert not cut.has_bearing.any()
    assert cut.max_range == 30.0


def test_both_kinds_may_share_a_stream():
    z = LandmarkObservations(
        times=TIMES,
        offsets=OFFSETS,
        ranges=[1.0, 2, 3],
        bearings=[0.5, 0.0, -0.1],
        sigmas=[[1, 0.1], [1, np.inf], [1, 1]],
    )
    np.testing.assert_array_equal(z.has_bearing, [True, False, True])


@pytest.mark.parametrize(
    ("sigmas", "bearings", "what"),
    [
        ([[1, np.inf], [1, 1], [1, 1]], [0.1, 0, 0], "observation 0 has a bearing"),
        ([[1, 1], [1, -np.inf], [1, 1]], [0, 0, 0], "sigmas of record 1 is not finite"),
        ([[1, 1], [1, np.nan], [1, 1]], [0, 0, 0], "sigmas of record 1 is not finite"),
        ([[1, 1], [1, 1], [np.inf, np.inf]], [0, 0, 0], "sigmas of record 2 is not finite"),
        ([[1, 1], [0.0, np.inf], [1, 1]], [0, 0, 0], "sigma of observation 1 is not positive"),
        ([[1, 1], [1, 1], [1, np.inf]], [0, 0, np.nan], "bearings of record 2 is not finite"),
    ],
)
def test_everything_else_is_refused_as_before(sigmas, bearings, what):
    with pytest.raises(DataError, match=what):
        LandmarkObservations(times=TIMES, offsets=OFFSETS, ranges=np.ones(3), bearings=bearings, sigmas=sigmas)


def test_log_store_keeps_range_only_streams_bit_for_bit(tmp_path: Path):
    log = SensorLog(name="ranges", streams={"beacons": ranges_only()})
    save_log(log, tmp_path / "log")
    back = load_log(tmp_path / "log")["beacons"]
    for name in ("times", "offsets", "ranges", "bearings", "sigmas", "ids", "T_base_sensor"):
        np.testing.assert_array_equal(getattr(back, name), getattr(log["beacons"], name))
