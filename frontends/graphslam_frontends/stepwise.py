"""What front ends share that work on scans and motion, put into steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from graphslam.core.log import DropCounter, SensorLog
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.odometry.scan_use import check_steps
from graphslam_frontends.odometry.steps import Steps


@dataclass(frozen=True, slots=True)
class StepwiseFrontEnd(FrontEnd):
    """A front end whose configuration holds ``steps``, a `StepConfig`."""

    _made: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)

    def steps(self, log: SensorLog, *, drops: DropCounter | None = None) -> Steps:
        """The steps of a log; those of the last one are kept."""
        if not (self._made and self._made[0] is log):
            self._made[:] = [log, check_steps(log, self.config.steps, drops)]
        made: Steps = self._made[1]
        return made

    def forget(self) -> None:
        """Let go of the steps of the last log."""
        self._made.clear()
