"""The study ``heights``: height errors of particle filters with two likelihoods.

End points on floors and ceilings bias a particle filter on ramps. Here every run is filtered twice, with the same
world, robot, errors and seed: with the end points of all beams (``endpoint``), and with those on vertical surfaces plus
some ray casts (``upright``). Metrics are those of the filters, without graph and refinement; in worlds ``…-refined``
the graph and the refined path are scored too.

Worlds: ``garage-drawn``, random layout and robot in each run; the garages ``garage-B`` and ``garage-D``; ``building``.

Quantities
----------
``climb_up``, ``climb_down``: mean relative error of the climb of the ramps of a run, positive if too steep; ``…_size``:
mean absolute value. ``height_rmse``, anchored at the start, and ``height_std``, about the mean [m].
``ate_aligned`` and, in the plane, ``ate_plan`` [m], ``heading_rms`` [rad], ``final_error`` [m]. Of the exits of
SegSLAM ``exit_nees`` and its blocks ``exit_nees_heading``, ``…_plan``, ``…_height``. ``rounds`` of the refinement.
Timings: ``cpu``, of a filter with its preparation; ``cpu_share`` of a refinement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from graphslam.app.machine import one_blas_thread
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.random import SeedTree
from graphslam_studies import segslam_report as tables
from graphslam_studies.evaluate.intervals import grouped_mean_interval, mean_interval
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole
from graphslam_studies.refinement_trial import RefinementTrial, RefinementTrialConfig, drawn_garage
from graphslam_studies.segmap_trial import GraphTrialConfig
from graphslam_studies.segslam_building import SEGSLAM as BUILDING
from graphslam_studies.segslam_trial import LEVEL, QUICK, Figure, GridTrial, GridTrialConfig

Likelihood = Literal["endpoint", "cast", "upright"]
PAIR: tuple[Likelihood, Likelihood] = ("endpoint", "upright")
"""Reference and alternative."""


@dataclass(frozen=True, kw_only=True)
class HeightsTrialConfig:
    """A world, and settings of its runs."""

    grid: GridTrialConfig
    """World, robot, steps, filters; the study sets their likelihood."""
    drawn: bool = False
    """Random robot and layout of the garage."""
    refined: bool = False
    """Also make a graph of the settled segments of SegSLAM, and refine its path by the scans."""


def run_heights_trial(config: HeightsTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run, with both likelihoods."""
    with one_blas_thread():
        grid = drawn_garage(config.grid, seed) if config.drawn else config.grid
        trial: GridTrial
        if config.refined:
            graph = GraphTrialConfig(grid=grid)
            trial = RefinementTrial(grid, seed, graph=graph, study=RefinementTrialConfig(graph=graph))
        else:
            trial = GridTrial(grid, seed)
        return list(both(trial))


def both(trial: GridTrial) -> Iterator[Measurement]:
    """Metrics of all algorithms of a trial with each likelihood, whose name is appended to the algorithm."""
    grid = trial.config
    for likelihood in PAIR:
        weigh = [replace(filter, likelihood=likelihood) for filter in (grid.filter, grid.segslam_filter)]
        trial.config = replace(grid, filter=weigh[0], segslam_filter=weigh[1])
        for m in trial.run():
            if m.algorithm != "all":
                yield replace(m, algorithm=f"{m.algorithm} {likelihood}")
            elif likelihood == PAIR[0]:
                yield m


_FIGURES: tuple[Figure, ...] = ("matches", "exits", "climbs")
_GARAGE = GridTrialConfig(
    world="garage", layout="B", algorithms=("rbpf-20", "segslam-20"), figures=_FIGURES, steps=LEVEL
)
_SEGSLAM = replace(_GARAGE, algorithms=("segslam-20",), samples=1)
_BUILDING = replace(_GARAGE, world="building", layout=None, segslam=BUILDING)
WORLDS = {
    "garage-drawn": HeightsTrialConfig(grid=_GARAGE, drawn=True),
    "garage-drawn-refined": HeightsTrialConfig(grid=_SEGSLAM, drawn=True, refined=True),
    "garage-B": HeightsTrialConfig(grid=_GARAGE),
    "garage-D": HeightsTrialConfig(grid=replace(_GARAGE, layout="D")),
    "building": HeightsTrialConfig(grid=replace(_BUILDING, figures=(*_FIGURES, "legs"))),
}
_QUICK = replace(QUICK, algorithms=("rbpf-5", "segslam-5"), figures=_FIGURES)
QUICK_WORLDS = {"court-quick": HeightsTrialConfig(grid=_QUICK)}
COMPARED = (
    *("climb_up", "climb_down", "climb_up_size", "climb_down_size", "height_rmse", "height_std"),
    *("ate_aligned", "ate_plan", "heading_rms", "final_error", "leg_angle", "ate_start", "rounds"),
)
BLOCKS = {"": "all", "_heading": "heading", "_plan": "plan", "_height": "height"}
DRAWN = {"height_rmse": "height, RMS from the start [m]", "ate_plan": "ATE seen from above, aligned [m]"}


class HeightsStudy(WorldsStudy[HeightsTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_heights_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``pairs``: paired comparison; ``exits`` by block; ``errors`` of exits; ``cost``: CPU time; ``matches``."""
        out = {"pairs": pair_table(table, COMPARED), "exits": exit_table(table), "errors": tables.exit_table(table)}
        out["matches"] = tables.match_table(table)
        if not timings.empty:
            out["cost"] = pair_table(timings, ("seconds_cpu", "cpu_share"))
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Height errors and errors in the plane of all runs."""
        return draw_runs(table, DRAWN, folder)


def pair_table(table: pd.DataFrame, quantities: tuple[str, ...]) -> pd.DataFrame:
    """Mean of a metric with each likelihood over the runs that have both, and of the difference with its 95 % interval.

    ``less``: number of runs in which the alternative is smaller.
    """
    old, new = PAIR
    out: list[tables.Row] = []
    for quantity in quantities:
        rows = whole(table, quantity)
        split = rows["algorithm"].astype(str).str.rsplit(" ", n=1)
        rows = rows.assign(kind=split.str[0], likelihood=split.str[-1])
        for (world, kind), of in rows.groupby(["world", "kind"], sort=False):
            wide = of.pivot(index="run", columns="likelihood", values="value")
            if old not in wide or new not in wide:
                continue
            pair = wide[[old, new]].dropna().to_numpy(dtype=np.float64)
            if len(pair):
                mean, low, high = mean_interval(pair[:, 1] - pair[:, 0])
                row: tables.Row = {"quantity": quantity, "world": world, "algorithm": kind, "runs": len(pair)}
                row |= {old: float(pair[:, 0].mean()), new: float(pair[:, 1].mean())}
                row |= {"difference": mean, "low": low, "high": high, "less": int(np.sum(pair[:, 1] < pair[:, 0]))}
                out.append(row)
    return pd.DataFrame(out)


def exit_table(table: pd.DataFrame) -> pd.DataFrame:
    """NEES per degree of freedom of the exits by block, with 95 % interval, and 95 % bounds of consistent exits."""
    out: list[tables.Row] = []
    for world, name in tables.cases(table):
        of = table[(table["world"] == world) & (table["algorithm"] == name)]
        dof = {"": 4, "_heading": 1, "_plan": 2, "_height": 1}
        for suffix, block in BLOCKS.items():
            rows = of[of["quantity"] == f"exit_nees{suffix}"]
            if rows.empty:
                continue
            values = rows["value"].to_numpy(dtype=np.float64) / (dof[suffix] if not suffix else 1)
            rng = SeedTree(0).child("report", "exits").generator()
            mean, low, high = grouped_mean_interval(values, rows["run"].to_numpy(), rng)
            a, b = chi2_mean_bounds(dof[suffix], len(values))
            row: tables.Row = {"world": world, "algorithm": name, "block": block, "exits": len(values), "nees": mean}
            row |= {"low": low, "high": high, "honest_low": a / dof[suffix], "honest_high": b / dof[suffix]}
            out.append(row)
    return pd.DataFrame(out)


STUDY = HeightsStudy(
    "heights",
    "floors where they are: filters weighed by end points of all beams, or of upright surfaces with casts, in pairs",
    WORLDS,
    QUICK_WORLDS,
)
