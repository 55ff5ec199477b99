"""The study ``segmap-graph``: from the SegMap to one graph: accuracy, entropy and consistency.

Worlds: two garages, the mine, the building; clutter and sensor errors are random in each run. Algorithms: ``rbpf-40``,
``segslam-20`` (in the building 40), and the graphs ``chain``, ``matches``, ``overlaps``, ``loops``, ``gps`` and
``clearest`` of the settled segments of SegSLAM (:mod:`graphslam_studies.segmap_trial`).

Quantities
----------
``ate_aligned``, ``height_rmse``, ``final_error`` of the path [m]; of SegSLAM also ``ate_best_sample``, the minimum
over the map samples. ``entropy_min``: entropy of all scans along the path [nat m³], of filters the minimum over their
samples. ``nees_…``: NEES per degree of freedom of the body poses at the nodes, mean over a run (``…_last``: at its
end).
``loops_measured``: registrations that passed their gates, ``…_right``: right ones; ``loops_taken`` and
``loops_taken_right``: those in the graph. ``chi2_per_dof`` of the graph. ``leg_angle``: RMS error of the angles between
straight path sections on different levels [rad].
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam.core.gaussian import chi2_mean_bounds
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_studies import segslam_report as tables
from graphslam_studies.montecarlo.worlds_study import draw_runs
from graphslam_studies.segmap_trial import GraphStudy, GraphTrialConfig
from graphslam_studies.segslam_building import SEGSLAM as BUILDING
from graphslam_studies.segslam_mine import SEGSLAM as MINE
from graphslam_studies.segslam_trial import LEVEL, QUICK, Figure, GridTrialConfig

_FIGURES: tuple[Figure, ...] = ("matches", "entropy")
_GARAGE = GridTrialConfig(
    world="garage", layout="B", algorithms=("rbpf-40", "segslam-20"), figures=_FIGURES, samples=20, steps=LEVEL
)
WORLDS = {
    "garage-B": GraphTrialConfig(grid=_GARAGE),
    "garage-D": GraphTrialConfig(grid=replace(_GARAGE, layout="D")),
    "mine": GraphTrialConfig(
        grid=GridTrialConfig(
            world="mine", algorithms=("rbpf-40", "segslam-20"), figures=_FIGURES, samples=20, segslam=MINE
        )
    ),
    "building": GraphTrialConfig(
        grid=GridTrialConfig(
            world="building",
            algorithms=("rbpf-40", "segslam-40"),
            figures=(*_FIGURES, "legs"),
            samples=20,
            placements=4,
            segslam=BUILDING,
            steps=LEVEL,
        )
    ),
}
# The robot of the small world has three times the drift per second, and turns more.
_COURT = FilterDrift(heading_walk=0.02, position_walk=0.03)
QUICK_WORLDS = {
    "court-quick": GraphTrialConfig(
        grid=replace(QUICK, algorithms=("rbpf-5", "segslam-5"), figures=(*_FIGURES, "legs"), samples=3, drift=_COURT),
        spacing=1.5,
    )
}
BLOCKS = ("position", "heading", "pose", "level")
DRAWN = {"ate_aligned": "ATE, aligned [m]", "entropy_min": "entropy [nat m³]"}


class SegMapGraph(GraphStudy):
    """See the module."""

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``paths``, ``gains`` of the graph over samples, ``nees`` by block, ``loops``, ``seconds``."""
        quantities = (
            "ate_aligned",
            "ate_best_sample",
            "height_rmse",
            "final_error",
            "entropy_min",
            "leg_angle",
            "chi2_per_dof",
        )
        out = {
            "paths": tables.means_table(table, quantities),
            "gains": gain_table(table),
            "nees": nees_table(table),
            "loops": decision_table(table),
        }
        if not timings.empty:
            out["seconds"] = tables.seconds_table(timings)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Errors and entropies of all runs."""
        return draw_runs(table, DRAWN, folder)


def gain_table(table: pd.DataFrame) -> pd.DataFrame:
    """The graph with all loops compared with the map samples of SegSLAM, run by run."""
    out: list[tables.Row] = []
    for world in dict.fromkeys(table["world"].astype(str)):
        filters = [a for w, a in tables.cases(table) if w == world and a.startswith("segslam")]
        rivals = [a for w, a in tables.cases(table) if w == world and a.startswith("rbpf")]
        ours = tables.values(table, world, "loops", "ate_aligned")
        if not filters or not len(ours):
            continue
        best = tables.values(table, world, filters[-1], "ate_best_sample")
        row: tables.Row = {"world": world, "runs": len(ours), "ate": float(ours.mean()), "ate_max": float(ours.max())}
        row["sample"] = float(tables.values(table, world, filters[-1], "ate_aligned").mean())
        row["best_sample"] = float(best.mean())
        row["ratio_to_best"] = float(ours.mean() / best.mean())
        row["below_half"] = float(np.mean(ours <= 0.5 * best))
        clear = tables.values(table, world, "clearest", "entropy_min")
        for name in (filters[-1], *rivals):
            other = tables.values(table, world, name, "entropy_min")
            if len(other) == len(clear) > 0:
                row[f"clearer_than_{name.partition('-')[0]}"] = float(np.mean(clear < other))
        out.append(row)
    return pd.DataFrame(out)


def nees_table(table: pd.DataFrame) -> pd.DataFrame:
    """NEES per degree of freedom by block: mean over runs, and at the end with 95 % bounds of consistent graphs."""
    dof = {"position": 3, "heading": 1, "pose": 4, "level": 2}
    out: list[tables.Row] = []
    for world, name in tables.cases(table):
        for block in BLOCKS:
            mean, last = (tables.values(table, world, name, f"nees_{block}{end}") for end in ("", "_last"))
            if not len(mean):
                continue
            low, high = chi2_mean_bounds(dof[block], len(last))
            out.append(
                {
                    "world": world, "algorithm": name, "block": block, "runs": len(mean), "mean": float(mean.mean()),
                    "last": float(last.mean()), "honest_low": low / dof[block], "honest_high": high / dof[block],
                }
            )  # fmt: skip
    return pd.DataFrame(out)


def decision_table(table: pd.DataFrame) -> pd.DataFrame:
    """Loop closures over all runs: numbers measured and accepted, and how many of these are right."""
    quantities = ("loops_tried", "loops_measured", "loops_measured_right", "loops_taken", "loops_taken_right")
    out: list[tables.Row] = []
    for world, name in tables.cases(table):
        counts = {q: tables.values(table, world, name, q) for q in quantities}
        if not len(counts["loops_taken"]):
            continue
        row: tables.Row = {"world": world, "algorithm": name, "runs": len(counts["loops_taken"])}
        sums = {q: float(v.sum()) for q, v in counts.items()}
        row |= {q.removeprefix("loops_"): int(v) for q, v in sums.items()}
        row["precision"] = sums["loops_taken_right"] / sums["loops_taken"] if sums["loops_taken"] else np.nan
        right = sums["loops_measured_right"]
        row["recall"] = sums["loops_taken_right"] / right if right else np.nan
        out.append(row)
    return pd.DataFrame(out)


STUDY = SegMapGraph(
    "segmap-graph",
    "from the SegMap to one graph: paths, entropies, consistency of nodes and decisions on loops, beside the filters",
    WORLDS,
    QUICK_WORLDS,
)
