"""Grids on a shelf: the same to everybody who asks, in memory or not, and whatever is written to them."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.spill_cache import SpillCache
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam.evidence.spilled_grid import SpilledGrid, load_spilled, packed_values, spill_grid, unpacked_values
from graphslam.evidence.views import GridView


def scanned(seed: int, dim: int = 3) -> EvidenceGrid:
    rng = np.random.default_rng(seed)
    grid = EvidenceGrid(0.2, dim=dim)
    for _ in range(4):
        directions = rng.normal(size=(400, dim))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        grid.insert_scan(directions * rng.uniform(2.0, 9.0, (400, 1)), rng.normal(size=dim))
    grid.pool.release_scratch()
    return grid


def same(a: EvidenceGrid, b: EvidenceGrid) -> bool:
    coordinates = np.array_equal(a.brick_coordinates(), b.brick_coordinates())
    return coordinates and np.array_equal(a.brick_values(), b.brick_values())


@pytest.mark.parametrize("dim", [2, 3])
def test_grids_are_the_same_from_memory_and_from_disk(dim: int) -> None:
    plain = [scanned(k, dim) for k in range(8)]
    shelf = SpillCache(room=1)  # of all of them one is in memory
    put = [spill_grid(g, shelf) for g in plain]
    points = np.random.default_rng(99).uniform(-9.0, 9.0, (500, dim))
    for a, b in zip(plain, put):
        assert isinstance(b, SpilledGrid)
        assert same(a, b)
        assert np.array_equal(a.log_odds_at(points), b.log_odds_at(points), equal_nan=True)
        assert np.array_equal(GridView(a).points(1), GridView(b).points(1))
        assert (a.entropy(), a.known_volume(), a.voxel_counts()) == (b.entropy(), b.known_volume(), b.voxel_counts())
        assert (a.dim, a.voxel_size, a.model) == (b.dim, b.voxel_size, b.model)


def test_no_more_trees_are_alive_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    alive = weakref.WeakSet[GridPool]()
    before = GridPool.__init__

    def counted(self: GridPool, *a: int) -> None:
        before(self, *a)
        alive.add(self)

    monkeypatch.setattr(GridPool, "__init__", counted)
    one = scanned(0)
    size = spill_grid(one, SpillCache()).pool.nbytes
    del one
    gc.collect()
    shelf, put, most = SpillCache(room=4 * size), [], 0
    for k in range(20):
        put.append(spill_grid(scanned(k), shelf))
        most = max(most, len(alive))
    assert most <= 6  # without a shelf it is 20
    for g in put[::3] + put:
        g.voxel_counts()
        assert len(alive) <= 6
        assert shelf.nbytes <= shelf.room


def test_files_are_the_same_bytes(tmp_path: Path) -> None:
    plain, shelf = scanned(3), SpillCache(room=1)
    put, _ = spill_grid(plain, shelf), spill_grid(scanned(4), shelf)
    plain.save(tmp_path / "a.npz")
    put.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    loaded = load_spilled(tmp_path / "a.npz")
    assert same(loaded, plain)
    assert spill_grid(loaded) is loaded


def test_who_writes_has_a_grid_of_his_own() -> None:
    shelf = SpillCache(room=1)
    put, other = spill_grid(scanned(5), shelf), spill_grid(scanned(6), shelf)
    twin, points = put.copy(), np.array([[1.0, 2.0, 0.5]])
    other.voxel_counts()  # the first is on disk now, but for the twin
    twin.insert_scan(points)
    assert same(put, scanned(5))
    assert not same(twin, put)
    assert same(spill_grid(twin, shelf), twin)
    put.insert_scan(points)
    other.voxel_counts()
    assert same(put, twin)
    assert not put.on_shelf  # type: ignore[attr-defined]


def test_two_on_disk_are_merged() -> None:
    shelf = SpillCache(room=1)
    put = [spill_grid(scanned(k), shelf) for k in range(3)]
    T = np.array([0.4, -0.2, 0.6, 0.0, 0.0, np.sin(0.2), np.cos(0.2)])
    plain = scanned(0)
    plain.merge(scanned(1), T)
    into = put[0].copy()
    into.merge(put[1], T)
    assert same(into, plain)


def test_locked_stays_locked() -> None:
    grid = scanned(7)
    grid.lock()
    assert spill_grid(grid, SpillCache()).locked
    assert not spill_grid(grid, SpillCache()).copy().locked


def test_an_empty_grid() -> None:
    shelf = SpillCache(room=1)
    put, _ = spill_grid(EvidenceGrid(0.1), shelf), spill_grid(scanned(1), shelf)
    assert len(put.brick_coordinates()) == 0
    assert put.root == 0 or put.voxel_counts().known == 0


def test_values_are_packed_without_loss() -> None:
    values = scanned(8).brick_values()
    assert np.array_equal(unpacked_values(*packed_values(values)), values)
    none = values[:0]
    assert unpacked_values(*packed_values(none)).shape == none.shape


def test_copies_of_a_spilled_grid_are_in_memory() -> None:
    grid = spill_grid(EvidenceGrid(0.1, dim=2), SpillCache())
    assert isinstance(grid, SpilledGrid)
    for made in (grid.copy(), grid.empty(), grid.empty(GridPool(grid.pool.levels))):
        assert type(made) is EvidenceGrid
        assert (made.voxel_size, made.dim) == (grid.voxel_size, grid.dim)
