"""The fault matrix of the front ends on grids: every fault is refused, dropped and counted, handled, or said."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest

from tests.faults.grid_page import markdown
from tests.faults.grid_rows import FRONT_ENDS, ROWS, Row
from tests.faults.grid_trial import ERROR_MARGIN, Seen, trial
from tests.faults.grid_worlds import world
from tests.faults.sample import one_of_each


def cases() -> list[tuple[Row, int, str]]:
    """Rows with their dimensions: refusals by both front ends; the others by one each, in turns, for they take time.

    ``python -m tests.faults.grid_table`` runs all by both.
    """
    out = []
    for k, row in enumerate(ROWS):
        fronts = FRONT_ENDS if row.outcome == "refused" else (FRONT_ENDS[k % 2],)
        out += [(row, dim, front) for dim in row.dims for front in fronts]
    return out


CASES = cases()


@functools.cache
def clean(dim: int, frontend: str) -> Seen:
    return trial(None, world(dim), frontend)


@pytest.mark.parametrize("frontend", FRONT_ENDS)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_sound_log_is_not_reproached(dim: int, frontend: str) -> None:
    seen = clean(dim, frontend)
    assert not seen.codes(), seen.lines
    assert not seen.confident
    assert seen.error < 0.5


@pytest.mark.parametrize(
    ("row", "dim", "frontend"),
    one_of_each(CASES, lambda case: case[0].name),
    ids=[f"{front}-{dim}d-{row.name}" for row, dim, front in CASES],
)
def test_every_fault_has_its_outcome(row: Row, dim: int, frontend: str) -> None:
    seen, sound = trial(row, world(dim), frontend), clean(dim, frontend)
    assert not seen.silently_wrong(sound), seen
    if row.outcome == "refused":
        assert seen.refused, seen
        assert row.sign in seen.refused
        return
    assert not seen.refused
    if row.outcome == "reported":
        assert seen.codes() & set(row.sign.split("|")), seen.lines
    elif row.outcome == "dropped":
        assert any(row.sign in reason and n > 0 for reason, n in seen.dropped.items()), seen.dropped
        assert not seen.confident
    else:
        assert not seen.confident or seen.error < ERROR_MARGIN[0] * sound.error + ERROR_MARGIN[1], seen


def test_the_page_holds_the_rows() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "notes" / "faults.md").read_text()
    shown = page.partition("<!-- grid rows -->\n")[2]
    assert shown.startswith(markdown()), "write docs/notes/faults.md anew: python -m tests.faults.grid_page"
