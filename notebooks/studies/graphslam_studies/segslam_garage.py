"""The study ``segslam-garage``: loop closing over two levels of a garage, by number of particles, and run time.

Worlds: the garages ``garage-A`` to ``garage-D`` (the last was not used for tuning), and ``garage-drawn``, with a random
plan in each run. Parked cars, clutter and sensor errors are random in all of them.

Algorithms: ``dead-reckoning``; ``rbpf-N``, one filter over the whole log; ``segslam-N``. N particles; both use the same
steps.

Quantities
----------
``final_error`` [m], ``final_yaw`` [rad]: error of the last pose relative to the first; ``ate_anchored`` with the first
poses aligned, ``ate_aligned`` after a rigid alignment of all [m]. ``matches``: matches with older maps, by segment,
also of extinct particles; ``false_matches``: those with an error above 1 m or 5° of heading, relative to the closest
pose in the old map; ``false_match_weight``: the largest weight of one. ``segments``: total number closed; ``intervals``
between boundaries. Per settled segment ``exit_nees`` (particles and drift model), ``exit_nees_stated``
(particles and motion noise model), ``exit_nees_matched`` (moment matching), of ``exit_dof`` degrees of
freedom; its errors ``exit_yaw`` [rad], ``exit_x``, ``exit_y``, ``exit_z`` [m]; ``exit_length`` [m]. ``entropy`` of one
map of all scans along the estimated path [nat m³]. ``effective_median``: N_eff / N. ``path_…``: points of the path, for
the plot. Timings: ``seconds_…`` by part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam.core.errors import UnknownNameError
from graphslam.plots.save import save_figure
from graphslam.plots.segments import plot_segments
from graphslam_studies import segslam_report as tables
from graphslam_studies.montecarlo.worlds_study import draw_runs
from graphslam_studies.plots.segslam_study import Curve, plot_by_particles
from graphslam_studies.segslam_trial import (
    DEAD_RECKONING,
    LEVEL,
    QUICK,
    Figure,
    GridStudy,
    GridTrialConfig,
    family_of,
)

NUMBERS = (1, 5, 10, 20, 40, 100)
_FIGURES: tuple[Figure, ...] = ("matches", "exits", "entropy", "path")


def _algorithms(numbers: tuple[int, ...]) -> tuple[str, ...]:
    return (DEAD_RECKONING, *(f"{family}-{n}" for n in numbers for family in ("rbpf", "segslam")))


WORLDS = {
    f"garage-{layout}": GridTrialConfig(
        world="garage", layout=layout, algorithms=_algorithms(NUMBERS), figures=_FIGURES, steps=LEVEL
    )
    for layout in ("A", "B", "C", "D", "drawn")
}
QUICK_WORLDS = {
    "court-quick": replace(QUICK, algorithms=(DEAD_RECKONING, "rbpf-5", "segslam-1", "segslam-5"), figures=_FIGURES)
}


class SegSlamGarage(GridStudy):
    """See the module."""

    def settings(self, world: str) -> GridTrialConfig:
        """World, robot and filters of a trial."""
        known = {**WORLDS, **QUICK_WORLDS}
        if world not in known:
            raise UnknownNameError("world", world, known)
        return known[world]

    def error_curves(self, table: pd.DataFrame, world: str) -> Iterator[tuple[str, Curve]]:
        """See :func:`error_curves`."""
        return error_curves(table, world)

    def time_curves(self, table: pd.DataFrame, timings: pd.DataFrame, world: str) -> Iterator[tuple[str, Curve]]:
        """See :func:`time_curves`."""
        return time_curves(table, timings, world)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``errors`` (Table II), ``ratios`` of means, ``times`` (Table III), ``nees``, ``exits``, ``matches``,
        ``paths``, ``seconds`` by part."""
        out = {"errors": tables.error_table(table), "ratios": tables.ratio_table(table)}
        if not timings.empty:
            out["times"] = tables.time_table(table, timings)
            out["seconds"] = tables.seconds_table(timings)
        out["nees"] = tables.nees_table(table)
        out["exits"] = tables.exit_table(table)
        out["matches"] = tables.match_table(table)
        quantities = ("final_error", "final_yaw", "ate_anchored", "ate_aligned", "entropy", "maps_megabytes")
        out["paths"] = tables.means_table(table, quantities)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """For every world: error and run time by particles, and path of one run by segments; errors of all runs."""
        made = []
        for world in dict.fromkeys(table["world"].astype(str)):
            errors = tables.error_table(table)
            lost = errors[(errors["world"] == world) & (errors["algorithm"] == DEAD_RECKONING)]["mean"]
            reference = (
                (float(lost.iloc[0]), "dead reckoning, mean") if len(lost) and np.isfinite(lost.iloc[0]) else None
            )
            curves = dict(error_curves(table, world))
            if curves:
                ax = plot_by_particles(
                    None, curves, label="error at the end [m]", title=world, reference=reference,
                    limit=(tables.GOOD, f"closed below {tables.GOOD:g} m"),
                )  # fmt: skip
                made.append(save_figure(ax, folder / f"{world}-error.png"))
            seconds = dict(time_curves(table, timings, world))
            if seconds:
                ax = plot_by_particles(None, seconds, label="run time [s]", title=world)
                made.append(save_figure(ax, folder / f"{world}-seconds.png"))
            made += path_figure(table, world, folder)
        return made + draw_runs(table, {"final_error": "error at the end [m]"}, folder)


def error_curves(table: pd.DataFrame, world: str) -> Iterator[tuple[str, Curve]]:
    """Mean final error of each family by particles, with interval, all runs, and means of the paper."""
    errors = tables.error_table(table)
    errors = errors[(errors["world"] == world) & (errors["particles"] > 0) & errors["mean"].notna()]
    for family, part in errors.groupby("family", sort=True):
        rows = part.sort_values("particles")
        n = rows["particles"].to_numpy()
        points = {int(k): tables.values(table, world, f"{family}-{k}", "final_error") for k in n}
        least = 0.5 * min(float(v.min()) for v in points.values())  # positive, because the axis is logarithmic
        yield (
            str(family),
            Curve(
                particles=n.astype(np.float64),
                values=rows["mean"].to_numpy(dtype=np.float64),
                low=np.maximum(rows["mean_low"].to_numpy(dtype=np.float64), least),
                high=rows["mean_high"].to_numpy(dtype=np.float64),
                points=points,
                paper=rows["paper_mean"].to_numpy(dtype=np.float64) if world.startswith("garage") else None,
            ),
        )


def time_curves(table: pd.DataFrame, timings: pd.DataFrame, world: str) -> Iterator[tuple[str, Curve]]:
    """Minimum run time of each family by particles; all runs."""
    names = [a for w, a in tables.cases(table) if w == world]
    for family in ("rbpf", "segslam"):
        found = {}
        for name in names:
            seconds = tables.values(timings, world, name, "seconds_total")
            if family_of(name)[0] == family and len(seconds):
                found[family_of(name)[1]] = seconds
        n = np.array(sorted(found), dtype=np.float64)
        if len(n):
            yield family, Curve(particles=n, values=np.array([found[int(k)].min() for k in n]), points=found)


def path_figure(table: pd.DataFrame, world: str, folder: Path) -> list[Path]:
    """Plot the stored path of the first run, one colour per segment; no plot if none is stored."""
    of = table[(table["world"] == world) & table["quantity"].str.startswith("path_") & (table["submap"] >= 0)]
    if of.empty:
        return []
    run = of["run"].min()
    p = of[of["run"] == run].pivot(index="submap", columns="quantity", values="value").sort_index()
    segment = p["path_segment"].to_numpy(dtype=np.int64)
    xy = p[["path_x", "path_y"]].to_numpy(dtype=np.float64)
    # each piece ends at the first point of the next one
    pieces = [
        xy[first : last + 2] for first, last in ((np.flatnonzero(segment == k)[[0, -1]]) for k in np.unique(segment))
    ]
    truth = p[["path_true_x", "path_true_y"]].to_numpy(dtype=np.float64)
    ax = plot_segments(None, pieces, truth=truth, title=f"{world}, {of['algorithm'].iloc[0]}, run {run}")
    return [save_figure(ax, folder / f"{world}-path.png")]


STUDY = SegSlamGarage(
    "segslam-garage",
    "a loop through a garage of two levels: final error, NEES and run time of RBPF and SegSLAM by particles",
    WORLDS,
    QUICK_WORLDS,
)
