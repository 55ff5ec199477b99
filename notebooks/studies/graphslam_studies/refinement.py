"""The study ``refinement``: accuracy, consistency and robustness of the path after refinement by scans.

Worlds: two garages, the mine (one and two rounds), the building; ``garage-drawn``: random layouts and robots in each
run, with wrong loop closures in the initial graph, and robot faults. Clutter and sensor errors are random in each run.

Quantities
----------
``ate_start``, ``ate_aligned``, ``height_rmse``, ``heading_rms`` of the path; ``worse``: 1 if the refined path was
accepted and has a larger error than its start. ``nees…``: NEES per degree of freedom, mean over the steps, relative to
the first pose, and by block; ``nees_relative``: over 30 s. ``entropy_min``: entropy of all scans along the path; of
SegSLAM the minimum over its map samples. ``cpu_share``: CPU time over the duration of the log.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam_studies import segslam_report as tables
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs
from graphslam_studies.refinement_trial import FAULTS, RefinementTrialConfig, run_refinement_trial
from graphslam_studies.segmap_graph import QUICK_WORLDS as GRAPH_QUICK
from graphslam_studies.segmap_graph import WORLDS as GRAPH_WORLDS
from graphslam_studies.segmap_trial import GraphTrialConfig


def _alone(config: GraphTrialConfig) -> GraphTrialConfig:
    """The same with SegSLAM only."""
    grid = config.grid
    return replace(config, grid=replace(grid, algorithms=tuple(a for a in grid.algorithms if a.startswith("segslam"))))


WORLDS = {name: RefinementTrialConfig(graph=_alone(config)) for name, config in GRAPH_WORLDS.items()}
WORLDS["garage-drawn"] = RefinementTrialConfig(
    graph=WORLDS["garage-B"].graph, drawn=True, wrong=(1, 3, 10), faults=FAULTS
)
WORLDS["mine-twice"] = replace(
    WORLDS["mine"],
    graph=replace(WORLDS["mine"].graph, grid=replace(WORLDS["mine"].graph.grid, layout="twice", figures=(), samples=1)),
)
QUICK_WORLDS = {"court-quick": RefinementTrialConfig(graph=_alone(GRAPH_QUICK["court-quick"]), wrong=(1,))}
DRAWN = {"ate_aligned": "ATE, aligned [m]", "nees": "NEES/dof, from the start", "entropy_min": "entropy [nat m³]"}
NEES = ("nees", "nees_level", "nees_heading", "nees_plan", "nees_height", "nees_relative")


class RefinementStudy(WorldsStudy[RefinementTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_refinement_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``paths``, ``nees`` by block, ``gains`` of the refined path over its start and over map samples, ``cpu``."""
        quantities = ("ate_start", "ate_aligned", "height_rmse", "heading_rms", "final_error", "leg_angle", "agreement")
        out = {"paths": tables.means_table(table, quantities), "nees": tables.means_table(table, NEES)}
        out["gains"] = gain_table(table)
        if not timings.empty:
            out["cpu"] = tables.seconds_table(timings)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Errors, NEES and entropies of all runs."""
        return draw_runs(table, DRAWN, folder)


def gain_table(table: pd.DataFrame) -> pd.DataFrame:
    """Each refinement: mean and worst error, runs worse than their start, share with less entropy than the samples."""
    out: list[tables.Row] = []
    for world, kind in tables.cases(table):
        ate = tables.values(table, world, kind, "ate_aligned")
        start = tables.values(table, world, kind, "ate_start")
        if not len(start):
            continue
        row: tables.Row = {"world": world, "algorithm": kind, "runs": len(ate), "start": float(start.mean())}
        row |= {"ate": float(ate.mean()), "ate_max": float(ate.max())}
        row["worse"] = int(tables.values(table, world, kind, "worse").sum())
        samples = [a for w, a in tables.cases(table) if w == world and a.startswith("segslam")]
        mine = tables.values(table, world, kind, "entropy_min")
        theirs = tables.values(table, world, samples[-1], "entropy_min") if samples else mine[:0]
        row["clearer_than_samples"] = float(np.mean(mine < theirs)) if len(mine) == len(theirs) > 0 else np.nan
        out.append(row)
    return pd.DataFrame(out)


STUDY = RefinementStudy(
    "refinement",
    "the solved path refined by its scans: errors, consistency, wrong loops in the start, robots never tuned on",
    WORLDS,
    QUICK_WORLDS,
    trials=10,
)
