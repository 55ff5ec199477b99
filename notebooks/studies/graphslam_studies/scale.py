"""The study ``scale``: methods to relax a skeleton network, costs of approximations, convergence from bad starts.

Worlds: ``laps-…``: every method, started from dead reckoning; ``collapse-…``: wrong unions of landmarks, dropped links,
averaged traversals; ``stability-…``: increasing odometry heading errors without GPS and tilt, from dead reckoning:
relinearised, linearised once (information form), and links between pairs of poses computed once (Lu and Milios).
Times and memory by size are measured elsewhere (``tests/benchmarks/bench_scale.py``).

Quantities
----------
``gap`` to the minimum objective; ``chi2`` per degree of freedom; ``residual``: norm of the gradient over that at the
start; ``to_optimum``, ``to_truth``: rms distance of positions [m]; ``iterations``, ``products`` with the Schur
complement; ``split``: landmarks detected as wrong unions.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole
from graphslam_studies.scale_trial import ScaleTrialConfig, run_scale_trial
from graphslam_studies.sim.laps import LapsConfig

WORLDS = {
    "laps-2400": ScaleTrialConfig("methods", LapsConfig(poses=2400)),
    "collapse-10000": ScaleTrialConfig("approximations", LapsConfig(poses=10_000)),
    "stability-120": ScaleTrialConfig("stability", LapsConfig(poses=120, laps=3)),
    "stability-1000": ScaleTrialConfig("stability", LapsConfig(poses=1000, laps=4)),
}
QUICK_WORLDS = {
    "laps-240": ScaleTrialConfig("methods", LapsConfig(poses=240, laps=4, begin=4, reach=6)),
    "collapse-360": ScaleTrialConfig(
        "approximations", LapsConfig(poses=360, laps=6, begin=6, reach=6), wrong=(0.02,), kept=(0.1,)
    ),
    "stability-120": ScaleTrialConfig("stability", LapsConfig(poses=120, laps=3, begin=5), turns=(5e-4, 2e-2)),
}
QUANTITIES = ["chi2", "gap", "residual", "to_optimum", "to_truth", "iterations", "products", "landmarks", "split"]
DRAWN = {"to_optimum": "rms distance to the optimum [m]", "to_truth": "rms distance to ground truth [m]"}


class ScaleStudy(WorldsStudy[ScaleTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_scale_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """One table per world: means over the runs, one row per method; ``cpu``: time of the methods [s]."""
        out = {world: mean_table(table, world) for world in dict.fromkeys(table["world"])}
        if not timings.empty:
            out["cpu"] = timings.groupby(["world", "algorithm"], sort=False)["value"].mean().reset_index()
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Distances to optimum and ground truth of all runs."""
        return draw_runs(table, DRAWN, folder)


def mean_table(table: pd.DataFrame, world: str) -> pd.DataFrame:
    """Means over the runs of one world."""
    rows = []
    of = table[table["world"] == world]
    for name in dict.fromkeys(of["algorithm"]):
        mine = of[of["algorithm"] == name]
        row: dict[str, object] = {"method": name, "runs": mine["run"].nunique()}
        for q in QUANTITIES:
            values = whole(mine, q)["value"]
            if len(values):
                row[q] = float(values.mean())
        rows.append(row)
    return pd.DataFrame(rows)


STUDY = ScaleStudy(
    "scale",
    "skeleton networks: methods against each other, costs of the collapse, bad starts against linearised forms",
    WORLDS,
    QUICK_WORLDS,
    trials=3,
)
