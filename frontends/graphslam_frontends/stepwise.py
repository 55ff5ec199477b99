"""Common part of the front ends that use scans and motion as steps."""

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
    """A front end with ``steps``, a `StepConfig`, in its configuration."""

    calibrates: ClassVar[str] = "scans"
    _made: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)

    def steps(self, log: SensorLog, *, drops: DropCounter | None = None) -> Steps:
        """The steps of a log; those of the last log are cached."""
        if not (self._made and self._made[0] is log):
            self._made[:] = [log, check_steps(log, self.config.steps, drops)]
        made: Steps = self._made[1]
        return made

    def with_calibration(self, log: SensorLog, asked: Mapping[str, Any], *, corrected: bool, drift: bool) -> FrontEnd:
        """See :class:`~graphslam_frontends.base.FrontEnd`.

        The random walks of a grid filter model systematic errors of poor odometry. They are too large for 3-D odometry
        by LiDAR and IMU, so they are switched off if its drift was estimated from scans.
        """
        walks = getattr(self.config, "filter", None)
        if not drift or walks is None or "walk_scale" in asked.get("filter", {}):
            return self
        return type(self)(config=replace(self.config, filter=replace(walks, walk_scale=0.0)))  # type: ignore[call-arg]

    def forget(self) -> None:
        """Free the steps of the last log."""
        self._made.clear()
