"""The study ``segslam-mine``: nested loops, and two parallel galleries that must not be merged.

Worlds: ``mine``, ``mine-drawn`` (random layout); clutter and sensor errors are random in each run. Algorithms:
``dead-reckoning``, ``rbpf-20``, ``segslam-20``. In the study ``mine-particles`` the RBPF has up to 1,000 particles,
in the same runs.

Quantities, besides those of ``segslam-garage``
-----------------------------------------------
``visit_error``: for every path section that is driven twice, error of the relative position of the two visits, at the
end of the second [m]; for SegSLAM from a map sample that starts at that time.
``loops``: such sections driven in the same direction (the scanner points ahead, so it sees other surfaces on the way
back); ``loops_closed``: those with an error below 1 m; ``all_closed``. ``merged_parallels``: matches of one of two
parallel sections with the other. ``overlapping_parallels``: of the ``parallels`` pairs of such sections, those less
than half as far apart in the map as in truth. Timings: ``seconds_step_first_quarter`` and ``…_last_quarter``, mean time
of a step; ``maps_megabytes``.

Of the maps of all particles of an RBPF (``particle_paths`` different ones): ``loops_closed_fewest`` and ``…_most``,
``overlapping_parallels_fewest`` and ``…_most``, ``particle_visit_error_least`` and ``…_greatest`` of every loop.
``common_path``: share of the path before the last common ancestor of all particles. Means over the path, in every
study of grid front ends: ``survivors``, ancestors of the particles of the end; ``alternatives``, different pieces of
path: the survivors of an RBPF, the viable segments of SegSLAM.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd

from graphslam.plots.save import save_figure
from graphslam_frontends.segslam.config import SegmentCandidateConfig, SegSlamConfig
from graphslam_studies import segslam_report as tables
from graphslam_studies.plots.association import plot_runs
from graphslam_studies.segslam_garage import path_figure
from graphslam_studies.segslam_trial import DEAD_RECKONING, QUICK, Figure, GridStudy, GridTrialConfig

_FIGURES: tuple[Figure, ...] = ("matches", "exits", "loops", "path")
_ALGORITHMS = (DEAD_RECKONING, "rbpf-20", "segslam-20")
# Galleries are not above each other, so heights may drift: 2.4 m on the first loop with a gravity error of 6 mrad.
SEGSLAM = SegSlamConfig(winnowing=SegmentCandidateConfig(height_per_metre=7e-3))
_MINE = GridTrialConfig(world="mine", algorithms=_ALGORITHMS, figures=_FIGURES, segslam=SEGSLAM)
WORLDS = {"mine": _MINE, "mine-drawn": replace(_MINE, layout="drawn")}
_OF_PARTICLES = (
    *("loops_closed", "loops_closed_fewest", "loops_closed_most", "overlapping_parallels"),
    *("overlapping_parallels_fewest", "overlapping_parallels_most", "particle_paths", "common_path"),
    *("survivors", "alternatives"),
)
QUICK_WORLDS = {
    "court-quick": replace(QUICK, algorithms=(DEAD_RECKONING, "rbpf-5", "segslam-5"), figures=_FIGURES),
}
PARTICLE_WORLDS = {f"mine-{n}": replace(_MINE, algorithms=(f"rbpf-{n}",)) for n in (200, 500, 1000)}
PARTICLE_WORLDS["mine-20"] = replace(_MINE, algorithms=("rbpf-20", "segslam-20"))
"""Worlds with one number of particles each, so that trials are short; the runs are those of ``mine``."""


class SegSlamMine(GridStudy):
    """See the module."""

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``loops``, ``visits`` one by one, ``particles``, ``matches``, ``paths``, ``nees``, ``seconds`` by part."""
        out = {"loops": tables.loop_table(table, timings), "visits": visit_table(table)}
        out["particles"] = tables.means_table(table, _OF_PARTICLES)
        out["matches"] = tables.match_table(table)
        out["paths"] = tables.means_table(table, ("final_error", "ate_anchored", "ate_aligned", "maps_megabytes"))
        out["nees"] = tables.nees_table(table)
        if not timings.empty:
            out["seconds"] = tables.seconds_table(timings)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Errors at second visits of all runs; the path of one run by segments."""
        made = []
        visits = table[table["quantity"] == "visit_error"]
        if not visits.empty:
            worst = visits.groupby(["world", "run", "algorithm"], sort=False)["value"].max().reset_index()
            ax = plot_runs(worst, label="greatest error at a second visit [m]")
            made.append(save_figure(ax, folder / "visit_error.png"))
        for world in dict.fromkeys(table["world"].astype(str)):
            made += path_figure(table, world, folder)
        return made


def visit_table(table: pd.DataFrame) -> pd.DataFrame:
    """Median and maximum error of every second visit over the runs, and number of runs below the limit of 1 m."""
    rows = table[table["quantity"] == "visit_error"].rename(columns={"submap": "visit"})
    groups = rows.groupby(["world", "algorithm", "visit"], sort=False)["value"]
    out = groups.agg(["median", "max", "count"]).reset_index()
    out["closed"] = groups.agg(lambda v: int((v <= 1.0).sum())).to_numpy()
    return out


STUDY = SegSlamMine(
    "segslam-mine",
    "1.3 km of mine with loops within loops and parallel galleries: loops closed, galleries merged, cost of a step",
    WORLDS,
    QUICK_WORLDS,
)
PARTICLES = SegSlamMine(
    "mine-particles",
    "the mine with more particles of the RBPF, up to 1,000 as in the paper: loops closed, parallel galleries merged",
    PARTICLE_WORLDS,
    QUICK_WORLDS,
    trials=5,
)
