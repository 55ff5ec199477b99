"""The front end ``segslam``: a log in, submaps with grids, matches and consistent exits out."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.geometry import se2_between
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.records import LaserScans, Odometry
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.io.growing_log import GrowingLog
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.segslam.front_end import SegSlam, SegSlamFrontEndConfig
from graphslam_frontends.segslam.segslam import SegSlamFilter
from tests.frontends.grid_world import ring
from tests.frontends.segslam.test_segslam import CONFIG


@pytest.fixture(scope="module")
def log() -> SensorLog:
    """The ring as planar scans with odometry."""
    steps = ring(0, 2, length=60.0, yaw_bias=0.006)
    n, beams = len(steps), len(steps.points) // len(steps)
    ranges = np.linalg.norm(steps.points, axis=1).reshape(n, beams)
    assert steps.truth is not None
    return SensorLog(
        name="ring",
        streams={
            "laser": LaserScans(
                times=steps.times, ranges=ranges, max_range=steps.max_range,
                bearings=np.linspace(-np.pi, np.pi, beams, endpoint=False),
            ),
            "odometry": Odometry(
                times=steps.times, increments=steps.odometry.increments, covariances=steps.odometry.covariances
            ),
        },
        truth=Truth(steps.truth),
    )  # fmt: skip


CONFIGURATION = SegSlamFrontEndConfig(
    steps=StepConfig(period=None), filter=GridFilterConfig(particles=20), segslam=CONFIG
)


@pytest.fixture(scope="module")
def submaps(log: SensorLog) -> list[Submap]:
    return list(SegSlam(CONFIGURATION).submaps(log, seed=SeedTree(0)))


def test_it_is_a_front_end_and_its_submaps_follow_each_other(log: SensorLog, submaps: list[Submap]) -> None:
    assert isinstance(SegSlam(), FrontEnd)
    assert [s.key for s in submaps] == list(range(len(submaps)))
    assert len(submaps) >= 4
    for a, b in pairwise(submaps):
        assert a.interval[1] == b.interval[0]
    assert (submaps[0].interval[0], submaps[-1].interval[1]) == log.interval
    for s in submaps:
        assert isinstance(s.grid, EvidenceGrid)
        assert s.uses == {"laser", "odometry"}
        assert s.report["ended"] in {"score", "relative-score", "max-length", "match", "end-of-log"}
        assert np.linalg.eigvalsh(s.exit_covariance).min() > 0
        assert s.trajectory is not None
        np.testing.assert_allclose(s.trajectory.poses[-1], s.exit_pose, atol=1e-9)


def test_matches_lead_where_the_robot_was(log: SensorLog, submaps: list[Submap]) -> None:
    assert log.truth is not None
    base = {s.key: log.truth.trajectory.interpolate(s.interval[0])[0] for s in submaps}
    matches = [(s.key, m) for s in submaps for m in s.matches]
    assert matches
    for key, m in matches:
        true = se2_between(base[m.target], base[key])
        assert np.linalg.norm((m.T_target_here - true)[:2]) < 0.6
        assert 0.0 < m.support <= 1.0


def test_exits_are_not_promised_too_well(log: SensorLog, submaps: list[Submap]) -> None:
    """No statistics from so few; but an exit ten σ off would be a lie."""
    assert log.truth is not None
    for s in submaps:
        ends = log.truth.trajectory.interpolate(list(s.interval))
        e = se2_between(s.exit_pose, se2_between(ends[0], ends[1]))
        assert float(e @ np.linalg.solve(s.exit_covariance, e)) < 50.0


def test_resumed_after_a_submap_the_rest_is_the_same(log: SensorLog, submaps: list[Submap]) -> None:
    drops = DropCounter()
    rest = list(SegSlam(CONFIGURATION).submaps(log, seed=SeedTree(0), after=submaps[1], drops=drops))
    assert [s.key for s in rest] == [s.key for s in submaps[2:]]
    for a, b in zip(rest, submaps[2:]):
        assert a.exit_pose.tobytes() == b.exit_pose.tobytes()
        assert a.exit_covariance.tobytes() == b.exit_covariance.tobytes()
        np.testing.assert_array_equal(a.grid.brick_values(), b.grid.brick_values())


def test_moment_matching_is_there_to_be_measured(log: SensorLog, submaps: list[Submap]) -> None:
    handover = replace(CONFIG.handover, matched_only=True)
    config = replace(CONFIGURATION, segslam=replace(CONFIG, handover=handover))
    papers = list(SegSlam(config).submaps(log, seed=SeedTree(0)))
    for ours, theirs in zip(submaps, papers):
        assert ours.exit_pose.tobytes() == theirs.exit_pose.tobytes()
        assert np.linalg.slogdet(theirs.exit_covariance)[1] < np.linalg.slogdet(ours.exit_covariance)[1]


def test_a_step_in_slices_is_the_step_and_each_registration_and_part_of_a_search_has_its_own(log: SensorLog) -> None:
    """Between two records the work is one registration or a part of a search, also when many maps are tried."""
    steps = SegSlam(CONFIGURATION).steps(log)
    whole, sliced = (
        SegSlamFilter(steps, CONFIGURATION.filter, CONFIG, SeedTree(0).child(0), prune_every=32) for _ in range(2)
    )
    most = 0
    for k in range(len(steps)):
        whole.step(k, last=k == len(steps) - 1)
        most = max(most, len(list(sliced.slices(k, last=k == len(steps) - 1))))
    assert whole.filter.particles.poses.tobytes() == sliced.filter.particles.poses.tobytes()
    assert [a.describe() for a in whole.attempts] == [a.describe() for a in sliced.attempts]
    assert most >= 2
    assert len(sliced.slice_seconds) > len(sliced.step_seconds) == len(steps)
    searches, registrations = (sum(getattr(a, n) for a in whole.attempts) for n in ("searches", "registrations"))
    assert registrations >= searches > 0
    assert len(sliced.slice_seconds) - len(steps) >= registrations + 5 * searches  # two fields, scores, maxima, modes


def test_records_that_come_alone_wait_for_a_part_of_the_work_only(
    log: SensorLog, submaps: list[Submap], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With pauses as long as a scan period, no record waits for more than two slices, also when the filter is late."""
    period = float(np.diff(log["laser"].times).mean())
    monkeypatch.setattr("graphslam_frontends.segslam.front_end.PAUSE", period)
    feed, front = GrowingLog(log.name, tmp_path), SegSlam(CONFIGURATION)
    follow, made, slices = front.follow(feed, seed=SeedTree(0)), list[Submap](), [0]
    for _, stream, k in log.events():
        feed.add(stream, log[stream].take(slice(k, k + 1)))
        while (found := next(follow)) is not None:
            made.append(found)
        slices.append(len(front._live[0].run.slice_seconds) if front._live else 0)
    assert 1 <= np.diff(slices).max() <= 2
    feed.end()
    made += [s for s in follow if s is not None]
    assert [s.exit_covariance.tobytes() for s in made] == [s.exit_covariance.tobytes() for s in submaps]


def test_options_that_need_the_whole_log_are_named_and_give_the_same_interface(log: SensorLog) -> None:
    assert SegSlam().waits_for() == ""
    by_particle = replace(CONFIG, segmentation=replace(CONFIG.segmentation, decide="particle"))
    waiting = SegSlam(replace(CONFIGURATION, segslam=by_particle))
    assert "decide" in waiting.waits_for()
    assert "level_floors" in SegSlam(SegSlamFrontEndConfig(steps=StepConfig(level_floors=True))).waits_for()
    made = list(waiting.submaps(log, seed=SeedTree(0)))
    assert [s.key for s in made] == list(range(len(made)))
    assert waiting.estimate() is None


def test_a_single_particle_gives_each_submap_as_its_segment_ends(log: SensorLog) -> None:
    """All particles descend from it; the last submap has the findings of the whole log."""
    alone = replace(CONFIGURATION, filter=replace(CONFIGURATION.filter, particles=1))
    made = list(SegSlam(alone).submaps(log, seed=SeedTree(0)))
    assert [s.key for s in made] == list(range(len(made)))
    assert made[-1].interval[1] == log.interval[1]
