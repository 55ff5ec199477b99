"""Who is believed of two groups of loops that cannot both be right."""

from __future__ import annotations

import numpy as np

from graphslam.loops.conflicting_groups import DOUBT, choose_group, find_conflicting_groups


def test_the_side_that_the_rest_bears_out_is_believed_whatever_its_number() -> None:
    wrong, right = np.full(6, 15.5), np.array([1.9, 1.7, 1.7])
    outcome, why = choose_group(wrong, right)
    assert outcome == "changes"
    assert "15.5 of 6" in why
    assert "1.7 of 3" in why
    assert choose_group(right, wrong)[0] == "stays"
    # neither speaks clearly
    outcome, why = choose_group(np.array([5.4, 5.0, 5.2]), right)
    assert outcome == "ambiguous"
    assert why.startswith("ambiguous, two groups")
    # number counts a little: five more of one side are worth more than doubt
    assert choose_group(np.full(2, 3.0), np.full(2 + int(DOUBT) + 1, 3.0))[0] == "changes"


def test_groups_are_neighbours_that_agree_and_have_rivals() -> None:
    """Three in the graph; outside two that agree, one that contradicts them, and two that are far away."""
    ends = np.array([[10, 100], [11, 101], [50, 200], [10, 101], [12, 103], [11, 100], [52, 202], [54, 204]])
    D2 = np.full((8, 8), 1.0)
    D2[:2, 3:5] = D2[3:5, :2] = 99.0  # the pair against two in the graph
    D2[5, 3:5] = D2[3:5, 5] = 99.0
    D2[5, :2] = D2[:2, 5] = 99.0
    found = find_conflicting_groups(D2, 3, ends, 20.0)
    assert [(a.tolist(), b.tolist()) for a, b in found] == [([0, 1], [3, 4])]
    # a lone loop is no group, and what has no rivals is no dispute
    assert find_conflicting_groups(D2[:6, :6][np.ix_([0, 1, 2, 5], [0, 1, 2, 5])], 3, ends[[0, 1, 2, 5]], 20.0) == []
    assert find_conflicting_groups(np.ones((8, 8)), 3, ends, 20.0) == []
    # nor where the rivals are too many for one mistake
    many = np.array([[10 + k, 100 + k] for k in range(12)])
    D2 = np.ones((12, 12))
    D2[:10, 10:] = D2[10:, :10] = 99.0
    assert find_conflicting_groups(D2, 10, many, 20.0) == []
    assert len(find_conflicting_groups(D2[2:, 2:], 8, many[2:], 20.0)) == 1
