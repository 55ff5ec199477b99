"""A few kills of every verb, at the same operations each time; ``python -m tests.faults.kills`` makes many."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
QUICK = [(3, ["run-2d"]), (2, ["study", "merge", "report"]), (1, ["undo", "map"])]
"""Kills, and verbs of one process; a run in space has the writers of "undo", and is left to the command."""


@pytest.mark.parametrize(("kills", "verbs"), QUICK, ids=lambda of: "-".join(of) if isinstance(of, list) else "")
def test_what_a_kill_leaves_is_whole_and_resumed(kills: int, verbs: list[str]) -> None:
    options = [x for verb in verbs for x in ("--verb", verb)]
    command = [sys.executable, "-m", "tests.faults.kills", *options, "--kills", str(kills), "--exec", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for verb in verbs:
        assert f"{verb}: {kills} kills, {kills} whole" in done.stdout
