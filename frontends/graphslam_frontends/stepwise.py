"""What front ends share that work on scans and motion, put into steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from graphslam.core.log import DropCounter, SensorLog
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.odometry.scan_use import check_steps
from graphslam_frontends.odometry.steps import Steps


@dataclass(frozen=True, slots=True)
class StepwiseFrontEnd(FrontEnd):
    """A front end whose configuration holds ``steps``, a `StepConfig`."""

    calibrates: ClassVar[str] = "scans"
    _made: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)

    def steps(self, log: SensorLog, *, drops: DropCounter | None = None) -> Steps:
        """The steps of a log; those of the last one are kept."""
        if not (self._made and self._made[0] is log):
            self._made[:] = [log, check_steps(log, self.config.steps, drops)]
        made: Steps = self._made[1]
        return made

    def with_calibration(self, log: SensorLog, asked: Mapping[str, Any], *, corrected: bool, drift: bool) -> FrontEnd:
        """See :class:`~graphslam_frontends.base.FrontEnd`.

        The random walks of a grid filter represent errors of poor odometry that last. In space they would shake
        odometry by LiDAR and IMU, which is better than they are; where scans gave its drift, they are switched off.
        """
        walks = getattr(self.config, "filter", None)
        if not drift or walks is None or "walk_scale" in asked.get("filter", {}):
            return self
        return type(self)(config=replace(self.config, filter=replace(walks, walk_scale=0.0)))  # type: ignore[call-arg]

    def forget(self) -> None:
        """Let go of the steps of the last log."""
        self._made.clear()
