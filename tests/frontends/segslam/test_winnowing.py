"""Which segments are worth matching: old enough, near enough, and their maps know the place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graphslam.core.geometry import se2_between, se2_compose
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.segslam.candidate_selection import CandidateSelection, SegmentCandidates
from graphslam_frontends.segslam.candidate_selection import select_candidates as winnow_all
from graphslam_frontends.segslam.config import SegmentCandidateConfig
from graphslam_frontends.segslam.sampling import MapSample, grow_sample, root_of_particle, root_of_segment
from graphslam_frontends.segslam.segmap import SegMap, SegmentEntry
from tests.reference.segmap_twin import match_entry, straight

SIDE = 20.0  # metres of a side, a step a metre


def winnow(segmap: SegMap, sample: MapSample, body: np.ndarray, *rest: Any, **more: Any) -> SegmentCandidates:
    """Of one particle."""
    return winnow_all(segmap, sample, body[None], *rest, **more)[0]


def seen_around(path: np.ndarray, dim: int = 2) -> EvidenceGrid:
    """A map that knows everything within 3 m of a path, voxels of 0.5 m."""
    grid = EvidenceGrid(0.5, dim=dim)
    a = np.linspace(-np.pi, np.pi, 90)
    ring = 3.0 * np.stack([np.cos(a), np.sin(a), 0 * a][:dim], 1)
    for p in path[::2]:
        grid.insert_scan(ring + p[:dim], origin=p[:dim] + 0.01)
    return grid


def block(drift: float = 0.0) -> SegMap:
    """Once around a square block and on along the first side; each turn is ``drift`` [rad] too small."""
    n = int(4.5 * SIDE)
    m = SegMap(np.arange(n + 1.0), np.arange(n + 1.0), 1, dim=2)
    for k in range(4):
        path = straight(np.zeros(3), SIDE, int(SIDE))
        path[-1, 2] = np.pi / 2 - drift
        m.open(int(k * SIDE), [SegmentEntry(T_entry=np.zeros(3))])
        m.close(int((k + 1) * SIDE), [seen_around(path)], [path])
    m.open(int(4 * SIDE), [SegmentEntry(T_entry=np.zeros(3))])
    return m


def _sample(m: SegMap, step: int) -> MapSample:
    return grow_sample(m, root_of_particle(m, 0, step), np.random.default_rng(0))


def _plain(
    m: SegMap, sample: MapSample, body: np.ndarray, step: int, c: SegmentCandidateConfig
) -> dict[int, tuple[float, float]]:
    """Segment by segment, pose by pose: distance and way of those near enough and old enough."""
    out = {}
    for k, i in enumerate(sample.segments.tolist()):
        if i < 0 or m.times[step] - m.times[sample.intervals[k, 1]] < c.gap:
            continue
        best = None
        for s, pose in enumerate(m[i].path):
            here = se2_compose(sample.poses[k], pose)
            d = float(np.hypot(*(here[:2] - body[:2])))
            arc = sample.travelled[k] + abs(m.path_length[sample.intervals[k, 0] + s] - m.path_length[sample.anchor[k]])
            z = d / (c.sigma + c.sigma_per_metre * arc)
            if z <= c.sigmas and (best is None or z < best[0]):
                best = (z, d, arc)
        if best is not None:
            out[i] = best[1:]
    return out


@pytest.mark.parametrize("drift", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("along", [1, 6])
def test_candidates_are_those_of_a_plain_search(drift: float, along: int) -> None:
    m, step = block(drift), int(4 * SIDE) + along
    sample, body, c = _sample(m, step), np.array([float(along), 0.0, 0.0]), SegmentCandidateConfig(gap=25.0, keep=9)
    found = winnow(m, sample, body, step, c)
    plain = _plain(m, sample, body, step, c)
    assert set(found.segments.tolist()) == set(plain)
    for k, i in enumerate(found.segments.tolist()):
        assert (found.distance[k], found.travelled[k]) == pytest.approx(plain[i])
        assert found.sigma[k] == pytest.approx(0.5 + c.sigma_per_metre * plain[i][1])
        place = sample.segments.tolist().index(i)
        np.testing.assert_allclose(found.T_map_body[k], se2_between(sample.poses[place], body), atol=1e-12)
    z = found.distance / found.sigma
    assert np.all(np.diff(z) >= 0)


def test_the_way_round_decides_what_may_have_drifted() -> None:
    m, step = block(), int(4 * SIDE) + 5
    found = winnow(m, _sample(m, step), np.array([5.0, 0.0, 0.0]), step, SegmentCandidateConfig(gap=25.0))
    assert found.segments[0] == 0
    assert found.distance[0] == pytest.approx(0.0, abs=1e-9)
    assert found.travelled[0] == pytest.approx(4 * SIDE)  # all around, to the nearest pose
    # one that re-entered the first map has driven five metres since, not eighty
    m.resample([0])
    m.close(step, [seen_around(straight(np.zeros(3), 5.0, 5))], [straight(np.zeros(3), 5.0, 5)])
    m.open(step, [match_entry(np.array([5.0, 0.0, 0.0]), 0)])
    found = winnow(m, _sample(m, step + 3), np.array([8.0, 0.0, 0.0]), step + 3, SegmentCandidateConfig(gap=25.0))
    assert found.segments[0] == 0
    assert found.travelled[0] == pytest.approx(3.0 + 3.0)  # on from the closure, and along the old path
    assert found.sigma[0] < 0.8


def test_recent_far_and_unknown_places_are_counted_out() -> None:
    m, step = block(), int(4 * SIDE) + 5
    sample, body = _sample(m, step), np.array([5.0, 0.0, 0.0])
    tally = CandidateSelection()
    found = winnow(m, sample, body, step, SegmentCandidateConfig(gap=25.0, sigma_per_metre=0.001), tally=tally)
    assert found.segments.tolist() == [0]
    assert (tally.recent, tally.far, tally.unknown, tally.surplus) == (1, 2, 0, 0)
    # the last side ended 5 s ago; with a longer gap the third is recent as well
    assert len(winnow(m, sample, body, step, SegmentCandidateConfig(gap=86.0))) == 0
    # off the sampled path by more than 2.5 σ, or where nothing is known
    c = SegmentCandidateConfig(gap=25.0, sigma_per_metre=0.001)
    assert len(winnow(m, sample, np.array([5.0, -1.4, 0.0]), step, c)) == 1
    assert len(winnow(m, sample, np.array([5.0, -1.6, 0.0]), step, c)) == 0
    tally = CandidateSelection()
    many = SegmentCandidateConfig(gap=25.0, sigma_per_metre=0.001, known=10**6)
    assert len(winnow(m, sample, body, step, many, tally=tally)) == 0
    assert tally.unknown == 1
    assert len(winnow(m, sample, body, step, c, exclude={0})) == 0
    few, tally = SegmentCandidateConfig(gap=25.0, sigma=20.0, keep=2), CandidateSelection()
    assert len(winnow(m, sample, body, step, few, tally=tally)) == 2
    assert tally.surplus == 1
    assert isinstance(found, SegmentCandidates)


def test_a_segment_that_saw_nothing_is_no_candidate() -> None:
    m, step = block(), int(4 * SIDE) + 5
    m.maps.grids[int(m.table.map[0])] = EvidenceGrid(0.5, dim=2)
    c = SegmentCandidateConfig(gap=25.0, sigma_per_metre=0.001)
    assert len(winnow(m, _sample(m, step), np.array([5.0, 0.0, 0.0]), step, c)) == 0


def test_levels_above_each_other_are_distinguished() -> None:
    """A ramp: the second level passes over the first, 3.2 m higher."""
    n = 60
    m = SegMap(np.arange(n + 1.0), np.arange(n + 1.0), 1, dim=3)
    up = np.array([0.0, 0, 0, 0, 0, 0, 1])
    path = np.tile(up, (31, 1))
    path[:, 0] = np.minimum(np.arange(31.0), 30.0 - np.arange(31.0))  # out and back
    path[:, 2] = np.linspace(0.0, 3.2, 31)
    m.open(0, [SegmentEntry(T_entry=up)])
    m.close(30, [seen_around(path, 3)], [path])
    m.open(30, [SegmentEntry(T_entry=up)])
    sample = _sample(m, 60)
    at = np.tile(up, (2, 1))
    at[1, 2] = -3.1  # back on the first level
    c = SegmentCandidateConfig(gap=25.0, known=5)
    high, low = (winnow(m, sample, T, 60, c) for T in at)
    assert high.segments.tolist() == low.segments.tolist() == [0]
    # each finds the part of the path on its own level: the ends lie over each other
    assert high.travelled[0] < 45.0 < low.travelled[0]
    assert len(winnow(m, sample, at[0] + [0, 0, 1.7, 0, 0, 0, 0], 60, c)) == 0
    assert len(winnow(m, sample, at[0] + [0, 0, 1.5, 0, 0, 0, 0], 60, c)) == 1
    # heights drift with the way: 30 m of it since the nearest pose
    for rise, found in ((1.7, 1), (1.6 + 0.005 * high.travelled[0] + 0.05, 0)):
        moved = at[0] + [0, 0, rise, 0, 0, 0, 0]
        assert (
            len(winnow(m, sample, moved, 60, SegmentCandidateConfig(gap=25.0, known=5, height_per_metre=5e-3))) == found
        )


def test_a_closed_root_is_no_candidate_of_itself() -> None:
    m = block()
    s = grow_sample(m, root_of_segment(m, 0), np.random.default_rng(0))
    found = winnow(m, s, np.zeros(3), int(4 * SIDE), SegmentCandidateConfig(gap=0.0, sigma=50.0, keep=9))
    assert 0 not in found.segments


def test_particles_that_share_a_sample_get_what_each_gets_alone() -> None:
    m, step = block(0.05), int(4 * SIDE) + 5
    sample, c = _sample(m, step), SegmentCandidateConfig(gap=25.0, keep=3, sigma_per_metre=0.01)
    poses = np.random.default_rng(2).normal([5.0, 0.0, 0.0], [3.0, 3.0, 0.2], (12, 3))
    together, alone = CandidateSelection(), CandidateSelection()
    found = winnow_all(m, sample, poses, step, c, tally=together)
    assert len({len(f) for f in found}) > 1
    for pose, f in zip(poses, found):
        one = winnow(m, sample, pose, step, c, tally=alone)
        for name in ("segments", "T_map_body", "distance", "travelled", "sigma", "known"):
            np.testing.assert_array_equal(getattr(f, name), getattr(one, name))
    assert together == alone
    assert [len(f) for f in winnow_all(m, sample, poses, step, SegmentCandidateConfig(gap=1e6))] == [0] * 12
