"""The study ``exits``: consistency of exits (end poses of submaps) of robots that were not used for tuning.

A robot has random parameters (wheels, gyro, attitude, laser, speed) and drives in garages with random layout, clutter
and errors in each run. The estimator gets data-sheet values: σ of the wheels, of their scale and of the attitude bias.
The parameters of the exit covariance are the defaults.

Worlds: ``robot-1`` to ``robot-6``, six fixed random robots; ``robot-0``, the robot of the other studies.

Quantities
----------
``exit_nees`` of all four components (heading, x, y, z) of every exit; ``exit_nees_heading``, ``…_plan``, ``…_height``
by block, per degree of freedom. SegSLAM: of each settled segment; RBPF: of the end pose of the log.
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
"""Parameters are log-uniform between the default divided by this factor and the default times this factor."""


@dataclass(frozen=True, kw_only=True)
class ExitsTrialConfig:
    """A robot, and the settings of its runs."""

    grid: GridTrialConfig
    """World and filters."""
    robot: int = 1
    """Number of the random robot; 0: default robot."""


def drawn_robot(number: int, base: CrawlerConfig | None = None) -> tuple[CrawlerConfig, float]:
    """Random robot ``number`` (0: the ``base``), and the factor on its speed."""
    if number == 0:
        return CrawlerConfig() if base is None else base, 1.0
    rng = SeedTree(number).child("robot-of-exits").generator()
    c = CrawlerConfig() if base is None else base
    by = {name: float(np.exp(rng.uniform(-np.log(f), np.log(f)))) for name, f in FACTOR.items()}
    found = {name: getattr(c, name) * factor for name, factor in by.items() if name != "speed"}
    found["beams"] = round(found["beams"])
    return replace(c, **found), by["speed"]


def assumed_noise(robot: CrawlerConfig) -> DeadReckoningNoise:
    """Noise parameters from the data sheet of a robot, which are not in its log."""
    return DeadReckoningNoise(wheel=robot.wheel_sigma, wheel_scale=robot.wheel_scale, attitude_bias=robot.attitude_bias)


def run_exits_trial(config: ExitsTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    grid = config.grid
    robot, speed = drawn_robot(config.robot, grid.crawler)
    steps = replace(grid.steps, noise=assumed_noise(robot))
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
        """``exits``: NEES per degree of freedom by robot and block, with its interval over runs; ``inside``: share of
        exits in their 95 % region; ``matches``."""
        return {
            "exits": exit_table(table),
            "inside": inside_table(table),
            "matches": tables.match_table(table),
        }

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """No plots."""
        return []


def inside_table(table: pd.DataFrame, probability: float = 0.95) -> pd.DataFrame:
    """Share of the exits of a robot inside their confidence region of ``probability``."""
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
