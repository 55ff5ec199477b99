"""A few kills of every verb, at the same operations each time; ``python -m tests.faults.kills`` makes many."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
QUICK = {"run-2d": 3, "study": 2, "merge": 2, "report": 2, "undo": 1, "map": 1}
"""Kills of each verb; a run in space goes through the same writers as "undo", and is left to the command."""


@pytest.mark.parametrize("verb", QUICK)
def test_what_a_kill_leaves_is_whole_and_gone_on_with(verb: str) -> None:
    command = [sys.executable, "-m", "tests.faults.kills", "--verb", verb, "--kills", str(QUICK[verb]), "--exec", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{QUICK[verb]} whole" in done.stdout
