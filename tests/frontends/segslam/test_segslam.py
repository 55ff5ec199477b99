"""SegSLAM whole, on a ring of corridors driven one and a half times, whose odometry turns too far at every step."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.poses import group_of
from graphslam.core.random import SeedTree
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam import segmentation, segslam
from graphslam_frontends.segslam.config import (
    CandidateSearch,
    ChoiceConfig,
    SegmentationConfig,
    SegmentCandidateConfig,
    SegSlamConfig,
)
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segslam import run_segslam
from tests.frontends.grid_world import ring

CONFIG = SegSlamConfig(
    segmentation=SegmentationConfig(window=2.0, min_seconds=6.0, min_length=5.0, max_length=14.0, excluded=3.0),
    winnowing=SegmentCandidateConfig(gap=15.0),
    search=CandidateSearch(source_radius=8.0),
    choice=ChoiceConfig(every=2.0),
)
"""A small world: segments of some metres, and a loop of 37 m."""


@functools.cache
def world(seed: int, dim: int, bias: float = 0.01) -> Steps:
    return ring(seed, dim, length=60.0, yaw_bias=bias, beams=120 if dim == 2 else 480)


@functools.cache
def run(seed: int, dim: int, particles: int = 20, threads: int = 1, config: SegSlamConfig = CONFIG) -> SegSlamResult:
    return run_segslam(world(seed, dim), GridFilterConfig(particles=particles, threads=threads), config, SeedTree(seed))


def _error(steps: Steps, pose: np.ndarray) -> float:
    assert steps.truth is not None
    group = group_of(pose)
    true = group.between(steps.truth.poses[0], steps.truth.poses[-1])
    return float(np.linalg.norm((pose - true)[:2]))


def _dead_reckoning(steps: Steps) -> np.ndarray:
    group = group_of(steps.odometry.increments)
    T = group.identity
    for u in steps.odometry.increments:
        T = group.compose(T, u)
    return T


@pytest.mark.parametrize("dim", [2, 3])
def test_loop_is_closed(dim: int) -> None:
    """Dead reckoning is metres off at the end; with re-entries it is not, in the mean of some runs."""
    lost = np.mean([_error(world(s, dim), _dead_reckoning(world(s, dim))) for s in range(3)])
    found = np.mean([_error(world(s, dim), run(s, dim).final_pose) for s in range(3)])
    assert lost > 4.0
    assert found < (0.5 if dim == 2 else 1.5)
    for s in range(3):
        r = run(s, dim)
        assert r.report()["matches"] > 0
        assert {b.why for b in r.boundaries} >= {"match", "end-of-log"}


def test_every_match_is_a_place_where_the_robot_was() -> None:
    """Entries into older maps against the truth: the frame of a map is where its segment began in truth."""
    offsets = []
    for seed in range(3):
        r, steps = run(seed, 2), world(seed, 2)
        assert steps.truth is not None
        group = r.segmap.group
        for i in r.segmap.alive.tolist():
            s = r.segmap[i]
            if s.kind != "match":
                continue
            source = s.source  # of the map that was entered: follow it to where it was begun
            while r.segmap.table.source[source] >= 0:
                source = int(r.segmap.table.source[source])
            frame = group.compose(
                steps.truth.poses[r.segmap.table.start[source]], group.inverse(r.segmap.table.entry[source])
            )
            true = group.between(frame, steps.truth.poses[s.interval[0]])
            off = float(np.linalg.norm((s.T_entry - true)[:2]))
            offsets.append(off)
    assert len(offsets) >= 20
    assert max(offsets) <= 1.0


@pytest.mark.parametrize("dim", [2, 3])
def test_the_same_seed_gives_the_same_segmap_with_one_thread_and_two(dim: int) -> None:
    a, b = run(1, dim), run(1, dim, threads=2)
    assert a.segmap.describe() == b.segmap.describe()
    assert [x.describe() for x in a.attempts] == [x.describe() for x in b.attempts]
    assert a.final_pose.tobytes() == b.final_pose.tobytes()
    for i in a.segmap.alive[::7].tolist():
        grids = [r.segmap.map_of(i) for r in (a, b)]
        np.testing.assert_array_equal(grids[0].brick_values(), grids[1].brick_values())
    assert run(2, dim).segmap.describe() != a.segmap.describe()


@pytest.mark.parametrize("dim", [2, 3])
def test_paths_go_on_where_they_were(dim: int) -> None:
    """No step of a concatenated path is longer than the robot drives, but at seams: what a match leaves over."""
    r = run(0, dim)
    path = r.trajectory()
    assert np.array_equal(path.times, world(0, dim).times)
    step = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    jumps = np.flatnonzero(step > 0.7)
    boundaries = {b.step for b in r.boundaries}
    assert all(bool({int(j), int(j) + 1} & boundaries) for j in jumps)
    np.testing.assert_allclose(path.poses[0][:dim], [0.0, 0.0, r.segmap.lift][:dim], atol=1e-9)


def test_one_particle_without_matches_is_dead_reckoning() -> None:
    steps = world(0, 2, 0.002)
    config = replace(CONFIG, winnowing=SegmentCandidateConfig(gap=1e6))
    r = run_segslam(steps, GridFilterConfig(particles=1), config, SeedTree(0))
    assert len(r.boundaries) > 3
    np.testing.assert_allclose(r.final_pose, _dead_reckoning(steps), atol=1e-9)


def test_ground_driven_again_does_not_fill_a_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    """One and a half rounds of 37 m without matches: 60 m of way, but 37 m of ground."""

    monkeypatch.setattr(segslam, "KNOWN_GAP", 10.0)

    def cuts(known_score: float, known_radius: float = 2.0) -> list[str]:
        for module in (segslam, segmentation):
            monkeypatch.setattr(module, "KNOWN_SCORE", known_score)
        monkeypatch.setattr(segslam, "KNOWN_RADIUS", known_radius)
        cut = SegmentationConfig(window=2.0, max_length=45.0, score=0.0, relative_score=1e-6, excluded=3.0)
        config = replace(CONFIG, segmentation=cut, winnowing=SegmentCandidateConfig(gap=1e6))
        r = run_segslam(world(0, 2, 0.002), GridFilterConfig(particles=10), config, SeedTree(0))
        return [b.why for b in r.boundaries]

    assert cuts(known_score=0.6) == ["end-of-log"]
    assert cuts(known_score=2.0) == ["max-length", "end-of-log"]
    assert cuts(known_score=0.6, known_radius=0.0) == ["max-length", "end-of-log"]  # its path never passed so near


def test_decisions_of_each_particle_leave_segments_of_different_lengths() -> None:
    config = replace(CONFIG, segmentation=replace(CONFIG.segmentation, decide="particle", score=0.9))
    r = run(0, 2, config=config)
    together = run(0, 2)
    assert len(r.segmap.intervals()) > len(together.segmap.intervals())
    assert _error(world(0, 2), r.final_pose) < 2.0


def test_localisation_can_judge_a_match() -> None:
    config = replace(CONFIG, choice=replace(CONFIG.choice, method="both"))
    r = run(0, 2, config=config)
    assert r.report()["matches"] > 0
    assert _error(world(0, 2), r.final_pose) < 0.6


def _with(steps: Steps, keep: np.ndarray, returns: np.ndarray | None = None) -> Steps:
    """Only the beams ``keep``."""
    owner = np.repeat(np.arange(len(steps)), np.diff(steps.offsets))
    counts = np.bincount(owner[keep], minlength=len(steps))
    return replace(
        steps,
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=steps.points[keep],
        origins=steps.origins[keep],
        returns=(steps.returns if returns is None else returns)[keep],
    )


def test_a_segment_without_any_scan_and_a_sensor_that_sees_nothing() -> None:
    """Blind for twenty metres, then all beams at maximum range: dead reckoning goes on, and it is counted."""
    steps = world(0, 2, 0.002)
    owner = np.repeat(np.arange(len(steps)), np.diff(steps.offsets))
    blind = (owner >= 40) & (owner < 90)
    void = (owner >= 90) & (owner < 110)
    r = run_segslam(_with(steps, ~blind, steps.returns & ~void), GridFilterConfig(particles=10), CONFIG, SeedTree(0))
    assert r.report()["steps_without_beams"] == 50
    assert r.report()["steps_without_returns"] == 20
    assert _error(steps, r.final_pose) < 2.0
    nothing = _with(steps, np.zeros(len(owner), np.bool_))
    r = run_segslam(nothing, GridFilterConfig(particles=1), CONFIG, SeedTree(0))
    np.testing.assert_allclose(r.final_pose, _dead_reckoning(steps), atol=1e-9)
    assert r.report()["matches"] == 0


def test_too_short_a_log_is_refused() -> None:
    steps = world(0, 2)
    one = replace(
        steps,
        times=steps.times[:1],
        odometry=steps.odometry.take(slice(0, 1)),
        offsets=steps.offsets[:2],
        points=steps.points[: steps.offsets[1]],
        origins=steps.origins[: steps.offsets[1]],
        returns=steps.returns[: steps.offsets[1]],
    )
    with pytest.raises(DataError, match="too few steps"):
        run_segslam(one, GridFilterConfig(particles=2), CONFIG, SeedTree(0))
