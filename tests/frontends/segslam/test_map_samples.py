"""Map samples: who is in them, how often, and where their frames are."""

from __future__ import annotations

from bisect import insort
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
from scipy import stats

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_compose, se2_inverse
from graphslam.core.poses import frame_between, remove_roll_pitch
from graphslam_frontends.segslam.paths import concatenate_segments
from graphslam_frontends.segslam.sampling import (
    OPEN,
    SampleRoot,
    _draw,
    _GrowingSample,
    draw_weights,
    grow_sample,
    nearest_step,
    root_of_particle,
    root_of_segment,
    segment_probabilities,
)
from graphslam_frontends.segslam.segmap import SAME, SegMap, SegmentEntry
from tests.reference.seams import find_seams
from tests.reference.segmap_twin import all_samples, flat_grid, match_entry, small_segmap, straight

ZERO = np.zeros(3)


def square(particles: int = 2) -> SegMap:
    """Four intervals of two steps, each 2 m and a quarter turn; then a match into segment 0, as particle 0 has it.

    Particle 1's segments are 0.1 m longer. Segment 2 k + p is that of particle p in interval k.
    """
    m = small_segmap(12, particles)
    for k in range(4):
        m.open(2 * k, [SegmentEntry(T_entry=ZERO)] * particles)
        paths = []
        for p in range(particles):
            path = straight(ZERO, 2.0 + 0.1 * p, 2)
            path[-1, 2] = np.pi / 2
            paths.append(path)
        m.close(2 * k + 2, [flat_grid() for _ in range(particles)], paths)
    m.open(8, [match_entry(np.array([0.2, 0.0, 0.0]), 0), *[SegmentEntry(T_entry=ZERO)] * (particles - 1)])
    return m


def test_a_sample_holds_one_segment_of_each_interval_in_its_place() -> None:
    m = square()
    sample = grow_sample(m, root_of_segment(m, 6), np.random.default_rng(0))
    assert len(sample) == 4
    assert sorted(map(tuple, sample.intervals.tolist())) == [(0, 2), (2, 4), (4, 6), (6, 8)]
    assert sample.segments[sample.in_time].tolist() == [
        int(i) for i in sorted(sample.segments, key=lambda i: int(m.table.start[i]))
    ]
    # A6: frames follow from exits and entries alone
    for k in range(1, 4):
        before, after = int(sample.segments[k]), int(sample.segments[sample.via[k]])
        T = se2_compose(sample.poses[sample.via[k]], m[after].T_entry)
        np.testing.assert_allclose(se2_compose(sample.poses[k], m[before].T_exit), T, atol=1e-12)
        assert m[before].interval[1] == m[after].interval[0]
    assert sample.depth.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(sample.travelled, [0.0, 2.0, 4.0, 6.0])
    assert sample.anchor.tolist() == [8, 6, 4, 2]


def test_a_match_places_older_segments_where_the_closure_says() -> None:
    m = square()
    step = 10
    sample = grow_sample(m, root_of_particle(m, 0, step), np.random.default_rng(1))
    assert sample.segments[0] == OPEN
    k = sample.segments.tolist().index(0)
    # one link away, in the very frame of the particle, not at the end of a chain of four
    assert sample.depth[k] == 1
    np.testing.assert_allclose(sample.poses[k], 0.0)
    # it came in at x = 0.2 m, nearest to step 0: 2 m driven since, and no more
    assert sample.anchor[k] == 0
    assert sample.travelled[k] == pytest.approx(2.0)
    # the interval after it hangs from it or from the other side, both two links away; particle 1 goes the long way
    assert sample.depth.max() == 2 + 0
    other = grow_sample(m, root_of_particle(m, 1, step), np.random.default_rng(1))
    assert other.depth.max() == 4
    assert other.travelled.max() == pytest.approx(2.0 + 6.0)


@pytest.mark.parametrize(("root", "weighted"), [("open", True), ("closed", True), ("closed", False)])
def test_samples_come_as_often_as_enumeration_says(root: str, weighted: bool) -> None:
    m = square()
    r = root_of_particle(m, 0, 9) if root == "open" else root_of_segment(m, 4)
    weights = np.array([1.0, 3.0, 2.0, 2.0, 0.0, 5.0, 1.0, 1.0]) if weighted else None
    reach = {"local_depth": 2 if root == "open" else 0}  # all intervals are there by then: no links without an end
    table = all_samples(m, r, weights=weights, **reach)
    assert sum(table.values()) == Fraction(1)
    rng = np.random.default_rng(7)
    n = 3000
    seen = Counter(tuple(sorted(grow_sample(m, r, rng, weights=weights, **reach).segments.tolist())) for _ in range(n))
    keys = sorted(k for k, v in table.items() if v > 0)
    assert set(seen) <= set(keys)
    assert stats.chisquare([seen[k] for k in keys], [n * float(table[k]) for k in keys]).pvalue > 1e-3


def test_enumeration_on_a_chain_is_the_product_of_the_choices() -> None:
    m = square()
    table = all_samples(m, root_of_segment(m, 6))
    assert len(table) == 8
    assert set(table.values()) == {Fraction(1, 8)}
    # weights 1 : 3 in the first interval
    weights = np.array([1.0, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    table = all_samples(m, root_of_segment(m, 6), weights=weights)
    assert sum(v for k, v in table.items() if 1 in k) == Fraction(3, 4)


def test_segments_that_fit_are_drawn_by_weight_or_alike_where_none_has_any() -> None:
    fits = np.array([4, 1, 3])
    weights = np.array([9.0, 1.0, 9.0, 0.0, 3.0])
    assert segment_probabilities(fits, weights).tolist() == [0.75, 0.25, 0.0]
    for none in (None, np.zeros(5)):
        np.testing.assert_allclose(segment_probabilities(fits, none), 1 / 3)


@pytest.mark.parametrize("number", [0.0, 0.3, np.nextafter(1.0, 0.0)])
def test_rounding_never_draws_a_segment_without_weight(number: float) -> None:
    """The random number may be zero, and rounded shares may sum to less than one."""

    class Fixed:
        def random(self) -> float:
            return number

    shares = np.array([0.0, *[0.1] * 6, 0.0, 0.0])
    k = _draw(np.arange(9), shares, Fixed())  # type: ignore[arg-type]
    assert k == (6 if number > 0.9 else 1 + int(6 * number))


@pytest.mark.parametrize("first", [0, 1])
def test_of_segments_with_one_boundary_in_common_only_those_that_fit_are_drawn(first: int) -> None:
    """One that begins earlier would overlap with what is there, wherever it stands in the list."""
    m = small_segmap(8, 2)
    m.open(0, [SegmentEntry(T_entry=ZERO)] * 2)
    early, late = first, 1 - first
    m.close(2, [flat_grid()], [straight(ZERO, 2.0, 2)], which=[late])
    m.open(2, [SegmentEntry(T_entry=ZERO)], which=[late])
    order = (early, late) if first == 0 else (late, early)
    for p in order:
        m.close(4, [flat_grid()], [straight(ZERO, 4.0 if p == early else 2.0, 4 if p == early else 2)], which=[p])
    m.open(4, [SegmentEntry(T_entry=ZERO)] * 2)
    lengths = Counter[int]()
    for seed in range(30):
        s = grow_sample(m, root_of_particle(m, 0, 5), np.random.default_rng(seed))
        spans = sorted(map(tuple, s.intervals.tolist()))
        assert spans in ([(0, 4), (4, 5)], [(0, 2), (2, 4), (4, 5)])
        lengths[len(s)] += 1
    assert min(lengths[2], lengths[3]) > 5
    # from the first of the short ones on: what comes after it is the other short one, never the long one
    assert sorted(map(tuple, grow_sample(m, root_of_segment(m, 0), np.random.default_rng(0)).intervals.tolist())) == [
        (0, 2),
        (2, 4),
    ]


def test_without_gravity_frames_are_whole_poses_in_both_directions() -> None:
    """Bodies roll and pitch: a frame stands where the body of both segments is one, tilted as it comes."""
    rng = np.random.default_rng(3)
    m = SegMap(np.arange(9.0), np.arange(9.0), 1, dim=3, gravity=False)
    for k in range(3):
        path = se3.se3_exp(0.4 * rng.normal(size=(3, 6)))
        m.open(2 * k, [SegmentEntry(T_entry=path[0])])
        m.close(2 * k + 2, [flat_grid(dim=3)], [path])
    m.open(6, [SegmentEntry(T_entry=se3.se3_exp(0.4 * rng.normal(size=6)))])
    for root in (root_of_segment(m, 1), root_of_segment(m, 0), root_of_particle(m, 0, 7)):
        s = grow_sample(m, root, np.random.default_rng(0))
        assert s.poses.shape == (len(s), 7)
        place = {int(i): k for k, i in enumerate(s.segments)}
        assert len(s) == 3 + (root.segment == OPEN)
        for a, b in ((0, 1), (1, 2), (2, OPEN)):
            if b not in place:
                continue
            entry = root.entry if b == OPEN else m[b].T_entry
            before = se3.se3_compose(s.poses[place[a]], m[a].T_exit)
            after = se3.se3_compose(s.poses[place[b]], entry)
            np.testing.assert_allclose(se3.se3_log(se3.se3_between(before, after)), 0.0, atol=1e-9)
        assert np.abs(s.poses[1:, 3:5]).max() > 0.05  # tilted indeed


def test_ties_are_broken_at_random() -> None:
    """The fronts from a re-entered map and from the other side meet at one interval: each of them takes it."""
    m = square()
    outcomes = set()
    for seed in range(40):
        s = grow_sample(m, root_of_particle(m, 0, 9), np.random.default_rng(seed))
        place = {tuple(i): k for k, i in enumerate(s.intervals.tolist())}
        for q in ((2, 4), (4, 6), (6, 8)):
            outcomes.add((q, tuple(s.intervals[s.via[place[q]]].tolist()), int(s.depth[place[q]])))
    # the link to the entered map is one of depth, but costs no turn
    assert outcomes == {((2, 4), (0, 2), 2), ((6, 8), (8, 9), 1), ((4, 6), (2, 4), 3), ((4, 6), (6, 8), 2)}


def test_the_same_generator_gives_the_same_sample() -> None:
    m = square()
    a, b = (grow_sample(m, root_of_particle(m, 1, 9), np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(a.segments, b.segments)
    np.testing.assert_array_equal(a.poses, b.poses)


def test_local_samples_stop_at_their_reach() -> None:
    m = square()
    root = root_of_particle(m, 1, 10)
    near = grow_sample(m, root, np.random.default_rng(0), local_length=3.0)
    # 2 m to the entry, 4 m to that of the segment before: from there it does not grow on
    assert sorted(map(tuple, near.intervals.tolist())) == [(4, 6), (6, 8), (8, 10)]
    assert len(grow_sample(m, root, np.random.default_rng(0), local_depth=1)) == 2
    assert len(grow_sample(m, root, np.random.default_rng(0))) == 5


def test_going_on_in_the_same_map_leads_to_what_it_went_on_from() -> None:
    m = small_segmap(9, 2)
    m.open(0, [SegmentEntry(T_entry=ZERO)] * 2)
    m.close(2, [flat_grid(), flat_grid()], [straight(ZERO, 1.0 + p, 2) for p in range(2)])
    m.open(2, [SegmentEntry(T_entry=m[p].T_exit, kind=SAME, source=p) for p in range(2)])
    for seed in range(10):
        for p in range(2):
            s = grow_sample(m, root_of_particle(m, p, 3), np.random.default_rng(seed))
            assert s.segments.tolist() == [OPEN, p]  # whose map it has, and no other particle's
            np.testing.assert_allclose(s.poses[1], 0.0, atol=1e-12)


def twice(weights: tuple[float, ...] = (0.25, 0.25, 0.25, 0.25)) -> SegMap:
    """A way of 2 m, driven by two particles; away; then again, when each entered the map of its own first time, 0.1 m
    off; away; and a third time, when both entered the map of segment 1.

    Segments 0, 1 in (0, 2); 2, 3 in (2, 4); 4 (enters 0), 5 (enters 1) in (4, 6); 6, 7 in (6, 8); 8, 9 (enter 1) after.
    """
    m = small_segmap(12, 2)
    for k in range(5):
        sources = {2: (0, 1), 4: (1, 1)}.get(k)
        entries = [
            SegmentEntry(T_entry=ZERO) if sources is None else match_entry(np.array([0.1, 0, 0]), i)
            for i in sources or (0, 0)
        ]
        m.open(2 * k, entries)
        grids, paths = (
            [flat_grid() for _ in range(2)],
            [straight(e.T_entry, 2.0 + 0.3 * p, 2) for p, e in enumerate(entries)],
        )
        m.close(2 * k + 2, grids, paths, weights[:2])
    m.open(10, [SegmentEntry(T_entry=ZERO)] * 2)
    return m


def test_a_place_driven_through_twice_is_one_place() -> None:
    """Segments that entered one map stand in its frame, whichever of them is reached first."""
    m = twice()
    drawn = Counter[bool]()
    for seed in range(20):
        s = grow_sample(m, root_of_segment(m, 8 + seed % 2), np.random.default_rng(seed), weights=draw_weights(m))
        place = {int(i): k for k, i in enumerate(s.segments.tolist())}
        assert len(s) == 5  # every interval has one
        assert place[1] == 1  # of the first, what was found again
        drawn[5 in place] += 1
        if 5 not in place:  # the second time it was another map that was entered
            continue
        last = 0
        np.testing.assert_array_equal(s.poses[place[1]], s.poses[last])
        np.testing.assert_array_equal(s.poses[place[5]], s.poses[last])
        # from the third visit to the first by the entered map, on to the second: not by the way between them
        assert s.via[place[1]] == last
        assert s.via[place[5]] == place[1]
        # 2 m and more to where the third visit began, 0.1 m along the way of the first: its first step is nearest
        assert s.anchor[place[5]] == 4
        assert s.travelled[place[5]] == pytest.approx(2.0)
    assert min(drawn[True], drawn[False]) > 3


def test_of_an_interval_one_segment_is_drawn_once() -> None:
    """Half of the second visits entered another map than the one at hand: they come as often as their weight says."""
    m = twice()
    n = np.full(len(m), 1.0)
    n[4], n[5] = 3.0, 1.0
    # every interval has its segment after two links: the orders of all that come later need not be tried
    table = all_samples(m, root_of_segment(m, 9), weights=n, local_depth=2)
    assert {len(k) for k in table} == {5}
    assert sum(table.values()) == Fraction(1)
    assert sum(v for k, v in table.items() if 4 in k) == Fraction(3, 4)


def test_what_was_entered_again_takes_the_weight_of_what_was_not() -> None:
    m = twice((0.75, 0.25))
    w = draw_weights(m)
    # segment 1 was entered by 8, 9 (weights 0.75 and 0.25) and by 5 (0.25); 0 by 4 (0.75)
    np.testing.assert_allclose(w, [0.75, 1.25, 0.75, 0.25, 0.75, 0.25, 0.75, 0.25, 0.75, 0.25])
    np.testing.assert_array_equal(w, _draw_weights_twin(m))
    # without the entry of 4 nothing speaks for 0; pruned segments speak for nothing
    m._release(np.array([4]))
    np.testing.assert_allclose(draw_weights(m)[:6], [0.0, 1.25, 0.75, 0.25, 0.0, 0.25])
    np.testing.assert_array_equal(draw_weights(m), _draw_weights_twin(m))
    # where nothing was entered, weights are as they are
    np.testing.assert_allclose(draw_weights(square()), square().table.weight[:8])


def _draw_weights_twin(m: SegMap) -> list[float]:
    """By recursion: what a segment has been given, if anybody in its interval has been given anything."""
    t = m.table

    def given(i: int) -> float:
        return sum(weight(j) for j in m.alive.tolist() if t.source[j] == i)

    def weight(i: int) -> float:
        if not t.alive[i]:
            return 0.0
        mates = [j for j in m.alive.tolist() if (t.start[j], t.end[j]) == (t.start[i], t.end[i])]
        return given(i) if any(given(j) > 0 for j in mates) else float(t.weight[i])

    return [weight(i) for i in range(len(m))]


def test_a_pruned_source_is_no_link() -> None:
    m = square()
    m._release(np.array([0]))
    s = grow_sample(m, root_of_particle(m, 0, 9), np.random.default_rng(0))
    assert 0 not in s.segments
    assert s.depth.max() == 4


def test_the_path_of_a_sample_is_one_trajectory() -> None:
    m = square(1)
    m.resample([0])
    open_path = straight(np.array([0.2, 0.0, 0.0]), 1.0, 2)
    s = grow_sample(m, root_of_particle(m, 0, 10), np.random.default_rng(0))
    path = concatenate_segments(m, s, open_path)
    assert path.times.tolist() == list(range(11))
    np.testing.assert_allclose(path.poses[9:], open_path[1:], atol=1e-12)
    # segment 0 is in the frame of the root: the closure is exact at the entered map
    np.testing.assert_allclose(path.poses[0], 0.0, atol=1e-12)
    # a chain without a closure is the product of its increments
    s = grow_sample(m, root_of_segment(m, 3), np.random.default_rng(0))
    path = concatenate_segments(m, s)
    first = se2_compose(se2_inverse(path.poses[0]), path.poses)
    assert path.times.tolist() == list(range(9))
    np.testing.assert_allclose(first[[2, 4, 6, 8], :2], [[2, 0], [2, 2], [0, 2], [0, 0]], atol=1e-12)
    with pytest.raises(DataError, match="wrong length"):
        concatenate_segments(m, grow_sample(m, root_of_particle(m, 0, 10), np.random.default_rng(0)), open_path[:2])
    single = small_segmap(4, 1)
    single.open(0, [SegmentEntry(T_entry=ZERO)])
    with pytest.raises(DataError, match="without any path"):
        concatenate_segments(single, grow_sample(single, root_of_particle(single, 0, 2), np.random.default_rng(0)))
    with pytest.raises(DataError, match="in no segment"):
        root_of_particle(square(), 5, 9)


def test_segments_that_overlap_in_time_are_never_in_one_sample() -> None:
    """Particles that cut at different times: 0 at 2 and 4, 1 at 3; only chains without gap or overlap come."""
    m = small_segmap(8, 2)
    m.open(0, [SegmentEntry(T_entry=ZERO)] * 2)
    m.close(2, [flat_grid()], [straight(ZERO, 2.0, 2)], which=[0])  # 0: (0, 2)
    m.open(2, [SegmentEntry(T_entry=ZERO)], which=[0])
    m.close(3, [flat_grid()], [straight(ZERO, 3.0, 3)], which=[1])  # 1: (0, 3)
    m.open(3, [SegmentEntry(T_entry=ZERO)], which=[1])
    m.close(4, [flat_grid()], [straight(ZERO, 2.0, 2)], which=[0])  # 2: (2, 4)
    m.close(4, [flat_grid()], [straight(ZERO, 1.0, 1)], which=[1])  # 3: (3, 4)
    m.open(4, [SegmentEntry(T_entry=ZERO)] * 2)
    table = all_samples(m, root_of_particle(m, 0, 5))
    assert table == {(-1, 0, 2): Fraction(1, 2), (-1, 1, 3): Fraction(1, 2)}


def test_frames_stay_level_whatever_particles_think_of_gravity() -> None:
    """Two particles differ in roll and pitch at the boundary: the body is in one place, and no frame is tilted."""
    rng = np.random.default_rng(5)

    def body(x: float, y: float, z: float, heading: float) -> np.ndarray:
        turn = se3.quat_multiply(se3.so3_exp(np.array([0, 0, heading])), se3.so3_exp([*(0.02 * rng.normal(size=2)), 0]))
        return np.concatenate([[x, y, z], turn])

    m = SegMap(np.arange(8.0), np.arange(8.0), 2, dim=3, gravity=True)
    m.open(0, [SegmentEntry(T_entry=body(0, 0, 0, 0.0)) for _ in range(2)])
    starts = [e.T_entry for e in m.entries if e is not None]
    m.close(
        2,
        [flat_grid(dim=3) for _ in range(2)],
        [np.stack([s, body(1, 0, 0, 0.3), body(2, 0, 0.1, 0.7)]) for s in starts],
    )
    m.open(2, [SegmentEntry(T_entry=body(0, 0, 0, 0.0)) for _ in range(2)])
    starts = [e.T_entry for e in m.entries if e is not None]
    m.close(
        4,
        [flat_grid(dim=3) for _ in range(2)],
        [np.stack([s, body(1, 0, 0, 0.3), body(2, 0, 0.1, 0.7)]) for s in starts],
    )
    # a match far from the origin of its frame, where a tilt would be a long lever
    source_entry = body(40.0, 30.0, 1.0, 2.0)
    cov = np.eye(6) * 1e-4
    m.open(4, [SegmentEntry(T_entry=source_entry, kind=1, source=0, covariance=cov, fitness=0.9)] * 2)
    # the sample's own arithmetic against whole poses; another particle's segment may come before the match
    seen = set()
    for seed in range(20):
        s = grow_sample(m, root_of_particle(m, 0, 5), np.random.default_rng(seed))
        assert s.segments[1] == 0
        np.testing.assert_array_equal(s.poses[1], [0, 0, 0, 0, 0, 0, 1])  # the entered map is that of the root
        i, by_root = int(s.segments[2]), s.via[2] == 0
        before, after = (source_entry, m[i].T_exit) if by_root else (m[0].T_exit, m[i].T_entry)
        T = frame_between(before, after, gravity=True)
        np.testing.assert_array_equal(remove_roll_pitch(T), T)
        seen.add((i, bool(by_root)))
        np.testing.assert_allclose(s.poses[2], T, atol=1e-12)
        np.testing.assert_allclose(se3.se3_compose(T, after)[:3], before[:3], atol=1e-12)
    assert seen == {(2, True), (3, True), (2, False), (3, False)}
    loose = frame_between(source_entry, m[2].T_exit, gravity=False)
    np.testing.assert_allclose(se3.se3_compose(loose, m[2].T_exit)[:3], source_entry[:3], atol=1e-12)
    assert np.abs(loose[3:5]).max() > 1e-3  # what levelling took out


def test_nearest_step_is_that_of_the_nearest_pose() -> None:
    m = square(1)
    assert nearest_step(m, 1, np.array([1.2, 5.0, 0.0])) == 3
    assert nearest_step(m, 0, np.array([-3.0, 0.0, 0.0])) == 0


def test_frames_without_gravity_are_whole_poses() -> None:
    rng = np.random.default_rng(2)
    m = SegMap(np.arange(9.0), np.arange(9.0), 1, dim=3, gravity=False)
    for k in range(3):
        m.open(2 * k, [SegmentEntry(T_entry=np.array([0.0, 0, 0, 0, 0, 0, 1]))])
        path = se3.se3_exp(np.cumsum(rng.normal(0.0, 0.5, (3, 6)), axis=0) * [[0], [1], [1]])
        path[0] = [0, 0, 0, 0, 0, 0, 1]
        m.close(2 * k + 2, [flat_grid(dim=3)], [path])
    s = grow_sample(m, root_of_segment(m, 2), np.random.default_rng(0))
    path = concatenate_segments(m, s)
    whole = se3.se3_compose(se3.se3_compose(m[0].T_exit, m[1].T_exit), m[2].T_exit)
    np.testing.assert_allclose(
        se3.pose_to_matrix(se3.se3_between(path.poses[0], path.poses[-1])), se3.pose_to_matrix(whole), atol=1e-12
    )
    np.testing.assert_allclose(path.poses[-1], m[2].T_exit, atol=1e-12)


def test_a_sample_has_a_seam_where_its_fronts_met() -> None:
    """The square does not close by 0.1 m a side in particle 1's segments: with them, the seam is what is missing."""
    m = square()
    root = root_of_particle(m, 0, 10)
    seen, places = set(), set()
    for seed in range(30):
        s = grow_sample(m, root, np.random.default_rng(seed))
        ((a, b, T),) = find_seams(m, s)
        at = int(s.intervals[b, 0])
        assert s.intervals[a, 1] == at
        places.add(at)
        # the four sides against the match, which says that the last corner is 0.2 m along the first side
        sides = [2.0 + 0.1 * (s.segments[k] % 2) for k in s.in_time[:4].tolist()]
        missing = np.hypot(sides[0] - sides[2] - 0.2, sides[1] - sides[3])
        assert np.hypot(*T[:2]) == pytest.approx(missing, abs=1e-9)
        path = concatenate_segments(m, s, straight(np.array([0.2, 0.0, 0.0]), 2.0, 2))
        step = 0.5 * sides[at // 2] * np.array([1.0, 0.0])
        jump = se2_compose(se2_inverse(path.poses[at]), path.poses[at + 1])[:2] - step
        np.testing.assert_allclose(np.hypot(*jump), missing, atol=1e-9)
        seen.add(round(float(missing), 6))
    assert len(seen) > 2
    assert places == {4, 6}  # on either side of where the fronts meet
    assert find_seams(m, grow_sample(m, root_of_segment(m, 6), np.random.default_rng(0))) == []


def test_free_intervals_are_those_that_overlap_none(rng: np.random.Generator) -> None:
    """Intervals in ascending lists against each with each; also touching ones, and an open root of no length."""
    m = square()
    for _ in range(50):
        at = int(rng.integers(0, 30))
        entry = m.group.identity
        root = SampleRoot(segment=OPEN, start=at, end=at, anchor=at, entry=entry, exit=None, source=-1)
        growing = _GrowingSample(m, root, lambda _: 0, 0.0, 0)
        kept = [(at, at)]
        for begin, length in zip(rng.integers(0, 30, 40).tolist(), rng.integers(1, 6, 40).tolist()):
            end = begin + length
            free = growing.free(begin, end)
            assert free == (not any(begin < e and s < end for s, e in kept))
            if free:
                kept.append((begin, end))
                insort(growing.starts, begin)
                insort(growing.ends, end)
