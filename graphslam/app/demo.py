"""The first thing a newcomer sees: a robot in a garage, SegSLAM, one graph, and the map that follows it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from graphslam.app.run.pipeline import run
from graphslam.app.run.run import Run
from graphslam.app.worlds import simulate
from graphslam.backend.back_end import Observer
from graphslam.core.atomic import part_path
from graphslam.core.errors import UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.trajectory import Trajectory
from graphslam.plots.save import save_figure
from graphslam.plots.segments import plot_segments
from graphslam_frontends.segslam.progress import SegSlamProgress

logger = logging.getLogger(__name__)

PRESETS = {"garage": None, "quick": 5}
"""Sizes of the demo, and their particles: the garage of two levels, 305 m, with its preset's; a court of 51 m."""


def demo_log(preset: str, seed: int) -> SensorLog:
    """The drive of a demo."""
    if preset not in PRESETS:
        raise UnknownNameError("size of the demo", preset, PRESETS)
    if preset == "garage":
        return simulate("garage", seed=seed)
    from graphslam.sim.crawler import simulate_crawler
    from graphslam.sim.crawler_config import CrawlerConfig
    from graphslam.sim.ring_hall import ring_hall

    return simulate_crawler(ring_hall(seed=seed), seed, CrawlerConfig(drift=0.08, max_range=8.0))


def run_demo(out: Path, *, seed: int = 0, preset: str = "garage", progress: bool = True) -> Run:
    """Simulate, run SegSLAM, join its segments in a graph, fuse the map. A demo that is there already is gone on with.

    ``figures/progress.png`` is drawn anew whenever a segment ends: the first thing to look at.
    """
    log = demo_log(preset, seed)
    particles = PRESETS[preset]
    options = {} if particles is None else {"frontend": {"filter": {"particles": particles}}}
    truth = None if log.truth is None else log.truth.trajectory
    with DemoProgress(out / "figures" / "progress.png", truth, shown=progress) as watch:
        return run(
            log, frontend="segslam", seed=seed, out=out, config=options, resume=True, progress=False, observers=[watch]
        )


@dataclass
class DemoProgress(Observer):
    """One line on stderr that says where the demo is, and a picture of the segments so far.

    Parameters
    ----------
    truth : Trajectory or None
        Drawn beside the segments.
    shown : bool
        Show the line.
    """

    picture: Path
    truth: Trajectory | None = None
    shown: bool = True
    drawn: int = field(default=0, init=False)
    """Segments of the last picture."""
    bar: Any = field(default=None, init=False)

    def __enter__(self) -> DemoProgress:
        self.bar = tqdm(desc="SegSLAM", unit="step", disable=not self.shown, leave=False, dynamic_ncols=True)
        self.bar.set_postfix_str("compiling (first run only, ~30 s)")
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()

    def front_end_at(self, at: SegSlamProgress) -> None:
        """After every step of the filter."""
        if self.bar.total is None:
            self.bar.total = at.steps
        self.bar.update(at.step - self.bar.n)
        last = at.step == at.steps
        n = at.segments
        if n > self.drawn:
            self.draw(at)
            self.drawn = n
        where = f"{at.length:.0f} m, {n} segments"
        if self.drawn:
            where += f"; see {self.picture}"
        if last:
            self.bar.set_description("segments → graph → fused map")
        self.bar.set_postfix_str(where, refresh=last)

    def draw(self, at: SegSlamProgress) -> None:
        """The picture, in place of the one before."""
        self.picture.parent.mkdir(parents=True, exist_ok=True)
        paths = at.paths()
        truth = self.truth
        if truth is not None:  # as the map is, in the frame of the first base
            from graphslam.core.poses import group_of, remove_roll_pitch

            truth = truth.transformed(group_of(truth.poses).inverse(remove_roll_pitch(truth.poses[0])))
        title = f"SegSLAM after {at.length:.0f} m: {len(paths)} segments, no loop closure yet"
        ax = plot_segments(None, paths, truth=truth, title=title)
        part = part_path(self.picture, ".png")
        save_figure(ax, part)
        part.replace(self.picture)
