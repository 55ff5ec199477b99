"""A few moments at which the machine gives out; ``python -m tests.faults.exhaustion`` has all commands."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("disk full", "SIGINT", "SIGTERM", "SIGKILL", "streams", "odd --out", "two processes")


def test_commands_end_well_when_the_machine_gives_out() -> None:
    options = [x for name in QUICK for x in ("--condition", name)]
    command = [sys.executable, "-m", "tests.faults.exhaustion", "--verb", "simulate", "--points", "2", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in QUICK:
        assert f"{name}: " in done.stdout
