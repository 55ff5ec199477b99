"""Progress bars on stderr: every bar of the package is a :class:`Bar`."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

COMPILING = "compiling (first run only, up to a minute)"
"""Text of a bar while kernels are compiled."""


def printable(text: str) -> str:
    """Text of a file or log for a terminal: control characters become escapes (``\\x1b``), line breaks are kept."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


class Bar(tqdm):
    """A progress bar that is removed at the end, and whose errors never stop the work.

    No bar is shown if stderr is closed or not writable.

    Parameters
    ----------
    steps : iterable, optional
    total : float, optional
        Number of steps, if it is not known from the iterable.
    **options
        Other options of tqdm.
    """

    hidden = False
    """No bar is shown at all (``graphslam --quiet``)."""
    monitor_interval = 0  # no monitor thread
    _lock = threading.RLock()  # tqdm's default is a system semaphore, which a killed process would leave behind

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
        """Write the line, not before ``delay``; if stderr is lost, only the bar ends."""
        if self._time() < getattr(self, "start_t", 0.0) + self.delay:
            return False
        try:
            self.last_print_t = self._time()  # tqdm removes only lines that it knows of
            return super().display(*args, **options)
        except (OSError, ValueError):
            self.disable = True
            return False

    def clear(self, *args: Any, **options: Any) -> None:
        """Remove the line for a message above it; no effect if no line is written yet."""
        if self._time() >= getattr(self, "start_t", 0.0) + self.delay:
            super().clear(*args, **options)

    def close(self) -> None:
        """Remove the line."""
        try:
            super().close()
        except (OSError, ValueError):
            self.disable = True

    def note(self, text: str) -> None:
        """Write a note after the bar immediately."""
        if not self.disable:
            self.set_postfix_str(printable(text))


def shown_bars() -> list[Bar]:
    """Bars currently on the terminal, in order."""
    with Bar.get_lock():
        bars = [b for b in getattr(Bar, "_instances", ()) if isinstance(b, Bar) and not b.disable]  # not tqdm's
        return sorted(bars, key=lambda b: abs(b.pos))


def show_compiling(now: bool) -> None:
    """Show or remove the compilation note in the first bar."""
    for bar in shown_bars()[:1]:
        if now:
            bar.note(COMPILING)
        elif bar.postfix == COMPILING:
            bar.set_postfix_str("", refresh=False)
