"""The one wait of a machine is announced, shared by two processes where it can be, and never repeated."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from graphslam.core.jit import COMPILING
from graphslam.core.progress import Bar
from graphslam.evidence import compile as compiling
from graphslam.evidence import jit_notice
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
    monkeypatch.setattr(compiling, "start_compiling", lambda part, start: other)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setattr(compiling, "_first_half", lambda: [lambda: done.append("a")])
    monkeypatch.setattr(compiling, "_second_half", lambda: [lambda: done.append("b")])
    compiling.compile_kernels()
    assert done == here
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("with_bar", [False, True])
def test_a_bar_says_that_kernels_are_compiled(
    with_bar: bool, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(jit_notice, "is_compiled", lambda kernel: False)
    monkeypatch.setattr(jit_notice, "start_compiling", lambda part, start: None)
    jit_notice._state["checked"] = False
    with Bar(name="front end", total=3) if with_bar else nullcontext():
        jit_notice.announce_compilation()
    written = capfd.readouterr().err
    assert "compiling (first run only, ~1 min)" in written
    assert ("front end" in written) == with_bar


def test_nothing_is_reported_where_the_kernels_are_compiled(capfd: pytest.CaptureFixture[str]) -> None:
    jit_notice.start_compiling("all", subprocess.run)  # what this process has loaded may have been deleted meanwhile
    assert jit_notice.is_compiled(mark_grids)
    jit_notice._state["checked"] = False
    capfd.readouterr()
    GridPool()
    assert capfd.readouterr().err == ""


def test_code_that_is_not_there_is_compiled_and_announced_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def mark_grids() -> None: ...

    kernel = SimpleNamespace(py_func=mark_grids, stats=SimpleNamespace(cache_path=str(tmp_path)))
    started: list[str] = []
    monkeypatch.setattr(jit_notice, "mark_grids", kernel)
    monkeypatch.setattr(jit_notice, "start_compiling", lambda part, start: started.append(part))
    monkeypatch.setattr(jit_notice.inspect, "getsourcefile", lambda function: "mark_kernels.py")
    for name, wanted in (("other_kernels.mark_grids-1.nbi", ["all"]), ("mark_kernels.mark_grids-1.nbi", ["all"])):
        (tmp_path / name).touch()
        jit_notice._state["checked"] = False
        GridPool()
        GridPool()
        assert started == wanted


@pytest.mark.parametrize("compiling_already", [False, True])
def test_a_machine_without_code_is_reported_once_and_processes_that_compile_start_none(
    compiling_already: bool, tmp_path: Path
) -> None:
    """With an empty cache; or there would be no end to processes."""
    code = (
        "import subprocess\n"
        "started = []\n"
        "subprocess.run = lambda command, **k: started.append(command[-1])\n"
        "from graphslam.evidence.pool import GridPool\n"
        "GridPool(); GridPool()\n"
        "print(started)\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    environment |= {COMPILING: "1"} if compiling_already else {}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == ("[]" if compiling_already else "['all']"), done.stderr
