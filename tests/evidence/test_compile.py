"""The one wait of a machine is announced, shared by two processes where it can be, and never repeated."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from graphslam.evidence import compile as compiling
from graphslam.evidence.mark_kernels import mark_grids
from graphslam.evidence.pool import GridPool

ROOT = Path(__file__).resolve().parents[2]


class Process:
    """A second process that ends as told."""

    def __init__(self, code: int) -> None:
        self.code = code

    def wait(self) -> int:
        return self.code


@pytest.mark.parametrize(("other", "here"), [(Process(0), ["a"]), (Process(1), ["a", "b"]), (None, ["a", "b"])])
def test_what_the_second_process_does_not_do_is_done_here(
    other: Process | None, here: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr(compiling, "_start_other_half", lambda: other)
    monkeypatch.setattr(compiling, "_first_half", lambda: [("a", lambda: done.append("a"))])
    monkeypatch.setattr(compiling, "_second_half", lambda: [("b", lambda: done.append("b"))])
    compiling.compile_kernels()
    assert done == here
    assert "compiling evidence kernels, once" in capfd.readouterr().err


def test_nothing_is_said_where_the_kernels_are_compiled(capfd: pytest.CaptureFixture[str]) -> None:
    GridPool()
    assert compiling.is_compiled(mark_grids)
    compiling._state["checked"] = False
    GridPool()
    assert capfd.readouterr().err == ""


def test_the_second_process_starts_none_of_its_own(tmp_path: Path) -> None:
    """With an empty cache it compiles by itself, or there would be no end to processes."""
    code = (
        "import subprocess\n"
        "def refuse(*a, **k): raise SystemExit('a process of its own')\n"
        "subprocess.Popen = refuse\n"
        "from graphslam.evidence import compile as c\n"
        "c._second_half = lambda: [('pool', c_pool)]\n"
        "def c_pool():\n"
        "    from graphslam.evidence.pool import GridPool\n"
        "    GridPool()\n"
        "c._as_other_half()\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
