"""Demo: a simulated robot in a garage, SegSLAM, one graph, and the fused map."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from graphslam.app.run.pipeline import run
from graphslam.app.run.run import Run
from graphslam.app.run.run_bar import RunBar
from graphslam.app.worlds import simulate
from graphslam.backend.back_end import Observer
from graphslam.core.atomic import atomic_open
from graphslam.core.errors import UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.trajectory import Trajectory
from graphslam.plots.save import figure_png
from graphslam.plots.segments import plot_segments
from graphslam_frontends.segslam.progress import SegSlamProgress

logger = logging.getLogger(__name__)

PRESETS = {"garage": None, "quick": 5}
"""Presets of the demo with their numbers of particles; None: as in the preset of the two-level garage (305 m path)."""


def demo_log(preset: str, seed: int) -> SensorLog:
    """Simulated log of a demo preset."""
    if preset not in PRESETS:
        raise UnknownNameError("size of the demo", preset, PRESETS)
    if preset == "garage":
        return simulate("garage", seed=seed)
    from graphslam.sim.crawler import simulate_crawler
    from graphslam.sim.crawler_config import CrawlerConfig
    from graphslam.sim.ring_hall import ring_hall

    return simulate_crawler(ring_hall(seed=seed), seed, CrawlerConfig(drift=0.08, max_range=8.0))


def run_demo(out: Path, *, seed: int = 0, preset: str = "garage", progress: bool = True) -> Run:
    """Simulate, run SegSLAM, join its segments in a graph, fuse the map. An interrupted demo is resumed.

    ``figures/progress.png`` is drawn again after every segment.
    """
    log = demo_log(preset, seed)
    particles = PRESETS[preset]
    options = {} if particles is None else {"frontend": {"filter": {"particles": particles}}}
    truth = None if log.truth is None else log.truth.trajectory
    watch = DemoProgress(out / "figures" / "progress.png", truth)
    return run(
        log, frontend="segslam", seed=seed, out=out, config=options, resume=True, progress=[RunBar(progress), watch]
    )


@dataclass
class DemoProgress(Observer):
    """A picture of the segments so far, updated during the run.

    Parameters
    ----------
    picture : Path
    truth : Trajectory or None
        Drawn with the segments.
    """

    picture: Path
    truth: Trajectory | None = None
    drawn: int = field(default=0, init=False)
    """Number of segments in the last picture."""

    def front_end_at(self, progress: SegSlamProgress) -> None:
        """After every step of the filter: draw the picture if there is a new segment."""
        if progress.segments > self.drawn:
            self.draw(progress)
            if not self.drawn:
                logger.warning("see %s: drawn again after every segment", self.picture)
            self.drawn = progress.segments

    def draw(self, at: SegSlamProgress) -> None:
        """Draw the picture and replace the previous one."""
        self.picture.parent.mkdir(parents=True, exist_ok=True)
        paths = at.paths()
        truth = self.truth
        if truth is not None:  # into the frame of the first base, as the map
            from graphslam.core.poses import group_of, remove_roll_pitch

            truth = truth.transformed(group_of(truth.poses).inverse(remove_roll_pitch(truth.poses[0])))
        title = f"SegSLAM after {at.length:.0f} m: {len(paths)} segments, no loop closure yet"
        ax = plot_segments(None, paths, truth=truth, title=title)
        with atomic_open(self.picture) as stream:
            stream.write(figure_png(ax))
