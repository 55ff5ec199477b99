"""Beams of a long log, thinned evenly before they become surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.records import Odometry
from graphslam.refine.nodes import thin_beams
from graphslam.refine.scans import Scans
from graphslam_frontends.odometry.motion_prior import BiasSigmas


@pytest.mark.parametrize("most", [1, 7, 40, 99])
def test_so_many_beams_are_left_each_in_its_step(most: int) -> None:
    counts = np.array([10, 0, 30, 59])
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    step = np.repeat(np.arange(4), counts)
    points = np.column_stack([step, np.arange(99)]).astype(np.float32)
    times = np.arange(4.0)
    sigmas = dict.fromkeys(("yaw_bias", "yaw_walk", "scale", "direction", "clock", "tilt", "bend", "turn"), 0.1)
    motion = Odometry(times=times, increments=np.zeros((4, 3)), covariances=np.tile(np.eye(3), (4, 1, 1)))
    scans = Scans(
        times=times, odometry=motion,
        offsets=offsets, points=points, origins=points, returns=np.ones(99, bool), max_range=9.0,
        biases=BiasSigmas(**sigmas),
    )  # fmt: skip
    some = thin_beams(scans, most)
    assert len(some.points) == most == some.offsets[-1]
    for k in range(4):
        p, _, _ = some.scan(k)
        assert np.all(p[:, 0] == k)
        assert abs(len(p) - most * counts[k] / 99) <= 1.0
    assert thin_beams(scans, 99) is scans
