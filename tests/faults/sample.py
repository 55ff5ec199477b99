"""The part of a table of faults that every change is tested with."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any, TypeVar

import pytest

Row = TypeVar("Row")


def one_of_each(rows: Iterable[Row], kind: Callable[[Row], Hashable]) -> list[Any]:
    """Parameters of all rows; all but one of each kind are marked slow. Which one changes from kind to kind, so that
    each front end has its share."""
    rows, out = list(rows), []
    kinds = list(dict.fromkeys(map(kind, rows)))
    members = {k: [row for row in rows if kind(row) == k] for k in kinds}
    chosen = {id(members[k][n % len(members[k])]) for n, k in enumerate(kinds)}
    for row in rows:
        values = row if isinstance(row, tuple) else (row,)
        out.append(pytest.param(*values, marks=() if id(row) in chosen else pytest.mark.slow))
    return out
