"""The tree detector on the real log, against the published detections of UFastSLAM."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.records import LandmarkObservations, LaserScans
from graphslam_frontends.detectors.trees import TreeDetectorConfig, detect_trees, find_trunks
from graphslam_studies.io.victoria_park import read_victoria_park
from graphslam_studies.io.victoria_park_published import read_ufastslam_detections
from tests.reference.trees import detect_scan

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def laser(data_dir: Path) -> LaserScans:
    return read_victoria_park(data_dir / "victoria_park_raw", gps="none")["laser"]


@pytest.fixture(scope="module")
def published(data_dir: Path, laser: LaserScans) -> LandmarkObservations:
    """Published detections of exactly the scans of the ASCII log."""
    found = read_ufastslam_detections(data_dir / "victoria_park_processed")
    return found.take(np.searchsorted(found.times, laser.times - 1e-4))


def matches(
    ours: LandmarkObservations, theirs: LandmarkObservations, range_gate: float, bearing_gate: float
) -> np.ndarray:
    """Pairs (our row, their row) within both gates; each row at most once, first come first served."""
    pairs = []
    for k in range(len(ours.times)):
        a, b = ours.scan(k), theirs.scan(k)
        close = (np.abs(ours.ranges[a][:, None] - theirs.ranges[b][None]) < range_gate) & (
            np.abs(ours.bearings[a][:, None] - theirs.bearings[b][None]) < bearing_gate
        )
        free = np.ones(close.shape[1], dtype=bool)
        for i, row in enumerate(close):
            j = np.flatnonzero(row & free)
            if len(j):
                free[j[0]] = False
                pairs.append((a.start + i, b.start + j[0]))
    return np.array(pairs)


def test_agreement_with_published_detections(laser: LaserScans, published: LandmarkObservations) -> None:
    np.testing.assert_allclose(published.times, laser.times, atol=1e-9)
    ours = detect_trees(laser)
    pairs = matches(ours, published, 0.3, np.deg2rad(0.5))
    precision, recall = len(pairs) / len(ours.ranges), len(pairs) / len(published.ranges)
    assert precision >= 0.87, precision
    assert recall >= 0.97, recall
    assert 7.5 < len(ours.ranges) / len(laser.times) < 8.5
    # the centre is where the others put it, to the centimetre in the median
    difference = ours.ranges[pairs[:, 0]] - published.ranges[pairs[:, 1]]
    middle = np.median(difference)
    assert abs(middle) < 0.02, middle
    assert 1.4826 * np.median(np.abs(difference - middle)) < 0.025
    turn = ours.bearings[pairs[:, 0]] - published.bearings[pairs[:, 1]]
    assert abs(np.rad2deg(turn.mean())) < 0.01
    assert np.rad2deg(turn.std()) < 0.06
    # and a gate three times as tight changes little: the matches are no accident of the gate
    tight = matches(ours, published, 0.1, np.deg2rad(0.25))
    assert len(tight) > 0.95 * len(pairs)


def test_equals_the_slow_twin_on_real_scans(laser: LaserScans) -> None:
    part = laser.take(slice(0, None, 120))
    fast = find_trunks(part)
    slow = [(k, t) for k, r in enumerate(part.ranges) for t in detect_scan(r, part.bearings, TreeDetectorConfig())]
    np.testing.assert_array_equal(fast.scan, [k for k, _ in slow])
    same = fast.fitted == np.array([t.fitted for _, t in slow])
    assert same.mean() > 0.99
    np.testing.assert_allclose(fast.ranges[same], np.array([t.range for _, t in slow])[same], atol=1e-6)
    np.testing.assert_allclose(fast.bearings[same], np.array([t.bearing for _, t in slow])[same], atol=1e-7)
    np.testing.assert_allclose(fast.sigmas[same, 0], np.array([t.sigma_range for _, t in slow])[same], rtol=2e-3)


def test_whole_log_in_one_call_is_fast(laser: LaserScans) -> None:
    """CPU time, so that a busy machine does not fail it."""
    detect_trees(laser.take(slice(0, 2)))  # compile
    best = np.inf
    for _ in range(3):
        start = time.process_time()
        detect_trees(laser)
        best = min(best, time.process_time() - start)
    assert best < 1.0, best


def test_nearer_detections_do_not_depend_on_max_range(laser: LaserScans) -> None:
    """A shorter reach removes the far ones and may free some that a far thing stood beside; the near ones stay."""
    part = laser.take(slice(0, 700))
    near, far = detect_trees(part, TreeDetectorConfig(max_range=45.0)), detect_trees(part)
    assert near.ranges.max() < 46.0
    inside = set(zip(np.round(far.ranges[far.ranges < 40.0], 9), np.round(far.bearings[far.ranges < 40.0], 9)))
    found = set(zip(np.round(near.ranges, 9), np.round(near.bearings, 9)))
    assert len(inside - found) < 0.02 * len(inside)
