"""The study ``exits``: are exits honest on robots that nothing was fitted on?

A robot is drawn, wheels, gyro, attitude, laser and speed, and drives garages that are drawn in each run, with other
clutter and errors. The estimator is told what a data sheet says: the σ of the wheels, of their scale, of the gyro's
bias and of the attitude. Shares and walks of the exits' covariance stay those that the program has.

Worlds: ``robot-1`` to ``robot-6``, always the same six; ``robot-0``, that of the other studies.

Quantities
----------
``exit_nees`` of all four components (heading, x, y, z) of every exit; ``exit_nees_heading``, ``…_plan``, ``…_height``
by block, a degree of freedom. SegSLAM: of each settled segment; RBPF: where the whole log ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam.app.machine import one_blas_thread
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.random import SeedTree
from graphslam.sim.crawler_config import CrawlerConfig, crawler_preset
from graphslam_frontends.odometry.dead_reckoning import DeadReckoningNoise
from graphslam_studies import segslam_report as tables
from graphslam_studies.heights import exit_table
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy
from graphslam_studies.segslam_trial import LEVEL, QUICK, GridTrial, GridTrialConfig

FACTOR = {
    **{"wheel_sigma": 4.0, "wheel_scale": 4.0, "range_sigma": 4.0, "drop_out": 4.0},
    **{"gyro": 4.0, "gyro_bias_across": 4.0, "drift": 3.0, "attitude_sigma": 4.0, "attitude_bias": 4.0},
    **{"scan_rate": 1.6, "spin_rate": 1.6, "beams": 2.0, "speed": 2.0},
}
"""Figures of a robot are drawn between the default by this and the default times this; their logarithms are uniform."""


@dataclass(frozen=True, kw_only=True)
class ExitsTrialConfig:
    """A robot, and what is run on its logs."""

    grid: GridTrialConfig
    """Filters, and world."""
    robot: int = 1
    """Which robot is drawn."""


def drawn_robot(number: int, base: CrawlerConfig | None = None) -> tuple[CrawlerConfig, float]:
    """Robot ``number``, 0 being the ``base``, and its speed by that of a world's robot."""
    if number == 0:
        return CrawlerConfig() if base is None else base, 1.0
    rng = SeedTree(number).child("robot-of-exits").generator()
    c = CrawlerConfig() if base is None else base
    by = {name: float(np.exp(rng.uniform(-np.log(f), np.log(f)))) for name, f in FACTOR.items()}
    found = {name: getattr(c, name) * factor for name, factor in by.items() if name != "speed"}
    found["beams"] = round(found["beams"])
    return replace(c, **found), by["speed"]


def told(robot: CrawlerConfig) -> DeadReckoningNoise:
    """What the data sheets of a robot say, of which its log does not speak."""
    return DeadReckoningNoise(wheel=robot.wheel_sigma, wheel_scale=robot.wheel_scale, attitude_bias=robot.attitude_bias)


def run_exits_trial(config: ExitsTrialConfig, seed: int) -> list[Measurement]:
    """All figures of one run."""
    grid = config.grid
    robot, speed = drawn_robot(config.robot, grid.crawler)
    steps = replace(grid.steps, noise=told(robot))
    with one_blas_thread():
        return list(GridTrial(replace(grid, crawler=robot, speed=speed, steps=steps), seed).run())


_GARAGE = GridTrialConfig(
    world="garage", layout="drawn", algorithms=("rbpf-20", "segslam-20"), figures=("matches", "exits"), steps=LEVEL,
    crawler=crawler_preset("light"),
)  # fmt: skip
WORLDS = {f"robot-{n}": ExitsTrialConfig(grid=_GARAGE, robot=n) for n in range(7)}
QUICK_WORLDS = {
    "court-quick": ExitsTrialConfig(
        grid=replace(QUICK, algorithms=("rbpf-5", "segslam-5"), figures=("matches", "exits")), robot=1
    )
}


class ExitsStudy(WorldsStudy[ExitsTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_exits_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``exits``: NEES a degree of freedom by robot and block, with its interval over runs; ``inside``: the share of
        exits in their 95 % region; ``matches``."""
        return {
            "exits": exit_table(table),
            "inside": inside_table(table),
            "matches": tables.match_table(table),
        }

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """None."""
        return []


def inside_table(table: pd.DataFrame, probability: float = 0.95) -> pd.DataFrame:
    """Share of the exits of a robot inside the region that should hold ``probability`` of them."""
    out: list[tables.Row] = []
    for world, name in tables.cases(table):
        of = table[(table["world"] == world) & (table["algorithm"] == name) & (table["quantity"] == "exit_nees")]
        if len(of):
            inside = of["value"].to_numpy(dtype=np.float64) <= chi2_quantile(probability, 4)
            row: tables.Row = {"world": world, "algorithm": name, "runs": of["run"].nunique(), "exits": len(of)}
            out.append(row | {"inside": float(inside.mean())})
    return pd.DataFrame(out)


STUDY = ExitsStudy(
    "exits",
    "consistency of exits: random robots with data sheet noise in random garages, nothing tuned on them",
    WORLDS,
    QUICK_WORLDS,
    trials=10,
)
