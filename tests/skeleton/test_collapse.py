"""Collapse of measurements into landmarks against sets that are joined one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphslam.core.errors import DataError
from graphslam.skeleton.collapse import Collapse, number_by_first_observation
from graphslam_studies.sim.laps import Laps


def joined(n: int, pairs: list[tuple[int, int]]) -> list[int]:
    """Sets of ``n`` things, by relabelling all of them at every pair; numbered by their first members."""
    of = list(range(n))
    for a, b in pairs:
        of = [of[a] if x == of[b] else x for x in of]
    names: dict[int, int] = {}
    return [names.setdefault(x, len(names)) for x in of]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_sets_are_those_of_the_pairs(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 30))
    pairs = data.draw(st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=40))
    cut = data.draw(st.integers(0, len(pairs)))
    collapse = Collapse(n)
    for block in (pairs[:cut], pairs[cut:]):
        collapse.add(np.array([a for a, _ in block], int), np.array([b for _, b in block], int))
    landmark, count = collapse.landmarks()
    wanted = joined(n, pairs)
    assert landmark.tolist() == wanted
    assert count == len(set(wanted)) == n - collapse.joined
    assert collapse.pairs == len(pairs)


def test_landmarks_of_the_world_are_its_own(laps: Laps) -> None:
    """A recognised landmark is one over all its laps, any other one a landmark of each pass."""
    landmark, count = laps.collapsed()
    c, S = laps.config, laps.shared.shape[0]
    names: dict[tuple[int, ...], int] = {}
    m = 0
    for i in range(c.poses):
        for s in range(max(0, i - c.reach + 1), i + 1):
            for j in range(c.begin):
                again = laps.shared[s % S, j] and (int(laps.met[s // S, s % S]) >> j) & 1
                name = (s % S, j) if again else (s, j, -1)
                assert landmark[m] == names.setdefault(name, len(names))
                m += 1
    assert m == len(landmark)
    assert count == len(names)


def test_labels_of_any_kind_are_numbered_by_first_observation() -> None:
    landmark, n = number_by_first_observation(np.array([7, 3, 7, 0, 3, 9]))
    assert landmark.tolist() == [0, 1, 0, 2, 1, 3]
    assert n == 4


def test_impossible_pairs_are_refused_and_nothing_of_them_is_taken() -> None:
    collapse = Collapse(4)
    for a, b in (([0, 4], [1, 1]), ([0, -1], [1, 1]), ([0], [1, 2]), ([0.5], [1.0])):
        with pytest.raises(DataError):
            collapse.add(a, b)
    with pytest.raises(DataError, match="between 1"):
        Collapse(0)
    assert collapse.landmarks()[0].tolist() == [0, 1, 2, 3]
    with pytest.raises(DataError, match="finished"):
        collapse.add([0], [1])
