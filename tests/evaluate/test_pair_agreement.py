"""Pair precision and recall of a data association."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.errors import DataError
from graphslam.evaluate.association import pair_agreement
from graphslam_studies.evaluate.association import AssociationErrors, association_errors, majority_identity

labels = st.lists(st.integers(-1, 4), min_size=2, max_size=14)


@given(st.data())
def test_counts_equal_enumeration_of_all_pairs(data):
    a = np.array(data.draw(labels))
    b = np.array(data.draw(st.lists(st.integers(-1, 4), min_size=len(a), max_size=len(a))))
    got = pair_agreement(a, b)
    used = [(x, y) for x, y in zip(a, b) if x >= 0 and y >= 0]
    pairs = list(itertools.combinations(used, 2))
    assert got.together == sum(p[0] == q[0] for p, q in pairs)
    assert got.together_reference == sum(p[1] == q[1] for p, q in pairs)
    assert got.together_both == sum(p == q for p, q in pairs)


def test_hand_case_with_one_wrong_and_one_split():
    got = pair_agreement([0, 0, 0, 1, 1, 2], [7, 7, 8, 9, 9, 9])
    assert got.precision == pytest.approx(2 / 4)  # pairs of ours: 3 + 1; confirmed: (0,1), (3,4)
    assert got.recall == pytest.approx(2 / 4)  # reference: 1 + 3
    assert (got.mixed, got.split) == (1, 1)


def test_identical_up_to_names_is_perfect():
    got = pair_agreement([3, 3, 1, 1, 0], [0, 0, 5, 5, 9])
    assert (got.precision, got.recall, got.mixed, got.split) == (1, 1, 0, 0)


def test_shapes_must_agree():
    with pytest.raises(DataError):
        pair_agreement([0, 1], [0])


@given(st.data())
def test_errors_inside_a_map_equal_a_count_one_by_one(data):
    a = data.draw(labels)
    b = data.draw(st.lists(st.integers(-1, 4), min_size=len(a), max_size=len(a)))
    min_hits = data.draw(st.integers(1, 3))
    identity = {}
    for j in sorted({x for x in a if x >= 0}):
        held = [y for x, y in zip(a, b) if x == j]
        identity[j] = min(set(held), key=lambda y: (-held.count(y), y))
    got = association_errors(a, b, min_hits=min_hits)
    real = [i for i in identity.values() if i >= 0]
    assert got.detections == sum(x >= 0 for x in a)
    assert got.wrong == sum(x >= 0 and y != identity[x] for x, y in zip(a, b))
    assert got.landmarks == len(identity)
    assert got.spurious == sum(i < 0 for i in identity.values())
    assert got.duplicated == len(real) - len(set(real))
    assert got.missed == sum(b.count(y) >= min_hits and y not in real for y in set(b) if y >= 0)
    names, what = majority_identity(a, b)
    assert dict(zip(names.tolist(), what.tolist())) == identity


def test_hand_case_of_errors_inside_a_map():
    # four of 7 (one is of 8, one clutter); two of clutter and one of 9; a duplicate of 7; 8 twice, unused
    got = association_errors([0, 0, 0, 0, 1, 1, 1, 2, -1, -1], [7, 7, 8, -1, -1, -1, 9, 7, 8, 8], min_hits=3)
    assert got == AssociationErrors(detections=8, wrong=3, landmarks=3, spurious=1, duplicated=1, missed=1)
    assert got.wrong_share == pytest.approx(3 / 8)
    assert (got + got).wrong == 6
    assert np.isnan(association_errors([-1], [3]).wrong_share)
