"""Demo: a simulated robot in a garage, SegSLAM, one graph, and the fused map."""

from __future__ import annotations

from pathlib import Path

from graphslam.app.run.pipeline import run
from graphslam.app.run.run import Run
from graphslam.app.worlds import simulate
from graphslam.core.errors import UnknownNameError
from graphslam.core.log import SensorLog

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
    """Simulate, run SegSLAM, join its segments in a graph, fuse the map. An interrupted demo is resumed."""
    log = demo_log(preset, seed)
    particles = PRESETS[preset]
    options = {} if particles is None else {"frontend": {"filter": {"particles": particles}}}
    return run(log, frontend="segslam", seed=seed, out=out, config=options, resume=True, progress=progress)
