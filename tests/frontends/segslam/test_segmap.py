"""The SegMap: what fits together in time, what is dropped, and that dropped maps give their storage back."""

from __future__ import annotations

import gc
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam_frontends.segslam.segmap import MATCH, NEW, SAME, SegMap, SegmentEntry
from tests.reference.segmap_twin import PlainSegMap, flat_grid, mark, marked, match_entry, small_segmap, straight

ZERO = np.zeros(3)


def _new(T: np.ndarray = ZERO) -> SegmentEntry:
    return SegmentEntry(T_entry=T)


def test_a_particle_goes_out_and_comes_back_into_its_first_map() -> None:
    pool = GridPool(levels=3)
    m = small_segmap(7, 1)
    assert m.open(0, [_new()]) == [None]
    grid = flat_grid(pool)
    mark(grid, 0, 0)
    first = m.close(2, [grid], [straight(ZERO, 2.0, 2)])
    assert first.tolist() == [0]
    m.open(2, [_new()])
    other = flat_grid(pool)
    mark(other, 9, 9)
    m.close(4, [other], [straight(ZERO, 2.0, 2)])
    (again,) = m.open(4, [match_entry(np.array([0.5, 0.0, np.pi]), 0)])
    assert again is not None
    assert marked(again) == {(0, 0)}
    mark(again, 1, 1)
    m.close(6, [again], [straight(np.array([0.5, 0.0, np.pi]), 2.0, 2)], [1.0])
    assert marked(m.map_of(0)) == {(0, 0)}  # what was entered is as it was
    assert marked(m.map_of(2)) == {(0, 0), (1, 1)}
    s = m[2]
    assert (s.kind, s.source, s.previous, s.interval) == ("match", 0, 1, (4, 6))
    assert (s.t_start, s.t_end, s.length, s.weight, s.fitness) == (4.0, 6.0, 2.0, 1.0, 0.9)
    np.testing.assert_allclose(s.T_exit, [-1.5, 0.0, np.pi], atol=1e-12)
    assert m.chain(2).tolist() == [0, 1, 2]
    assert m.intervals().tolist() == [[0, 2], [2, 4], [4, 6]]
    (same,) = m.open(6, [SegmentEntry(T_entry=m[2].T_exit, kind=SAME, source=2)])
    assert same is not None
    assert marked(same) == {(0, 0), (1, 1)}


def test_all_that_end_at_a_boundary_fit_all_that_begin_there() -> None:
    m = small_segmap(5, 3)
    for begin in (0, 2):
        m.open(begin, [_new()] * 3)
        m.close(begin + 2, [flat_grid() for _ in range(3)], [straight(ZERO, 1.0 + p, 2) for p in range(3)])
    assert m.ending_at(2).tolist() == [0, 1, 2]
    assert m.beginning_at(2).tolist() == [3, 4, 5]
    assert m.in_interval((2, 4)).tolist() == [3, 4, 5]
    assert m.prune() == 0  # particle 0's first segment may be followed by particle 2's second


def test_copies_share_one_segment_with_their_summed_weight() -> None:
    m = small_segmap(3, 3)
    m.open(0, [_new()] * 3)
    m.resample([1, 1, 2])
    path = [straight(ZERO, 1.0, 2), straight(ZERO, 1.0, 2), straight(ZERO, 2.0, 2)]
    out = m.close(2, [flat_grid() for _ in range(3)], path, [1.0, 2.0, 1.0])
    assert out.tolist() == [0, 0, 1]
    assert m.table.weight[:2].tolist() == [0.75, 0.25]


def test_segments_that_lead_nowhere_are_dropped_with_their_maps() -> None:
    """Particles decide for themselves: 0 cuts at 2, 1 at 3. Particle 1 dies, and nothing follows its first segment."""
    pool = GridPool(levels=3)
    m = small_segmap(9, 2)
    m.open(0, [_new()] * 2)
    grids = [flat_grid(pool), flat_grid(pool)]
    mark(grids[0], 0, 0)
    mark(grids[1], 50, 50)
    m.close(2, [grids[0]], [straight(ZERO, 2.0, 2)], which=[0])
    m.open(2, [_new()], which=[0])
    m.close(3, [grids[1]], [straight(ZERO, 3.0, 3)], which=[1])
    m.open(3, [_new()], which=[1])
    del grids
    assert m.prune() == 0
    used = pool.used_bricks
    m.resample([0, 0])
    assert m.prune() == 1
    assert m.alive.tolist() == [0]
    assert m.pruned == 1
    assert pool.used_bricks < used
    with pytest.raises(DataError, match="segment 1 was pruned"):
        m[1]
    with pytest.raises(DataError, match="no such segment"):
        m[7]


def test_a_dead_end_of_two_segments_goes_at_once() -> None:
    """Particle 1 cuts at 3 and at 5 and dies: what ends at 3 leads only to what leads nowhere."""
    m = small_segmap(9, 2)
    m.open(0, [_new()] * 2)
    m.close(2, [flat_grid()], [straight(ZERO, 2.0, 2)], which=[0])
    m.open(2, [_new()], which=[0])
    for a, b in ((0, 3), (3, 5)):
        m.close(b, [flat_grid()], [straight(ZERO, 1.0, b - a)], which=[1])
        m.open(b, [_new()], which=[1])
    assert m.prune() == 0
    m.resample([0, 0])
    assert m.prune() == 2
    assert m.alive.tolist() == [0]


def _pair() -> SegMap:
    """Two segments, one after the other."""
    m = small_segmap(9, 1)
    for a, b in ((0, 2), (2, 4)):
        m.open(a, [_new()])
        m.close(b, [flat_grid()], [straight(ZERO, 1.0, 2)])
    return m


def test_impossible_entries_and_exits_are_refused() -> None:
    m = small_segmap(6, 2)
    with pytest.raises(DataError, match="leaves a segment that it never entered"):
        m.close(2, [flat_grid()], [straight(ZERO, 1.0, 2)], which=[0])
    with pytest.raises(DataError, match="entries do not belong"):
        m.open(0, [_new()])
    with pytest.raises(DataError, match="outside the path"):
        m.open(6, [_new()] * 2)
    with pytest.raises(GeometryError, match="no pose"):
        m.open(0, [_new(), _new(np.array([0.0, np.nan, 0.0]))])
    with pytest.raises(DataError, match="no such segment"):
        m.open(0, [_new(), match_entry(ZERO, 3)])
    with pytest.raises(DataError, match="enters impossibly"):
        m.open(0, [_new(), SegmentEntry(T_entry=ZERO, kind=MATCH)])
    m.open(0, [_new()] * 2)  # what was refused left nothing behind
    with pytest.raises(DataError, match="before it left"):
        m.open(0, [_new()] * 2)
    grids = [flat_grid(), flat_grid()]
    good = straight(ZERO, 1.0, 2)
    with pytest.raises(GeometryError, match="frame of the segment before"):
        m.close(2, grids, [good, good + [1.0, 0.0, 0.0]])
    with pytest.raises(GeometryError, match="impossible"):
        m.close(2, grids, [good, good[:2]])
    with pytest.raises(GeometryError, match="impossible weights"):
        m.close(2, grids, [good, good], [1.0, -1.0])
    with pytest.raises(DataError, match="empty"):
        m.close(0, grids, [good[:1]] * 2)
    with pytest.raises(DataError, match="ancestors"):
        m.resample([0, 2])
    assert len(m) == 0
    m.close(2, grids, [good, good + 1e-9])
    with pytest.raises(DataError, match="elsewhere"):
        m.open(3, [_new()] * 2)
    with pytest.raises(CovarianceError, match="without a covariance"):
        m.open(2, [SegmentEntry(T_entry=ZERO, kind=MATCH, source=0)] * 2)
    with pytest.raises(CovarianceError, match="not positive definite"):
        m.open(2, [SegmentEntry(T_entry=ZERO, kind=MATCH, source=0, covariance=np.zeros((3, 3)))] * 2)
    with pytest.raises(GeometryError):
        SegMap(np.arange(3.0), [0.0, 1.0, 0.5], 1)
    with pytest.raises(DataError):
        SegMap([0.0, 0.0], [0.0, 1.0], 1)


def test_a_description_is_json_and_the_same_for_the_same_history() -> None:
    def text() -> str:
        m = _pair()
        m.open(4, [match_entry(ZERO, 0)])
        m.close(5, [flat_grid()], [straight(ZERO, 1.0, 1)])
        return json.dumps(m.describe(), allow_nan=False)

    d = json.loads(text())
    assert text() == text()
    assert [s["kind"] for s in d["segments"]] == ["new", "new", "match"]
    assert d["intervals"] == [[0, 2], [2, 4], [4, 5]]
    assert d["matches"] == 1


OPS = st.one_of(
    st.tuples(st.just("advance"), st.integers(0, 2)),
    st.tuples(st.just("resample"), st.lists(st.integers(0, 2), min_size=3, max_size=3)),
    st.tuples(st.just("cut"), st.lists(st.integers(0, 3), min_size=3, max_size=3), st.integers(0, 99)),
    st.tuples(st.just("prune")),
)


@settings(max_examples=20, deadline=None)
@given(ops=st.lists(OPS, min_size=1, max_size=25), seed=st.integers(0, 2**16))
def test_any_history_gives_what_the_plain_twin_has(ops: list[tuple], seed: int) -> None:  # type: ignore[type-arg]
    rng = np.random.default_rng(seed)
    pool, n, steps = GridPool(levels=3), 3, 80
    m, twin = small_segmap(steps, n), PlainSegMap(n)
    now = 0
    made: EvidenceGrid | None = None
    grids = [flat_grid(pool) for _ in range(n)]
    m.open(0, [_new()] * n)
    paths = [[ZERO] for _ in range(n)]
    for p in range(n):
        twin.open(p, 0, NEW, -1, ZERO)

    def advance(by: int) -> None:
        nonlocal now
        for _ in range(by + 1):
            now += 1
            for p in range(n):
                pose = rng.normal(size=3)
                paths[p].append(pose)
                mark(grids[p], now, p)
                twin.advance(p, (now, p), pose)

    for op in ops:
        if op[0] == "advance":
            advance(op[1])
        elif op[0] == "resample":
            m.resample(op[1])
            twin.resample(op[1])
            grids, paths = [grids[a].copy() for a in op[1]], [list(paths[a]) for a in op[1]]
        elif op[0] == "cut":
            which = [p for p in range(n) if op[1][p] and now > m.start[p]]
            w = np.full(n, 1 / n)
            out = m.close(now, [grids[p] for p in which], [np.stack(paths[p]) for p in which], w, which)
            assert out.tolist() == twin.close(which, now, 1 / n)
            for p in which:
                kind, source, T = NEW, -1, rng.normal(size=3)
                living = m.alive
                if op[1][p] == 2:
                    kind, source = MATCH, int(living[op[2] % len(living)])
                elif op[1][p] == 3:
                    kind, source = SAME, int(m.previous[p])
                entry = match_entry(T, source) if kind == MATCH else SegmentEntry(T_entry=T, kind=kind, source=source)
                (made,) = m.open(now, [entry], [p])
                grids[p] = flat_grid(pool) if made is None else made
                paths[p] = [T]
                twin.open(p, now, kind, source, T)
        else:
            assert m.prune() == twin.prune()
    assert len(m) == len(twin.segments)
    assert m.alive.tolist() == [i for i, s in enumerate(twin.segments) if s["alive"]]
    for i in m.alive.tolist():
        s, t = m[i], twin.segments[i]
        assert (s.interval, s.source, s.previous) == ((t["start"], t["end"]), t["source"], t["previous"])
        assert s.weight == pytest.approx(t["weight"])
        np.testing.assert_array_equal(s.path, np.stack(t["path"]))
        assert marked(m.map_of(i)) == t["scans"]
        assert m.ending_at(s.interval[0]).tolist() == [j for j in m.alive.tolist() if twin.compatible(j, i)]
    # whoever kept a map gives it back: nothing of the pool is left in use
    assert (pool.used_bricks > 0) == (now > 0)
    m._release(m.alive)
    grids.clear()
    made = None
    gc.collect()
    assert pool.used_bricks == 0
    assert pool.used_nodes == 0
