"""The study ``smartloc``: accuracy and consistency of car positions from raw pseudoranges among high buildings.

The log is cut in two halves. Hyper-parameters of every algorithm are chosen on one half with its ground truth; the
other half is solved separately and scored: worlds ``first-to-second`` and ``second-to-first``. Errors are correlated
over minutes, so one solution of a half is not enough to compare settings: the training half is cut into windows, each
is solved separately, and their scores are pooled. From a grid of settings, the one with the smallest error is chosen
among those with NEES/n in [0.7, 1.4]; if there is none, the one with NEES/n closest to 1. Quick mode does the same with
a simulated street of two minutes and needs no recording.

Algorithms: ``naive`` uses the stated σ of every pseudorange; ``robust`` adds a Cauchy kernel; ``density`` also
increases σ as the carrier-to-noise density falls; ``gauss-markov`` also adds a time-correlated bias per satellite. All
use the same odometer and clock model.

Quantities
----------
``rmse`` [m] and ``nees`` (NEES/2) in the plane, on the scored half; ``rmse_chosen`` and ``nees_chosen`` on the
training half; ``sigma``: RMS over epochs of the estimated position σ [m]; ``east`` and ``north``: mean error [m]; and
the chosen settings by name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from graphslam.app.machine import one_blas_thread
from graphslam.core.errors import GraphSlamError
from graphslam.core.gnss import TangentPlane
from graphslam.core.log import SensorLog
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import DOWN
from graphslam.graph.noise import RobustKernel
from graphslam.io.catalog import load_recording
from graphslam.solve.batch import BatchSolver
from graphslam_studies import segslam_report as tables
from graphslam_studies.graph.gnss import PseudorangeConfig, add_odometer, add_pseudoranges, antenna_positions
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs
from graphslam_studies.sim.satellites import SatelliteConfig, simulate_satellites

CONSISTENT = (0.7, 1.4)
"""NEES/n that counts as consistent."""
LEVEL = 0.02
"""σ of roll and pitch of a car on a road [rad]."""
CAUCHY = "robust_width"
Settings = Mapping[str, float]

GRIDS: dict[str, dict[str, tuple[float, ...]]] = {
    "naive": {},
    "robust": {CAUCHY: (1.0, 2.385), "sigma_scale": (1.0, 5.0, 25.0)},
    "density": {CAUCHY: (1.0,), "density_scale": (10.0, 20.0), "sigma_scale": (1.0, 5.0)},
    "gauss-markov": {
        CAUCHY: (1.0,),
        "density_scale": (10.0, 20.0),
        "bias_sigma": (3.0, 5.0, 8.0),
        "bias_time": (15.0, 60.0),
        "bias_every": (1.0,),
    },
}
"""Algorithm → candidate values of every setting."""
QUICK_GRIDS: dict[str, dict[str, tuple[float, ...]]] = {
    "naive": {},
    "robust": {CAUCHY: (1.0,), "sigma_scale": (1.0, 5.0)},
    "density": {CAUCHY: (2.385,), "density_scale": (10.0,)},
    "gauss-markov": {CAUCHY: (2.385,), "density_scale": (10.0,), "bias_sigma": (2.5, 5.0), "bias_time": (15.0,)},
}


@dataclass(frozen=True, kw_only=True)
class SmartLocTrialConfig:
    """Log, scored half, and candidate settings."""

    scored: int = 1
    """0: the first half; 1: the second."""
    street: SatelliteConfig | None = None
    """A simulated street; None: the recorded log ``smartloc-gnss``."""
    grids: Mapping[str, Mapping[str, tuple[float, ...]]]
    windows: int = 4
    """Number of windows of the training half."""
    every: int = 5
    """Every n-th odometry record is scored."""


@dataclass(frozen=True)
class Score:
    """Scores of a solution against its reference, in the plane."""

    rmse: float
    nees: float
    sigma: float
    mean: tuple[float, float]

    @property
    def consistent(self) -> bool:
        """NEES/n inside :data:`CONSISTENT`."""
        return CONSISTENT[0] <= self.nees <= CONSISTENT[1]


def settings_of(grid: Mapping[str, tuple[float, ...]]) -> list[dict[str, float]]:
    """Every combination of a grid."""
    return [dict(zip(grid, values)) for values in product(*grid.values())]


def config_of(settings: Settings) -> PseudorangeConfig:
    """Pseudorange options from settings."""
    rest = {k: v for k, v in settings.items() if k != CAUCHY}
    robust = RobustKernel("cauchy", settings[CAUCHY]) if CAUCHY in settings else RobustKernel()
    return PseudorangeConfig(**rest, robust=robust)


def solve_street(log: SensorLog, config: PseudorangeConfig) -> FactorGraph:
    """The optimised graph of a log: a node at every odometry record, with priors that the car is level."""
    graph = FactorGraph(3)
    nodes = add_odometer(graph, log["odometry"])
    for node in nodes[::5].tolist():
        graph.add_attitude(node, DOWN, LEVEL, evidence="prior")
    ranges, times = log["pseudoranges"], log["odometry"].times
    nearest = np.clip(np.searchsorted(times, ranges.times), 0, len(times) - 1)
    at = np.where(times[nearest] == ranges.times, nodes[nearest], -1)
    add_pseudoranges(graph, ranges, TangentPlane(*log.meta["plane"]), at, config=config)
    BatchSolver(graph).update()
    return graph


Errors = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def errors(log: SensorLog, graph: FactorGraph, every: int) -> Errors:
    """Errors ``(k, 2)`` [m] of the antenna in the plane at every n-th odometry record, and their covariances."""
    times, reference = log["odometry"].times, log["reference"]
    k = np.arange(0, len(times), every)
    k = k[(times[k] >= reference.times[0]) & (times[k] <= reference.times[-1])]
    y, P = antenna_positions(graph, k, log["pseudoranges"].lever)
    return (y - reference.interpolate(times[k])[:, :3])[:, :2], P[:, :2, :2]


def score_of(parts: Sequence[Errors]) -> Score:
    """Pooled score of several solutions."""
    e, C = (np.concatenate(a) for a in zip(*parts))
    nees = np.einsum("ki,ki->k", e, np.linalg.solve(C, e[..., None])[..., 0])
    rmse, sigma = np.sqrt(np.mean(np.sum(e**2, axis=1))), np.sqrt(np.mean(np.trace(C, axis1=1, axis2=2)))
    east, north = e.mean(axis=0).tolist()
    return Score(float(rmse), float(np.mean(nees) / 2.0), float(sigma), (east, north))


def scored(logs: Sequence[SensorLog], settings: Settings, every: int) -> Score:
    """Solve every log separately, and pool their scores."""
    return score_of([errors(log, solve_street(log, config_of(settings)), every) for log in logs])


def windows(log: SensorLog, count: int) -> list[SensorLog]:
    """Cut a log into windows with about equal numbers of odometry records, without overlap."""
    t = log["odometry"].times
    first = np.linspace(0, len(t), count + 1).astype(int)
    return [log.slice(float(t[a]), float(t[b - 1])) for a, b in pairwise(first)]


def chosen(
    logs: Sequence[SensorLog], grid: Mapping[str, tuple[float, ...]], every: int
) -> tuple[dict[str, float], Score]:
    """The best settings of a grid on some logs, and their score there; the criterion is described in the module."""
    found: list[tuple[dict[str, float], Score]] = []
    for settings in settings_of(grid):
        try:
            found.append((settings, scored(logs, settings, every)))
        except GraphSlamError:  # settings without a solution are not chosen
            continue
    if not found:
        raise GraphSlamError(f"no settings of {dict(grid)} have a solution")
    consistent = [f for f in found if f[1].consistent]
    if consistent:
        return min(consistent, key=lambda f: f[1].rmse)
    return min(found, key=lambda f: abs(np.log(f[1].nees)))


def run_smartloc_trial(config: SmartLocTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        return list(_figures(config, seed))


def _figures(config: SmartLocTrialConfig, seed: int) -> Iterator[Measurement]:
    log = load_recording("smartloc-gnss") if config.street is None else simulate_satellites(seed, config.street)
    halves = windows(log, 2)
    test, training = halves[config.scored], windows(halves[1 - config.scored], config.windows)
    for name, grid in config.grids.items():
        start = process_time()
        settings, there = chosen(training, grid, config.every)
        here = scored([test], settings, config.every)
        values: dict[str, Any] = {
            "rmse": here.rmse, "nees": here.nees, "sigma": here.sigma, "east": here.mean[0], "north": here.mean[1],
            "rmse_chosen": there.rmse, "nees_chosen": there.nees, **settings,
        }  # fmt: skip
        for quantity, value in values.items():
            yield Measurement(name, quantity, float(value))
        yield Measurement(name, "seconds", process_time() - start, timing=True)


class SmartLocStudy(WorldsStudy[SmartLocTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_smartloc_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``scores``: error and NEES on the scored half and on the training half; ``chosen`` settings; ``cpu``."""
        names = ["rmse", "nees", "sigma", "east", "north", "rmse_chosen", "nees_chosen"]
        wide = table.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", sort=False)
        settings = [c for c in (CAUCHY, "sigma_scale", "density_scale", "bias_sigma", "bias_time") if c in wide]
        out = {"scores": wide[names].reset_index(), "chosen": wide[settings].reset_index()}
        if not timings.empty:
            out["cpu"] = tables.seconds_table(timings)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Error and NEES of all runs."""
        return draw_runs(table, {"rmse": "error in the plane [m]", "nees": "NEES/n"}, folder)


_RECORDED = SmartLocTrialConfig(grids=GRIDS)
STUDY = SmartLocStudy(
    "smartloc",
    "raw pseudoranges among high buildings: error and consistency, hyper-parameters chosen on the other half of the "
    "log",
    {"first-to-second": _RECORDED, "second-to-first": replace(_RECORDED, scored=0)},
    {"street": SmartLocTrialConfig(street=SatelliteConfig(), grids=QUICK_GRIDS, windows=2, every=3)},
    trials=1,
)
