"""Any sequence of what can be done to grids of one pool leaves every one of them equal to its twin."""

from __future__ import annotations

import gc
from collections import Counter

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    initialize,
    invariant,
    multiple,
    rule,
)

from graphslam.core.errors import GridError, GridLockedError
from graphslam.evidence.batch import update_grids
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_pool import assert_same, check_pool
from tests.reference.evidence_twin import EvidenceTwin, pose_matrix

VOXEL = 0.25
MODELS = (BeamModel(), BeamModel(hit=0.9, miss=0.3, clamp=(0.02, 0.98), threshold=0.7))
SEEDS = st.integers(0, 2**32 - 1)
EDGE = 64
"""Half the cube of a pool of two levels, in voxels: small, so that rays leave it and trees share much."""

STATUS = {"max": 0, "hit": 1, "inside": 2, "left": 3, "outside": 4, "unknown": 5}


def random_pose(rng: np.random.Generator, dim: int = 3) -> np.ndarray:
    """A pose a few voxels from the centre, one in four near a corner of the cube."""
    far = rng.random() < 0.25
    t = rng.uniform(-1, 1, 3) * VOXEL * (EDGE if far else 5)
    if dim == 2:
        return np.array([t[0], t[1], rng.uniform(-np.pi, np.pi)])
    q = rng.normal(size=4)
    return np.concatenate([t, q / np.linalg.norm(q)])


def random_scan(rng: np.random.Generator, dim: int = 3) -> dict:
    """A few beams: some sharing an origin, some without return, cut, not finite or of no length."""
    n = int(rng.integers(0, 9))
    origin = rng.uniform(-1, 1, (n, dim)) if rng.random() < 0.5 else rng.uniform(-1, 1, dim)
    points = origin + rng.normal(size=(n, dim)) * rng.choice([0.2, 1.5, 4.0])
    for bad in (np.nan, np.inf):
        if n and rng.random() < 0.15:
            points[rng.integers(n), rng.integers(dim)] = bad
    if n and rng.random() < 0.15:
        k = rng.integers(n)
        points[k] = np.broadcast_to(origin, points.shape)[k]
    return {
        "points": points,
        "origin": origin,
        "max_range": float(rng.uniform(0.5, 4.0)) if rng.random() < 0.5 else None,
        "returns": rng.random(n) < 0.7 if rng.random() < 0.5 else None,
    }


class Pair:
    """A grid and its twin."""

    def __init__(self, grid: EvidenceGrid, twin: EvidenceTwin) -> None:
        self.grid, self.twin = grid, twin


def assert_reports_agree(report, *twins) -> None:
    """The grids' counts are the twins', summed."""
    for name in ("rays", "not_finite", "zero_length", "outside", "cut"):
        assert getattr(report, name) == sum(getattr(t, name) for t in twins), name


class GridMachine(RuleBasedStateMachine):
    """Grids on one pool beside dictionaries."""

    pairs = Bundle("pairs")

    @initialize(target=pairs, which=st.integers(0, 1), dim=st.sampled_from([3, 3, 2]))
    def start(self, which: int, dim: int) -> Pair:
        self.pool = GridPool(levels=2)
        assert self.pool.half == EDGE
        self.model, self.dim = MODELS[which], dim
        self.living: list[Pair] = []
        return self.fresh()

    def keep(self, grid: EvidenceGrid, twin: EvidenceTwin) -> Pair:
        pair = Pair(grid, twin)
        self.living.append(pair)
        return pair

    def fresh(self) -> Pair:
        grid = EvidenceGrid(VOXEL, model=self.model, pool=self.pool, dim=self.dim)
        return self.keep(grid, EvidenceTwin(VOXEL, self.model, self.pool.half, self.dim))

    @rule(target=pairs, pair=pairs)
    def empty(self, pair: Pair) -> Pair:
        return self.keep(pair.grid.empty(), pair.twin.empty())

    @rule(target=pairs, pair=pairs, n=st.integers(1, 3))
    def copy(self, pair: Pair, n: int):
        copies = [self.keep(pair.grid.copy(), pair.twin.copy()) for _ in range(n)]
        assert all(c.grid.root == pair.grid.root and not c.grid.locked for c in copies)
        return multiple(*copies)

    @rule(pair=pairs, seed=SEEDS)
    def insert(self, pair: Pair, seed: int) -> None:
        rng = np.random.default_rng(seed)
        scan, pose = random_scan(rng, self.dim), random_pose(rng, self.dim)
        if pair.grid.locked:
            with pytest.raises(GridLockedError):
                pair.grid.insert_scan(**scan, pose=pose)
            return
        assert_reports_agree(pair.grid.insert_scan(**scan, pose=pose), pair.twin.insert_scan(**scan, pose=pose))

    @rule(seed=SEEDS, threads=st.integers(1, 3), near=st.booleans())
    def insert_into_many(self, seed: int, threads: int, near: bool) -> None:
        rng = np.random.default_rng(seed)
        chosen = [p for p in self.living if rng.random() < 0.7]
        scan, pose = random_scan(rng, self.dim), random_pose(rng, self.dim)
        poses = [pose if near else random_pose(rng, self.dim) for _ in chosen]  # near: they write to the same bricks
        report = update_grids([p.grid for p in chosen], np.array(poses), **scan, threads=threads)
        open_ones = [(p, T) for p, T in zip(chosen, poses) if not p.grid.locked]
        assert_reports_agree(report, *(p.twin.insert_scan(**scan, pose=T) for p, T in open_ones))
        assert report.locked == len(chosen) - len(open_ones)

    @rule(pair=pairs, seed=SEEDS)
    def write_bricks(self, pair: Pair, seed: int) -> None:
        rng = np.random.default_rng(seed)
        half = EDGE // 8
        all_places = np.stack(np.meshgrid(*[np.arange(-half, half)] * self.dim), -1).reshape(-1, self.dim)
        where = np.zeros((int(rng.integers(0, 6)), 3), np.int64)
        where[:, : self.dim] = rng.choice(all_places, len(where), replace=False)
        what = rng.integers(-32768, 32768, (len(where), 512)).astype(np.int16)
        for row in what:
            kind = rng.integers(4)  # uniform, all unknown, mostly unknown, anything
            if kind < 2:
                row[:] = -32768 if kind else rng.integers(-2, 3)
            elif kind == 2:
                row[rng.random(512) < 0.95] = -32768
        if self.dim == 2:
            what[:, 64:] = -32768
        if pair.grid.locked:
            with pytest.raises(GridLockedError):
                pair.grid.write_bricks(where, what)
            return
        pair.grid.write_bricks(where, what)
        pair.twin.write_bricks(where, what)

    @rule(into=pairs, what=pairs, seed=SEEDS, whole=st.booleans())
    def merge(self, into: Pair, what: Pair, seed: int, whole: bool) -> None:
        rng = np.random.default_rng(seed)
        if whole:  # whole voxels and a quarter turn: every voxel has an image on the lattice
            k, s = rng.integers(0, 4), VOXEL * rng.integers(-9, 10, 3)
            half_angle = k * np.pi / 4
            pose = np.array([*s, 0, 0, np.sin(half_angle), np.cos(half_angle)])
            pose = pose if self.dim == 3 else np.array([s[0], s[1], 2 * half_angle])
        else:
            pose = random_pose(rng, self.dim)
        if into.grid.locked:
            with pytest.raises(GridLockedError):
                into.grid.merge(what.grid, pose)
            return
        try:
            into.grid.merge(what.grid, pose)
        except GridError:
            # refused whole, and with reason: a brick of the other map comes within its own diagonal of a face
            T = pose_matrix(pose, self.dim)
            centres = 8 * VOXEL * (what.grid.brick_coordinates() + 0.5) @ T[:3, :3].T + T[:3, 3]
            assert np.abs(centres[:, : self.dim]).max() > VOXEL * (EDGE - 4 * np.sqrt(3))
            return
        into.twin.merge(what.twin, pose)

    @rule(seed=SEEDS)
    def compact(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        before = self.pool.used_nodes, self.pool.used_bricks
        report = compact_grids([p.grid for p in self.living if rng.random() < 0.7])
        assert (self.pool.used_nodes, self.pool.used_bricks) == (before[0] - report.nodes, before[1] - report.bricks)
        assert min(report.nodes, report.bricks) >= 0

    @rule(pair=pairs, seed=SEEDS)
    def look(self, pair: Pair, seed: int) -> None:
        """What a grid says of itself is what its twin says."""
        rng = np.random.default_rng(seed)
        grid, twin, pose = pair.grid, pair.twin, random_pose(rng, self.dim)
        points = rng.uniform(-3, 3, (20, self.dim))
        expected = [twin.value_at(p) for p in points]
        assert grid.values_at(points).tolist() == [-32768 if v is None else v for v in expected]
        o, d = rng.uniform(-0.5, 0.5, self.dim), rng.normal(size=(6, self.dim))
        blind, reach = bool(rng.integers(2)), float(rng.choice([1.0, 3.0, 12.0]))
        found = grid.cast(o, d, reach, pose=pose, ignore_unknown=blind, voxels=True)
        for k in range(len(d)):
            what, length, voxel = twin.cast(o, d[k], reach, pose=pose, ignore_unknown=blind)
            assert STATUS[what] == found.status[k], (what, found.status[k])
            np.testing.assert_allclose(found.ranges[k], length, atol=1e-9)
            if what in ("hit", "inside"):
                assert tuple(found.voxels[k].tolist()) == voxel
        assert grid.entropy() == pytest.approx(twin.entropy(), rel=1e-12, abs=1e-300)
        np.testing.assert_allclose(sorted(map(tuple, grid.occupied_cloud())), sorted(map(tuple, twin.occupied_cloud())))
        cells = twin.binned_cloud(2, minimum=2)
        binned = grid.binned_cloud(2, minimum=2)
        assert binned.counts.tolist() == [cells[c][1] for c in sorted(cells, key=lambda c: c[::-1])]
        if cells:
            np.testing.assert_allclose(binned.points, [cells[c][0] for c in sorted(cells, key=lambda c: c[::-1])])
        low = rng.integers(-9, 3, 3)
        high = low + rng.integers(1, 9, 3)
        if self.dim == 2:
            low[2], high[2] = 0, 1
        box = twin.box(tuple(low.tolist()), tuple(high.tolist()))
        # VOXEL is a power of two, so these corners lie on the lattice exactly
        got = grid.box_query(low[None, : self.dim] * VOXEL, high[None, : self.dim] * VOXEL)
        assert (got.occupied[0], got.known[0], got.voxels[0]) == (box["occupied"], box["known"], box["all"])
        bounds = twin.bounds()
        if bounds is None:
            assert grid.bounding_box() is None
        else:
            np.testing.assert_array_equal(grid.bounding_box(), np.array(bounds)[:, : self.dim] * VOXEL)

    @rule(pair=pairs)
    def lock_or_unlock(self, pair: Pair) -> None:
        pair.grid.unlock() if pair.grid.locked else pair.grid.lock()

    @rule(pair=pairs)
    def release(self, pair: Pair) -> None:
        pair.grid.release()
        pair.twin.values.clear()
        assert pair.grid.root == 0

    @rule(pair=consumes(pairs))
    def forget(self, pair: Pair) -> None:
        self.living.remove(pair)
        del pair.grid  # the last handle dies; nobody calls release

    @invariant()
    def grids_equal_their_twins(self) -> None:
        for pair in getattr(self, "living", ()):
            assert_same(pair.grid, pair.twin)

    @invariant()
    def counts_are_right(self) -> None:
        if hasattr(self, "pool"):
            check_pool(self.pool, [p.grid for p in self.living])

    def teardown(self) -> None:
        if not hasattr(self, "pool"):
            return
        for pair in self.living:
            pair.grid.release()
        assert self.pool.used_nodes == 0
        assert self.pool.used_bricks == 0
        check_pool(self.pool, [])
        gc.collect()


@pytest.mark.parametrize(("dim", "seed"), [(3, 0), (3, 1), (2, 2)])
def test_a_long_walk(dim: int, seed: int) -> None:
    """The rules in a fixed random order, writing often to maps that share much: what hypothesis may not come to."""
    rng = np.random.default_rng(seed)
    m = GridMachine()
    m.start(which=seed % 2, dim=dim)
    steps = 120
    done: Counter[str] = Counter()
    for _ in range(steps):
        names = ["insert", "insert_into_many", "copy", "write_bricks", "merge", "compact", "look", "release", "forget"]
        name = str(rng.choice(names, p=[0.25, 0.2, 0.15, 0.08, 0.07, 0.05, 0.1, 0.05, 0.05]))
        pair = m.living[int(rng.integers(len(m.living)))]
        draw = int(rng.integers(2**32))
        if name in ("insert", "write_bricks", "look"):
            getattr(m, name)(pair=pair, seed=draw)
        elif name == "insert_into_many":
            m.insert_into_many(seed=draw, threads=draw % 3 + 1, near=draw % 5 < 3)
        elif name == "copy" and len(m.living) < 8:
            m.copy(pair=pair, n=draw % 2 + 1)
        elif name == "merge":
            m.merge(into=pair, what=m.living[draw % len(m.living)], seed=draw, whole=draw % 2 == 0)
        elif name == "compact":
            m.compact(seed=draw)
        elif name in ("release", "forget") and len(m.living) > 2:
            getattr(m, name)(pair=pair)
        else:
            m.lock_or_unlock(pair=pair)
            name = "lock"
        done[name] += 1
        m.grids_equal_their_twins()
        m.counts_are_right()
    m.teardown()
    assert len(done) == 10


TestGridMachine = GridMachine.TestCase
TestGridMachine.settings = settings(
    max_examples=15,
    stateful_step_count=20,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
