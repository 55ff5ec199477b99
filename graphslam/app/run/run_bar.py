"""Progress bar over all stages of a run."""

from __future__ import annotations

import sys
import threading
from types import TracebackType
from typing import Any

from graphslam.backend.back_end import Observer
from graphslam.core.log import SensorLog
from graphslam.core.progress import Bar
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph

STAGES = {
    "reading": 2.0, "calibration": 8.0, "front end": 50.0, "graph": 5.0, "refinement": 18.0, "fused map": 6.0,
    "evaluation": 4.0, "figures": 7.0,
}  # fmt: skip
"""Stages of a run in order, with the approximate share of time of each [%]."""


class RunBar(Observer):
    """Progress of a run on stderr: the stage, and in the front end the time in the log and the submaps so far.

    Parameters
    ----------
    shown : bool
        Show the bar.
    """

    def __init__(self, shown: bool) -> None:
        layout = "{desc}  {percentage:3.0f} %|{bar:20}| {elapsed}{postfix}"
        delay = 0.5 if sys.stderr is not None and sys.stderr.isatty() else 5.0  # [s] an early error is the only line
        self.shown = shown
        self._bar = Bar(
            name=next(iter(STAGES)), total=sum(STAGES.values()), shown=shown, bar_format=layout, delay=delay
        )
        self._stage, self._first, self._duration = "", 0.0, 0.0
        self._ended = threading.Event()

    def __enter__(self) -> RunBar:
        if not self._bar.disable and sys.stderr.isatty():  # updates the time in stages without steps
            threading.Thread(target=self._tick, daemon=True).start()
        return self

    def _tick(self) -> None:
        while not self._ended.wait(1.0):
            self._bar.refresh()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended.set()
        self._bar.close()

    def stage(self, name: str) -> None:
        """Move the bar to the start of a stage."""
        self._stage = name
        self._bar.set_description_str(f"{list(STAGES).index(name) + 1}/{len(STAGES)} {name}", refresh=False)
        self._move(0.0)
        self._bar.note("")

    def log_read(self, log: SensorLog) -> None:
        """Set the time interval of the log, for the progress of the front end."""
        self._first, self._duration = log.interval[0], max(log.duration, 1e-9)

    def front_end_at(self, progress: Any) -> None:
        """Update by a step of a front end that counts its steps; otherwise no change."""
        steps = getattr(progress, "steps", 0)
        if steps:
            self._move(progress.step / steps, f"{progress.length:.0f} m, {progress.segments} segments")

    def submap_added(self, submap: Submap, graph: FactorGraph) -> None:
        """Update by the end time of a submap in the log."""
        if self._stage != "front end":
            return
        done = submap.interval[1] - self._first
        note = f"{done:.0f} of {self._duration:.0f} s, {len(graph.submaps)} submaps"
        if len(graph.values.landmarks):
            note += f", {len(graph.values.landmarks)} landmarks"
        self._move(done / self._duration, note)

    def _move(self, share: float, note: str = "") -> None:
        names = list(STAGES)
        before = sum(STAGES[n] for n in names[: names.index(self._stage)])
        if note:
            self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(before + STAGES[self._stage] * min(max(share, 0.0), 1.0) - self._bar.n)
