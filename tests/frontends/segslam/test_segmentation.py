"""When a segment ends: the predictive score of known maps, and the rules on known curves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.config import build_config
from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.segslam import segmentation
from graphslam_frontends.segslam.config import SegmentationConfig, SegSlamConfig
from graphslam_frontends.segslam.segmentation import (
    Segmenter,
    gather_window,
    motion_error,
    predictive_score,
    representative_particles,
)

NAN = math.nan
UP = np.array([0.0, 0, 0, 0, 0, 0, 1])


def room(size: float = 4.0) -> EvidenceGrid:
    """A square room seen from its middle, 2-D, voxels of 0.1 m: walls at ± size."""
    grid = EvidenceGrid(0.1, dim=2)
    s = np.linspace(-size, size, 400)
    wall = np.full_like(s, size + 0.05)
    points = np.concatenate([np.stack(w, 1) for w in ((wall, s), (-wall, s), (s, wall), (s, -wall))])
    for _ in range(3):
        grid.insert_scan(points)
    return grid


def fan(n: int, ranges: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scan of n beams all round."""
    a = np.linspace(-np.pi, np.pi, n, endpoint=False) + 0.01
    points = np.stack([np.cos(a), np.sin(a)], 1) * np.broadcast_to(ranges, n)[:, None]
    return points, np.zeros_like(points), np.ones(n, bool)


def box_ranges(n: int, size: float, x: float = 0.0) -> np.ndarray:
    """Ranges of `fan` in a square room from (x, 0)."""
    a = np.linspace(-np.pi, np.pi, n, endpoint=False) + 0.01
    c, s = np.cos(a), np.sin(a)
    return np.minimum(np.where(c > 0, size - x, size + x) / np.abs(c), size / np.abs(s))


def test_windows_are_gathered_where_dead_reckoning_puts_them() -> None:
    ahead = np.array([1.0, 0, 0, 0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)])  # 1 m ahead, then 90° to the left
    p = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 50.0], [3.0, 0.0, 0.0]])
    scans = [(p, np.zeros((3, 3)), np.array([True, True, False]))] * 2
    w = gather_window(np.stack([ahead, ahead]), scans, 30.0)
    assert w.beams == 6
    assert len(w) == 2  # too long, and met nothing: left out
    np.testing.assert_allclose(w.points, [[1.0, 2.0, 0.0], [-1.0, 1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(w.origins, [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]], atol=1e-12)
    assert len(gather_window(np.stack([UP]), [(p, np.zeros((3, 3)), np.ones(3, bool))], 30.0).thinned(1)) == 1
    with pytest.raises(DataError, match="one increment for each scan"):
        gather_window(np.stack([ahead]), scans, 30.0)


def test_the_score_is_the_share_of_beams_the_map_foretells() -> None:
    grid, n = room(), 72
    half = fan(n, np.where(np.arange(n) < n // 2, box_ranges(n, 4.05), 2.0))  # half of the beams meet something new
    w = gather_window(np.zeros((1, 3)), [half], 20.0)
    score = predictive_score([grid, grid.empty()], np.zeros((2, 3)), w, 20.0, weights=[3.0, 1.0])
    assert score.shares[1] == 0.0
    assert score.shares[0] == pytest.approx(0.5, abs=0.03)  # some walls are within 0.6 m of 2 m: none here
    assert score.share == pytest.approx(0.75 * score.shares[0])
    # clipped at 3 σ: half of the beams have -4.5, those of the empty map all
    assert score.log_likelihoods[1] == pytest.approx(-4.5)
    assert score.log_likelihoods[0] == pytest.approx(-2.25, abs=0.1)
    assert score.beams == n


def test_the_score_is_that_of_small_steps_along_each_beam() -> None:
    grid, rng = room(), np.random.default_rng(3)
    poses = np.array([[0.0, 0.0, 0.0], [0.4, -0.3, 0.5], [1.0, 1.0, -2.0]])
    w = gather_window(np.array([[0.2, 0.0, 0.1]]), [fan(20, rng.uniform(2.0, 6.0, 20))], 20.0)
    score = predictive_score([grid] * 3, poses, w, 20.0, tolerance=0.4)
    for pose, share in zip(poses, score.shares):
        near = 0
        for p, o in zip(w.points, w.origins):
            R = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
            origin, target = R @ o + pose[:2], R @ p + pose[:2]
            expected = _march(grid, origin, target - origin)
            near += abs(expected - float(np.linalg.norm(p - o))) <= 0.4
        assert share == pytest.approx(near / 20, abs=0.051)  # a beam along the edge of the tolerance


def _march(grid: EvidenceGrid, origin: np.ndarray, ray: np.ndarray) -> float:
    """Range to the first occupied voxel by small steps; inf if there is none."""
    s = np.arange(0.0, 21.0, 0.004)
    hit = grid.occupied_at(origin + s[:, None] * ray / np.linalg.norm(ray))
    return float(s[np.argmax(hit)]) + 0.05 if hit.any() else math.inf


def test_no_beams_no_score() -> None:
    p, o, _ = fan(8, 3.0)
    w = gather_window(np.zeros((1, 3)), [(p, o, np.zeros(8, bool))], 20.0)
    assert len(w) == 0
    assert w.beams == 8
    s = predictive_score([room()], np.zeros((1, 3)), w, 20.0)
    assert math.isnan(s.share)
    assert s.beams == 0
    assert not Segmenter(SegmentationConfig(), 0.0).decide(30.0, 30.0, score=s.share).ends


def test_two_threads_give_the_same_score() -> None:
    grid = room()
    poses = np.random.default_rng(0).normal(0, 0.3, (5, 3))
    w = gather_window(np.zeros((1, 3)), [fan(60, 4.0)], 20.0)
    a, b = (predictive_score([grid] * 5, poses, w, 20.0, threads=k) for k in (1, 2))
    np.testing.assert_array_equal(a.shares, b.shares)
    np.testing.assert_array_equal(a.log_likelihoods, b.log_likelihoods)


def _run(config: SegmentationConfig, scores: dict[float, float], until: float = 100.0, speed: float = 1.0) -> list:  # type: ignore[type-arg]
    """Decisions every 2 s at a steady speed; times and reasons of those that end a segment."""
    s, cuts, level = Segmenter(config, 0.0), [], 0.7
    for t in np.arange(0.0, until, 2.0):
        level = scores.get(float(t), level)
        d = s.decide(float(t), speed * float(t), score=level, again=True)
        if d.ends:
            cuts.append((float(t), d.why))
            s.begin(float(t), speed * float(t))
    return cuts


def test_a_segment_ends_where_the_score_drops() -> None:
    config = SegmentationConfig()
    assert _run(config, {30.0: 0.44, 32.0: 0.7}) == [(30.0, "score"), (90.0, "max-length")]
    assert _run(config, {30.0: 0.46, 32.0: 0.7}, 60.0) == []  # above 0.45, and above 0.65 · 0.7 = 0.455
    assert _run(config, {20.0: 0.79, 22.0: 0.7, 30.0: 0.51, 32.0: 0.7}, 60.0) == [(30.0, "relative-score")]
    assert _run(config, {20.0: 0.79, 22.0: 0.7, 30.0: 0.52, 32.0: 0.7}, 60.0) == []
    # the maximum is that of this segment: after a cut 0.9 is forgotten
    assert _run(config, {14.0: 0.9, 16.0: 0.4, 18.0: 0.5, 34.0: 0.46, 36.0: 0.5}, 60.0) == [(16.0, "score")]


def test_a_young_segment_does_not_end_and_its_first_scores_do_not_count() -> None:
    config = SegmentationConfig()
    s = Segmenter(config, 0.0)
    assert not s.wants_score(4.0)
    assert s.wants_score(5.0)
    d = s.decide(4.0, 12.0, score=0.1)
    assert (d.ends, d.why) == (False, "")
    assert math.isnan(d.best_score)
    d = s.decide(11.9, 12.0, score=0.1)
    assert (d.ends, d.why) == (False, "young")
    d = s.decide(12.0, 8.9, score=0.1)
    assert (d.ends, d.why) == (False, "short")
    assert s.decide(12.0, 9.0, score=0.1).ends
    # a high score of the first seconds is no maximum to fall short of
    s.begin(0.0, 0.0)
    s.decide(3.0, 3.0, score=1.0)
    assert not s.decide(20.0, 20.0, score=0.6).ends


def test_without_drops_segments_have_their_maximum_size() -> None:
    assert [t for t, _ in _run(SegmentationConfig(max_length=20.0), {})] == [20.0, 40.0, 60.0, 80.0]
    assert _run(SegmentationConfig(max_seconds=30.0), {}, 70.0) == [(30.0, "max-seconds"), (60.0, "max-seconds")]
    # a robot that stands still cuts nothing, whatever it sees and however long
    assert _run(SegmentationConfig(max_seconds=30.0), {20.0: 0.1}, speed=0.01) == []


def test_ground_that_the_map_foretells_does_not_count_for_the_maximum_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """A corridor of 12 s out and 12 s back, 1 m/s: the way back is known, so the segment goes on into the next."""
    config = SegmentationConfig(max_length=20.0, relative_score=0.0)
    there = {0.0: 0.7, 14.0: 0.9, 26.0: 0.7}
    # 12 m out; the decisions at 14 … 24 s look back on known ground; 8 m more are driven by 32 s
    assert _run(config, there, 34.0) == [(32.0, "max-length")]
    with monkeypatch.context() as patch:
        patch.setattr(segmentation, "KNOWN_SCORE", 2.0)  # no ground is known
        assert _run(config, there, 34.0) == [(20.0, "max-length")]
    s = Segmenter(config, 0.0, 5.0)
    assert s.decide(2.0, 7.0, score=0.95).new_ground == pytest.approx(2.0)  # too early for a score to say anything
    assert s.decide(6.0, 11.0, score=0.95, again=True).new_ground == pytest.approx(2.0)
    assert s.copy().decide(8.0, 13.0, score=0.95).new_ground == pytest.approx(4.0)  # nowhere near its path
    assert s.decide(8.0, 13.0, score=NAN, again=True).new_ground == pytest.approx(4.0)
    assert s.copy().decide(10.0, 15.0, score=0.7).new_ground == pytest.approx(6.0)
    assert s.new_ground == pytest.approx(4.0)
    s.begin(8.0, 13.0)
    assert s.decide(10.0, 16.0).new_ground == pytest.approx(3.0)


def test_leaving_known_ground_is_no_drop() -> None:
    """0.58 after 0.95 is below 0.65 of the maximum, but the maximum is that of a way driven twice."""
    s = Segmenter(SegmentationConfig(), 0.0)
    s.decide(20.0, 20.0, score=0.95, again=True)
    d = s.decide(22.0, 22.0, score=0.58)
    assert (d.ends, d.best_score) == (False, 0.8)
    assert s.decide(24.0, 24.0, score=0.51).why == "relative-score"  # below 0.65 · 0.8
    s = Segmenter(SegmentationConfig(), 0.0)
    s.decide(20.0, 20.0, score=0.95)  # a map that foretells new ground so well must go on doing so
    assert s.decide(22.0, 22.0, score=0.58).why == "relative-score"


def test_periods_and_motion_error() -> None:
    assert _run(SegmentationConfig(period=20.0), {30.0: 0.0}, 50.0) == [(20.0, "period"), (40.0, "period")]
    config = SegmentationConfig(score=0.0, relative_score=0.0, motion_translation=0.05 / 0.999)
    assert _run(config, {}, 50.0) == [(20.0, "motion-error"), (40.0, "motion-error")]
    s = Segmenter(SegmentationConfig(motion_translation=0.02, motion_rotation=0.2), 10.0, 5.0, 1.0)
    assert s.decide(30.0, 25.0, turned=3.9).error == pytest.approx(0.02 * 20 + 0.2 * 2.9)
    assert not s.decide(30.0, 25.0, turned=3.9).ends
    assert s.decide(30.0, 25.0, turned=4.1).why == "motion-error"


def test_motion_error_adds_up_and_may_depend_on_the_state() -> None:
    np.testing.assert_allclose(motion_error([1.0, 1.0, 2.0], [0.0, -0.5, 0.0], 0.1, 1.0), [0.1, 0.7, 0.9])
    np.testing.assert_allclose(motion_error([1.0, 1.0], [0.0, 0.0], [0.1, 0.5], 1.0), [0.1, 0.6])


def test_decisions_come_at_their_rate_and_copies_go_their_own_way() -> None:
    s = Segmenter(SegmentationConfig(every=2.0), 0.0)
    assert not s.due(1.9)
    assert s.due(2.0)
    s.decide(2.0, 2.0, score=0.9)
    assert not s.due(3.6)
    twin = s.copy()
    twin.decide(8.0, 8.0, score=0.8)
    assert twin.best == 0.8
    assert math.isnan(s.best)
    with pytest.raises(GeometryError, match="backwards"):
        s.decide(-1.0, 3.0)
    with pytest.raises(GeometryError, match="backwards"):
        s.decide(NAN, 3.0)


def test_configurations_are_checked_and_built_from_tables() -> None:
    c = build_config(
        SegSlamConfig, {"segmentation": {"period": 20}, "winnowing": {"gap": 30.0}, "search": {"grid": 0.4}}
    )
    assert (c.segmentation.period, c.winnowing.gap, c.search.grid) == (20.0, 30.0, 0.4)
    assert c.winnowing.drift(100.0) == pytest.approx(4.5)
    assert c.search.yaw_width(1000.0) == 0.8
    for bad in (
        {"segmentation": {"score": 1.5}},
        {"segmentation": {"window": 0.0}},
        {"segmentation": {"min_length": 70.0}},
        {"segmentation": {"decide": "always"}},
        {"winnowing": {"sigma": 0.0}},
        {"winnowing": {"gap": NAN}},
        {"choice": {"null_weight": 0.0}},
        {"choice": {"method": "vote"}},
        {"localisation": {"particles": 99}},
        {"handover": {"drift_scale": 0.0}},
        {"search": {"grids": 1.0}},
    ):
        with pytest.raises(ConfigError):
            build_config(SegSlamConfig, bad)


def test_se3_windows_score_in_three_dimensions() -> None:
    grid = EvidenceGrid(0.2)
    rng = np.random.default_rng(1)
    d = rng.normal(size=(3000, 3))
    points = 5.0 * d / np.abs(d).max(axis=1, keepdims=True)  # a cube around the origin
    grid.insert_scan(points)
    tilted = np.concatenate([[0.5, 0.2, 0.1], se3.so3_exp([0.1, -0.1, 0.4])])
    seen = se3.se3_transform(np.broadcast_to(se3.se3_inverse(tilted), (200, 7)), points[:200])
    scan = seen, np.zeros((200, 3)), np.ones(200, bool)
    w = gather_window(UP[None], [scan], 20.0)
    assert predictive_score([grid], tilted[None], w, 20.0).share > 0.97
    assert predictive_score([grid], UP[None], w, 20.0).share < 0.75


def test_few_particles_speak_for_all() -> None:
    rng = np.random.default_rng(3)
    w = rng.dirichlet(np.full(40, 0.3))
    rows, shares = representative_particles(w, 8)
    assert len(rows) <= 8
    assert shares.sum() == pytest.approx(1.0)
    assert np.all(np.diff(rows) > 0)
    # nobody speaks for more than its own weight and what lies within an eighth of it
    assert np.all(np.abs(shares - w[rows]) <= 2.0 / 8)
    x = np.sort(rng.normal(size=40))  # what changes slowly from one to the next is told well
    assert abs(shares @ x[rows] - w @ x) < 0.5 * x.std()
    everybody, same = representative_particles(w, 40)
    np.testing.assert_array_equal(everybody, np.arange(40))
    np.testing.assert_array_equal(same, w)
    alone, all_of_it = representative_particles(np.array([0.0, 1.0, 0.0]), 2)
    assert alone.tolist() == [1]
    assert all_of_it.tolist() == [1.0]
