"""Ctrl-C that Python would lose is found again; a block that must be whole is not cut."""
# ruff: noqa: PT012 - what happens inside the block, and what does not any more, is what these tests are about

from __future__ import annotations

import os
import signal
import sys
import threading

import pytest

from graphslam.core.interrupt import defer_interrupts
from graphslam_studies.montecarlo.interrupt import watch_interrupts
from tests.command_line import graphslam


@pytest.fixture(autouse=True)
def pythons_handler() -> None:
    """Tests that run in the background of a shell would find Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


class Finalised:
    """Ctrl-C while this goes away is printed by Python, and forgotten."""

    def __del__(self) -> None:
        press()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_lost_interrupt_is_heard_at_the_next_check() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), watch_interrupts() as interrupt:
        victim = Finalised()
        interrupt.check()
        del victim
        done.append("went on")  # else this test would not be about anything
        interrupt.check()
        done.append("deaf")
    assert done == ["went on"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_is_raised_where_it_falls() -> None:
    with pytest.raises(KeyboardInterrupt), watch_interrupts():
        press()
        raise AssertionError("not reached")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_program_is_left_alone() -> None:
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(1))
    try:
        with watch_interrupts() as interrupt:
            press()
            interrupt.check()
        with defer_interrupts():
            press()
            assert heard == [1]
        assert heard == [1, 1]
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_deferred_interrupt_comes_after_the_block() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt):
        with defer_interrupts():
            press()
            done.append("whole")
        done.append("too late")
    assert done == ["whole"]
    with pytest.raises(KeyboardInterrupt):
        press()


def test_the_error_of_a_deferred_block_gets_out() -> None:
    with pytest.raises(ValueError, match="mine"), defer_interrupts():
        raise ValueError("mine")


def test_other_threads_are_unaffected() -> None:
    seen = []

    def work() -> None:
        with watch_interrupts() as interrupt, defer_interrupts():
            interrupt.check()
            seen.append(1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [1]


def test_a_command_in_a_test_leaves_signals_as_they_were() -> None:
    """Else the next Ctrl-C of this file, which a hook of the command repeats a moment later, ends the process."""
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM), sys.unraisablehook
    assert graphslam("--version").returncode == 0
    assert graphslam("solve", "missing.g2o").returncode == 1
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM), sys.unraisablehook) == before
