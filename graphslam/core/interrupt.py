"""Deferred Ctrl-C for blocks that must not be interrupted.

Python raises `KeyboardInterrupt` at any point. Between two related writes it would leave an inconsistent value.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer Ctrl-C, and SIGTERM if the command line handles it, to the end of this block; for short atomic blocks.

    Does nothing outside the main thread, which no signal interrupts.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # not one that is ignored, has the default of the system, or was not set by Python
    before = {n: h for n in (signal.SIGINT, signal.SIGTERM) if callable(h := signal.getsignal(n))}
    pending: list[tuple[int, FrameType | None]] = []
    for number in before:
        signal.signal(number, lambda number, frame: pending.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if pending:
            before[signal.Signals(pending[0][0])](*pending[0])
