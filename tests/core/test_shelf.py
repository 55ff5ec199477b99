"""Values on a shelf: bounded memory, the same values, and a file that is used again."""

from __future__ import annotations

import gc
import os
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from graphslam.core.spill_cache import CacheEntry, SpillCache, pack_array, unpack_array


def _put(shelf: SpillCache, a: np.ndarray) -> CacheEntry[np.ndarray]:
    return shelf.put(a, a.nbytes, pack_array, unpack_array)


def _many(shelf: SpillCache, count: int, size: int = 1000) -> list[CacheEntry[np.ndarray]]:
    return [_put(shelf, np.random.default_rng(k).normal(size=(size, 3))) for k in range(count)]


def test_values_come_back_as_they_were_and_no_more_than_the_room_is_held() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 40)  # of 24,000 bytes
    assert shelf.nbytes <= shelf.room
    assert sum(s.resident for s in slots) == 4
    for k in (*range(40), *np.random.default_rng(0).integers(0, 40, 100).tolist()):
        want = np.random.default_rng(k).normal(size=(1000, 3))
        assert np.array_equal(slots[k].get(), want)
        assert np.array_equal(slots[k].rows(17, 400), want[17:400])
        assert shelf.nbytes <= shelf.room


def test_what_fits_is_never_written() -> None:
    shelf = SpillCache(room=10_000_000)
    slots = _many(shelf, 40)
    assert all(s.resident for s in slots)
    assert shelf.filed == 0


def test_the_least_recently_used_goes_first() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 4)
    slots[0].get()
    more = _put(shelf, np.ones((1000, 3)))
    assert [s.resident for s in (*slots, more)] == [True, False, True, True, True]


def test_rows_are_read_without_the_rest() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 10)
    part = slots[0].rows(5, 9)
    assert not slots[0].resident
    assert np.array_equal(part, slots[0].get()[5:9])
    assert slots[0].rows(3, 3).shape == (0, 3)


def test_a_value_that_somebody_holds_is_not_made_twice() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 10)
    held = slots[0].get()
    for s in slots[1:]:
        s.get()
    assert not slots[0].resident
    assert slots[0].get() is held


def test_what_nobody_holds_is_gone_and_its_place_is_used_again() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 20)
    last = weakref.ref(slots[-1].get())
    length = shelf.filed
    del slots
    gc.collect()
    assert last() is None
    assert shelf.nbytes == 0
    again = _many(shelf, 20)
    assert shelf.filed == length
    assert np.array_equal(again[0].get(), np.random.default_rng(0).normal(size=(1000, 3)))


def test_kinds_shapes_and_what_is_empty() -> None:
    shelf = SpillCache(room=1)
    arrays = [np.arange(7, dtype=np.uint8), np.zeros((0, 3)), np.array([[True, False]]), np.float32([[1, 2], [3, 4]]).T]
    slot = shelf.put(object.__new__(_Value).of(arrays), 100, lambda v: v.arrays, lambda a: _Value().of(a))
    _put(shelf, np.ones(3))
    assert not slot.resident
    for a, b in zip(arrays, slot.get().arrays):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert np.array_equal(a, b)


class _Value:
    def of(self, arrays: list[np.ndarray]) -> _Value:
        self.arrays = arrays
        return self


def test_threads_share_it() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 30)
    wanted = [np.random.default_rng(k).normal(size=(1000, 3)) for k in range(30)]

    def look(seed: int) -> bool:
        order = np.random.default_rng(seed).integers(0, 30, 300).tolist()
        return all(np.array_equal(slots[k].get(), wanted[k]) for k in order)

    with ThreadPoolExecutor(4) as executor:
        assert all(executor.map(look, range(4)))
    assert shelf.nbytes <= shelf.room


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def refuse(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", refuse)
    return


@pytest.mark.usefixtures("full_disk")
def test_where_the_disk_is_full_values_stay_in_memory(caplog: pytest.LogCaptureFixture) -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 20)
    assert all(s.resident for s in slots)
    assert caplog.text.count("stays in memory") == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_reads_what_was_there_and_writes_elsewhere() -> None:
    shelf = SpillCache(room=100_000)
    slots = _many(shelf, 10)
    child = os.fork()
    if child == 0:
        more = [_put(shelf, np.full((1000, 3), k + 0.5)) for k in range(10)]
        same = all(
            np.array_equal(s.get(), np.random.default_rng(k).normal(size=(1000, 3))) for k, s in enumerate(slots)
        )
        os._exit(0 if same and all(np.all(m.get() == k + 0.5) for k, m in enumerate(more)) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    for k, s in enumerate(slots):
        assert np.array_equal(s.get(), np.random.default_rng(k).normal(size=(1000, 3)))
