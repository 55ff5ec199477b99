"""Logs after public bug reports are right, or their fault is named: ``python -m tests.faults.strangers``."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.strangers import STRANGERS, Stranger, try_stranger


@pytest.mark.parametrize("stranger", STRANGERS, ids=[s.name for s in STRANGERS])
def test_a_stranger_is_right_or_its_fault_is_named(stranger: Stranger, tmp_path: Path) -> None:
    outcome, what = try_stranger(stranger, tmp_path / "in")
    assert outcome == stranger.outcome, what


def test_every_stranger_has_a_report_of_its_own() -> None:
    assert len({s.source for s in STRANGERS}) == len({s.name for s in STRANGERS}) == len(STRANGERS) >= 40
