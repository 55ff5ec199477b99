"""Progress of long work, one line on stderr: every bar of the package is a :class:`Bar`."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

COMPILING = "compiling (first run only, ~1 min)"
"""What a bar says while kernels are compiled."""


def printable(text: str) -> str:
    """Text of a file or a log on a terminal: characters that control it are replaced, lines are kept."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)


class Bar(tqdm):
    """A bar of progress that is gone when the work is done, and that never ends the work.

    Where stderr is closed or cannot be written to, there is no bar.

    Parameters
    ----------
    steps : iterable, optional
    total : float, optional
        Number of steps, where it cannot be told from the iterable.
    **options
        Further ones of tqdm.
    """

    hidden = False
    """No bar is shown at all (``graphslam --quiet``)."""
    monitor_interval = 0  # no thread of its own
    _lock = threading.RLock()  # tqdm's own is a semaphore of the system, left behind by a process that is ended

    def __init__(
        self,
        steps: Iterable[Any] | None = None,
        name: str = "",
        *,
        total: float | None = None,
        unit: str = "step",
        shown: bool = True,
        **options: Any,
    ) -> None:
        off = not shown or Bar.hidden or sys.stderr is None
        more = {"leave": False, "dynamic_ncols": True, "miniters": 0, **options}
        try:
            super().__init__(
                steps, printable(name), total, unit=f" {unit}", file=sys.stderr, disable=off, **more
            )  # fmt: skip
        except (OSError, ValueError):
            self.disable = True

    def display(self, *args: Any, **options: Any) -> Any:
        """Write the line, not before ``delay``; a stderr that was lost ends the bar alone."""
        if self._time() < getattr(self, "start_t", 0.0) + self.delay:
            return False
        try:
            self.last_print_t = self._time()  # tqdm removes only lines that it knows of
            return super().display(*args, **options)
        except (OSError, ValueError):
            self.disable = True
            return False

    def clear(self, *args: Any, **options: Any) -> None:
        """Remove the line for a message above it; nothing where no line is written yet."""
        if self._time() >= getattr(self, "start_t", 0.0) + self.delay:
            super().clear(*args, **options)

    def close(self) -> None:
        """Remove the line."""
        try:
            super().close()
        except (OSError, ValueError):
            self.disable = True

    def say(self, text: str) -> None:
        """Write a note behind the bar, at once."""
        if not self.disable:
            self.set_postfix_str(printable(text))


def shown_bars() -> list[Bar]:
    """Bars that are on the terminal now, the first one first."""
    with Bar.get_lock():
        bars = [b for b in getattr(Bar, "_instances", ()) if isinstance(b, Bar) and not b.disable]  # tqdm's own apart
        return sorted(bars, key=lambda b: abs(b.pos))


def say_compiling(now: bool) -> None:
    """Have the first bar that is shown say that kernels are compiled, and no longer when they are."""
    for bar in shown_bars()[:1]:
        if now:
            bar.say(COMPILING)
        elif bar.postfix == COMPILING:
            bar.set_postfix_str("", refresh=False)


@contextmanager
def compiling() -> Iterator[None]:
    """While kernels are compiled: the bar that is shown says so, or one is shown for it."""
    if shown_bars():
        say_compiling(True)
        yield
        say_compiling(False)
        return
    with Bar(name=COMPILING, bar_format="{desc}"):
        yield
