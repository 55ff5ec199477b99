"""Steps made while records arrive are those of the whole log, whatever the portions, and no scan has to wait long."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.log import SensorLog
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LaserScans, Odometry
from graphslam.io.growing_log import GrowingLog
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from graphslam_frontends.odometry.growing_steps import LATE, GrowingSteps, needs_whole_log
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from tests.frontends.grid_world import ring
from tests.frontends.landmarks.test_preparing import in_portions


def crawler() -> SensorLog:
    whole = simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.02, max_range=8.0))
    begin, _ = whole.interval
    return whole.slice(begin + 3.0, begin + 25.0)


def planar() -> SensorLog:
    steps = ring(0, 2, length=20.0, yaw_bias=0.006)
    n, beams = len(steps), len(steps.points) // len(steps)
    scans = LaserScans(
        times=steps.times,
        ranges=np.linalg.norm(steps.points, axis=1).reshape(n, beams),
        max_range=steps.max_range,
        bearings=np.linspace(-np.pi, np.pi, beams, endpoint=False),
    )
    u = steps.odometry
    moves = Odometry(times=steps.times, increments=u.increments, covariances=u.covariances)
    return SensorLog(name="ring", streams={"laser": scans, "odometry": moves})


def all_steps(steps: GrowingSteps) -> GrowingSteps:
    while steps.more():
        pass
    steps.show(steps.made)
    return steps


@pytest.mark.parametrize(
    ("log", "config"),
    [(crawler, StepConfig(max_range=8.0)), (planar, StepConfig(period=None)), (planar, StepConfig(period=0.3))],
    ids=["imu-and-wheels", "odometry-scan-by-scan", "odometry"],
)
def test_they_are_the_steps_of_the_whole_log(log: object, config: StepConfig) -> None:
    here = log()  # type: ignore[operator]
    whole, grown = make_steps(here, config), all_steps(GrowingSteps(RecordSource(here), config))
    assert grown.made == len(whole)
    assert grown.complete
    assert (grown.max_range, grown.uses, grown.name) == (whole.max_range, whole.uses, whole.name)
    np.testing.assert_allclose(grown.times, whole.times, atol=1e-9)
    np.testing.assert_allclose(grown.odometry.increments, whole.odometry.increments, atol=1e-11)
    np.testing.assert_allclose(grown.odometry.covariances, whole.odometry.covariances, atol=1e-15)
    np.testing.assert_allclose(grown.path_length, whole.path_length, atol=1e-9)
    np.testing.assert_array_equal(grown.returned, whole.returned)
    for k in range(len(whole)):
        for a, b in zip(grown.scan(k), whole.scan(k)):
            np.testing.assert_allclose(a, b, atol=1e-11)
    if whole.tilt is not None:
        np.testing.assert_allclose(grown.tilt, whole.tilt, atol=1e-12)
    n = len(whole)
    assert grown.errors is not None
    assert whole.errors is not None
    for first, last in ((0, n - 1), (n // 3, n // 2)):  # also over the seams of the parts, and in one frame
        for a, b in zip(grown.errors.between(first, last), whole.errors.between(first, last)):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(("log", "config"), [(crawler, StepConfig(max_range=8.0)), (planar, StepConfig(period=None))])
def test_they_do_not_depend_on_the_portions(log: object, config: StepConfig, tmp_path: Path) -> None:
    here = log()  # type: ignore[operator]
    at_once = all_steps(GrowingSteps(RecordSource(here), config))
    feed, early = GrowingLog(here.name, tmp_path), 0
    steps = GrowingSteps(feed, config)
    scans: list[tuple[np.ndarray, ...]] = []
    for name, part in in_portions(here, 3):
        feed.add(name, part)
        while steps.more():
            pass
        while len(scans) < steps.made:
            scans.append(steps.scan(len(scans)))
        steps.forget_before(len(scans) - 2)
        early = steps.made
    assert early > 0.7 * at_once.made
    assert max(feed.held_records.get("scanner", 0), feed.held_records.get("laser", 0)) < 150  # used scans are freed
    feed.end()
    while steps.more():
        pass
    while len(scans) < steps.made:
        scans.append(steps.scan(len(scans)))
    steps.show(steps.made)
    assert steps.times.tobytes() == at_once.times.tobytes()
    assert steps.odometry.increments.tobytes() == at_once.odometry.increments.tobytes()
    assert steps.odometry.covariances.tobytes() == at_once.odometry.covariances.tobytes()
    assert [a.tobytes() for s in scans for a in s] == [a.tobytes() for k in range(len(scans)) for a in at_once.scan(k)]


def test_a_scanner_that_dies_holds_up_the_others_for_a_short_time_only(tmp_path: Path) -> None:
    log = simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(max_range=8.0, scanners=2))
    begin, _ = log.interval
    log = log.slice(begin, begin + 12.0)
    first, second = (n for n, s in log.streams.items() if n.startswith("scanner"))
    half = log[second].take(slice(0, len(log[second].times) // 2))
    log, feed = replace(log, streams={**log.streams, second: half}), GrowingLog("dead", tmp_path)
    steps = GrowingSteps(feed, StepConfig(max_range=8.0))
    for time, name, k in log.events():
        feed.add(name, log[name].take(slice(k, k + 1)))
        while steps.more():
            pass
        if steps.made:
            assert steps.all_times()[-1] > time - LATE - 2.6
    assert steps.made >= 20
    assert first in steps.uses


def test_what_needs_the_whole_log_is_named() -> None:
    assert needs_whole_log(StepConfig()) == ""
    assert "level_floors" in needs_whole_log(StepConfig(level_floors=True))
    assert "match_scans" in needs_whole_log(StepConfig(match_scans=True))
    log = crawler()
    imu = replace(log["imu"], attitude=None)
    steps = GrowingSteps(RecordSource(replace(log, streams={**log.streams, "imu": imu})), StepConfig())
    assert not steps.more()
    assert "attitude" in steps.whole_log
