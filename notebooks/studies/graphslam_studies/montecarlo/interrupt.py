"""Ctrl-C is heard even where Python loses it.

Python raises `KeyboardInterrupt` wherever it happens to be. In a finaliser or a callback of compiled code it is
printed and forgotten, and a long study then goes on as if nobody had asked.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Whether Ctrl-C was pressed in a block of `watch_interrupts`."""

    def __init__(self) -> None:
        self.asked = False

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if one was asked for and got lost."""
        if self.asked:
            raise KeyboardInterrupt


def _is_ours_to_handle() -> bool:
    """Only the main thread may set handlers, and a handler somebody chose is left alone."""
    return (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )


@contextmanager
def watch_interrupts() -> Iterator[Interrupt]:
    """Remember Ctrl-C in this block as well as raising it; call `Interrupt.check` between pieces of work.

    Does nothing outside the main thread or where the program handles the signal itself (as in a notebook's kernel
    that asked to).
    """
    state = Interrupt()
    if not _is_ours_to_handle():
        yield state
        return

    def remember(number: int, frame: FrameType | None) -> None:
        state.asked = True
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, remember)
    try:
        yield state
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
