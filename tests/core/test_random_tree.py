"""The seed tree: same branch, same numbers; other branch, other numbers."""

from __future__ import annotations

import numpy as np

from graphslam.core.random import SeedTree

FIXED = [2002347002, 1264862413, 1603480371]


def draw(tree: SeedTree) -> np.ndarray:
    return tree.generator().standard_normal(1000)


def test_same_path_same_numbers_however_it_is_walked() -> None:
    a = SeedTree(3).child("frontend", 7, "noise")
    b = SeedTree(3).child("frontend").child(7).child("noise")
    assert a == b
    assert np.array_equal(draw(a), draw(b))


def test_branches_do_not_depend_on_what_was_drawn_before() -> None:
    root = SeedTree(1)
    expected = draw(root.child("b"))
    draw(root.child("a"))
    draw(root)
    assert np.array_equal(draw(root.child("b")), expected)


def test_other_branches_seeds_and_orders_are_uncorrelated() -> None:
    trees = [
        SeedTree(0),
        SeedTree(1),
        SeedTree(0).child("a"),
        SeedTree(0).child("b"),
        SeedTree(0).child("a", "b"),
        SeedTree(0).child("b", "a"),
        SeedTree(0).child(0),
        SeedTree(0).child(1),
        SeedTree(0).child(0, 0),
    ]
    X = np.stack([draw(t) for t in trees])
    off = np.corrcoef(X) - np.eye(len(trees))
    assert np.abs(off).max() < 5 / np.sqrt(1000)


def test_the_stream_is_fixed_for_good() -> None:
    """Results in old run folders must stay repeatable: a change of the generator has to be seen."""
    first = SeedTree(0).child("frontend", 3).generator().integers(0, 2**32, 3)
    assert first.tolist() == FIXED
