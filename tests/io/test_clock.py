"""Which records of a stream are kept."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.errors import DataError
from graphslam.core.log import DropCounter
from graphslam.io.clock import longest_increasing, usable_records


def longest_by_trying(times: list[int]) -> int:
    """Length of a longest strictly increasing subsequence, by trying all of them."""
    return max(
        n
        for n in range(len(times) + 1)
        for c in itertools.combinations(times, n)
        if all(a < b for a, b in itertools.pairwise(c))
    )


@given(st.lists(st.integers(0, 8), max_size=9))
def test_longest_increasing_is_longest_and_increasing(times: list[int]) -> None:
    t = np.array(times, dtype=float)
    keep = longest_increasing(t)
    assert np.all(np.diff(t[keep]) > 0)
    assert keep.sum() == longest_by_trying(times)


def test_one_wild_stamp_costs_one_record() -> None:
    t = np.arange(100.0)
    for wild in (-5.0, 1e9):
        bad = t.copy()
        bad[40] = wild
        assert list(np.flatnonzero(~longest_increasing(bad))) == [40]


def test_of_equal_stamps_the_first_is_kept() -> None:
    assert list(longest_increasing(np.array([0.0, 1.0, 1.0, 2.0, 2.0, 2.0, 3.0]))) == [1, 1, 0, 1, 0, 0, 1]


def test_every_drop_is_counted_once_with_its_reason() -> None:
    t = np.arange(1000.0)
    t[10], t[20], t[30] = np.nan, 19.0, 5.5
    bad = np.zeros(1000, dtype=bool)
    bad[[10, 50, 51]] = True
    drops = DropCounter()
    keep = usable_records(t, {"value is bad": bad}, stream="s", where="file", drops=drops)
    assert sorted(np.flatnonzero(~keep)) == [10, 20, 30, 50, 51]
    assert drops.counts == {
        "s: stamp is not finite": 1,
        "s: value is bad": 2,
        "s: repeated stamp": 1,
        "s: stamp out of order": 1,
    }


def test_a_first_record_of_long_ago_is_left_out() -> None:
    t = np.concatenate([[-86_400.0], np.arange(0.0, 50.0, 0.1)])
    drops = DropCounter()
    assert list(np.flatnonzero(~usable_records(t, {}, stream="s", where="file", drops=drops))) == [0]
    assert drops.counts == {"s: first record, long before all others": 1}
    pause = np.concatenate([np.arange(0.0, 50.0, 0.1), np.arange(150.0, 200.0, 0.1)])
    assert usable_records(pause, {}, stream="s", where="file", drops=drops).all()


def test_too_many_bad_records_are_an_error() -> None:
    t = np.arange(100.0)
    drops = DropCounter()
    bad = np.arange(100) % 10 == 3
    with pytest.raises(DataError, match=r"file, first at record 3: 10 of 100 records are unusable.*value is bad"):
        usable_records(t, {"value is bad": bad}, stream="s", where="file", drops=drops)
    with pytest.raises(DataError, match="clock was set back"):
        usable_records(np.concatenate([t, t - 0.5]), {}, stream="s", where="file", drops=drops)
    with pytest.raises(DataError, match="no record"):
        usable_records(np.zeros(0), {}, stream="s", where="file", drops=drops)
    assert not drops.counts
