"""A court small enough to be refined in a second, and robots in it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.refine.scans import Scans
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import crawler_preset
from graphslam.sim.ring_hall import ring_hall
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_studies.segslam_trial import QUICK


@lru_cache(maxsize=32)
def court_scans(seed: int, **changes: float) -> tuple[Scans, Array, Array]:
    """Scans of a drive through the court, its dead reckoning and the truth in the level frame of its first pose."""
    robot = crawler_preset("light", **{"drift": 0.08, "max_range": 8.0, **changes})
    log = simulate_crawler(ring_hall(seed=seed), seed, robot)
    steps = make_steps(log, QUICK.steps)
    assert steps.truth is not None
    truth = steps.truth.interpolate(steps.times)
    g = group_of(truth)
    truth = g.between(np.broadcast_to(remove_roll_pitch(truth[0]), truth.shape), truth)
    return Scans.of(steps), chain_odometry(steps.odometry).poses, truth
