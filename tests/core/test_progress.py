"""Bars of progress never end the work that they show, and write nothing of a log that controls a terminal."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import pytest

from graphslam.core.progress import COMPILING, Bar, printable, show_compiling, shown_bars


def test_characters_that_control_a_terminal_become_escapes(capfd: pytest.CaptureFixture[str]) -> None:
    assert printable("a\x1b[2Jb\nc\x07é") == r"a\x1b[2Jb" "\n" r"c\x07é"
    with Bar(name="log\x1b]0;title\x07", total=2) as bar:
        bar.note("\x1b[31mred")
    written = capfd.readouterr().err
    assert r"log\x1b]0;title\x07" in written
    assert "\x1b[31m" not in written
    assert "\x07" not in written


def test_a_bar_counts_and_is_gone_at_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    assert list(Bar([1, 2, 3], "counting")) == [1, 2, 3]
    assert capfd.readouterr().err.endswith("\r")
    assert shown_bars() == []
    assert list(Bar([1, 2], "counting", shown=False)) == [1, 2]
    assert capfd.readouterr().err == ""


class Full(io.StringIO):
    """A stream that takes some text and then fails."""

    def write(self, text: str) -> int:
        if self.tell() > 40:
            raise OSError(28, "No space left on device")
        return super().write(text)


@pytest.mark.parametrize("stream", [None, Full(), Full("x" * 41)])
def test_work_goes_on_without_stderr(stream: io.StringIO | None, monkeypatch: pytest.MonkeyPatch) -> None:
    if stream is not None:
        stream.seek(0, os.SEEK_END)
    monkeypatch.setattr(sys, "stderr", stream)
    assert list(Bar(range(5), "counting", mininterval=0.0)) == [0, 1, 2, 3, 4]
    with Bar(total=3) as bar:
        bar.update(2)
        bar.note("note")


def test_a_bar_says_that_kernels_are_compiled(capfd: pytest.CaptureFixture[str]) -> None:
    with Bar(name="work", total=2):
        show_compiling(True)
        assert [b.postfix for b in shown_bars()] == [COMPILING]
        show_compiling(False)
        assert [b.postfix for b in shown_bars()] == [""]
    assert COMPILING in capfd.readouterr().err


@pytest.mark.parametrize("stderr", ["2>&-", "2>/dev/full", "2> >(true)"])
def test_a_command_outlives_its_stderr(stderr: str) -> None:
    """Closed, full, or a pipe that nobody reads: the result is there, and exit code 0."""
    code = (
        "import sys, time, logging; from graphslam.app import cli\n"
        "def app():\n"
        "    cli.log_to_stderr(); time.sleep(0.2)\n"
        "    for _ in cli_bar(range(50), 'work', mininterval=0.0): logging.warning('message')\n"
        "    print('result')\n"
        "from graphslam.core.progress import Bar as cli_bar\n"
        "cli.app = app; cli.main()\n"
    )
    done = subprocess.run(
        ["bash", "-c", f'"$0" -c "$1" {stderr}', sys.executable, code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "result\n")
