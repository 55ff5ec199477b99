"""Every reader against damaged input, a few dozen cases each; many more by ``python -m tests.faults.fuzz``."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from tests.faults.fuzz import BAD, Bench, not_finite
from tests.faults.readers import READERS

CASES = 60


@pytest.mark.parametrize("name", READERS)
def test_damaged_input_is_refused_or_read_with_finite_numbers(name: str, tmp_path: Path) -> None:
    logging.disable(logging.CRITICAL)
    try:
        bench = Bench(name, tmp_path / name, seed=1)
        cases = max(CASES // READERS[name].slow, 2)
        bad = [(k, *found) for k in range(cases) if (found := bench.case(k))[0] in BAD]
    finally:
        logging.disable(logging.NOTSET)
    assert not bad


def test_the_judge_sees_what_it_must() -> None:
    assert not_finite({"a": [1.0, float("nan")]}, frozenset()) == ".a"
    assert not_finite({"a": [1.0, float("nan")]}, frozenset({"a"})) is None
    assert not_finite([1.0, "nan", None, 3], frozenset()) is None
