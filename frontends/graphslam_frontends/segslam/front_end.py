"""The front end ``segslam``: submaps with evidence grids and matches from a log of beams and motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import ClassVar

from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam_frontends.base import Watch
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.odometry.scan_use import with_findings
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.scan_odometry_steps import odometry_from_scans, refuse_fused_steps
from graphslam_frontends.segslam.config import SegSlamConfig
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_frontends.segslam.submaps import common_ancestor_chain, drift_by_path, submaps_of_segments
from graphslam_frontends.stepwise import StepwiseFrontEnd


@dataclass(frozen=True, slots=True, kw_only=True)
class SegSlamFrontEndConfig:
    """The front end ``segslam``."""

    steps: StepConfig = field(default_factory=StepConfig)
    """Conversion of the log to steps."""
    filter: GridFilterConfig = field(default_factory=GridFilterConfig)
    """Particles, motion, weights."""
    segslam: SegSlamConfig = field(default_factory=SegSlamConfig)
    """Segmentation, matching, and output."""
    drift: FilterDrift = field(default_factory=FilterDrift)
    """Errors common to all particles, if the filter samples the motion."""
    window: ScanWindowConfig = field(default_factory=ScanWindowConfig)
    """Scan-to-window odometry inside the segments (``segslam.inside = "scan-window"``)."""

    def __post_init__(self) -> None:
        if self.segslam.inside == "scan-window":
            refuse_fused_steps(self.steps)


@dataclass(frozen=True, slots=True)
class SegSlam(StepwiseFrontEnd):
    """The front end ``segslam``.

    Needs a stream of beams (a spinning scanner, point clouds, planar scans) and one of motion. The best particle is
    known only at the end, so the filter processes the whole log first, also in a resumed run; the same seed gives the
    same submaps.
    """

    config: SegSlamFrontEndConfig = field(default_factory=SegSlamFrontEndConfig)
    name: ClassVar[str] = "segslam"
    draws: ClassVar[bool] = True

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :class:`~graphslam_frontends.base.FrontEnd`: the chain of the best particle, segment by segment."""
        result = self.result(log, seed=seed, drops=drops, watch=watch)
        for submap in submaps_of_best_particle(result, self.config.drift, self.config.segslam):
            if submap.key == 0:
                submap = with_findings(submap, result.steps)
            if after is None or submap.key > after.key:
                yield submap

    def result(
        self, log: SensorLog, *, seed: SeedTree, drops: DropCounter | None = None, watch: Watch | None = None
    ) -> SegSlamResult:
        """The SegMap with all particles; :meth:`submaps` outputs the chain of the best one."""
        c, steps, filter = self.config, self.steps(log, drops=drops), self.config.filter
        if c.segslam.inside == "scan-window":
            # one path for all: its uncertainty is too small for maps to resolve
            steps, filter = odometry_from_scans(steps, c.window), replace(filter, walk_scale=0.0, motion_scale=0.0)
        return run_segslam(steps, filter, c.segslam, seed.child(0), watch=watch)


def submaps_of_best_particle(result: SegSlamResult, drift: FilterDrift, config: SegSlamConfig) -> list[Submap]:
    """Submaps of the best particle's chain.

    Parameters
    ----------
    drift : FilterDrift
        Errors common to all particles.
    """
    segmap, steps = result.segmap, result.steps
    chain = common_ancestor_chain(segmap, int(result.closed[result.best]))
    return submaps_of_segments(
        segmap,
        chain,
        drift_by_path(segmap, chain, drift, steps),
        config.handover,
        uses=steps.uses,
        reasons={b.step: b.why for b in result.boundaries},
    )
