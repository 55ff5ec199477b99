"""The figures of Combined SLAM redrawn from a study's table, to files: whichever the table has the figures for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from graphslam.plots.save import save_figure
from graphslam_studies.plots.algorithms import algorithm_label
from graphslam_studies.plots.study import plot_ci, plot_error_panels, plot_rms_panels
from graphslam_studies.plots.study_local import plot_local_consistency
from graphslam_studies.plots.study_table import algorithms_with
from graphslam_studies.plots.study_time import plot_cumulative_time

ERRORS_OF = ("rbpf-eif", "default-online")
CONSISTENCY = ("ekf", "rbpf", "ekf-eif", "rbpf-ekf", "rbpf-eif", "default-eif", "default-online")
JOINING = ("rbpf-ekf", "rbpf-eif")
TIME = ("ekf", "rbpf-eif", "rbpf-eif-tree")
LOCAL = ("local-ekf", "local-paper", "local-default")


def save_paper_figures(table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
    """Figures 5-9, and the consistency of local maps, of every world, as PNG files ``fig5-errors-rbpf-eif-A.png`` ….

    Parameters
    ----------
    table, timings : DataFrame
        ``world, run, algorithm, submap, quantity, value`` in the vocabulary of the study ``combined-slam``.

    Returns
    -------
    list of path
        A figure is left out where the table lacks its quantity, and a curve where it lacks the algorithm.
    """
    made: list[Path] = []
    for world in dict.fromkeys(table["world"]):
        t, seconds = table[table["world"] == world], timings[timings["world"] == world]

        def keep(ax: Axes, name: str, world: str = str(world)) -> None:
            made.append(save_figure(ax, folder / f"{name}-{world}.png"))

        for name in _present(t, "error_x", ERRORS_OF):
            title = f"World {world}: {algorithm_label(name)}, one run"
            keep(plot_error_panels(t, name, title=title)[0], f"fig5-errors-{name}")
        for quantity, what in (("pose_nees", "pose"), ("feature_nees", "features")):
            names = _present(t, quantity, CONSISTENCY)
            for statistic in ("mean", "median") if names else ():
                ax = plot_ci(None, t, quantity, algorithms=names, statistic=statistic, title=f"World {world}")  # type: ignore[arg-type]
                keep(ax, f"fig6-{what}-{statistic}")
        if ((t["quantity"] == "feature_rms") & (t["submap"] == -1)).any():
            keep(plot_rms_panels(t)[0], "fig7-rms")
        for figure, wanted in (("fig8-joining", JOINING), ("fig9-time", TIME)):
            present = [n for n in wanted if n in _timed(seconds)]
            if _present(seconds, "seconds_cumulative", present):
                keep(plot_cumulative_time(None, seconds, algorithms=present, title=f"World {world}"), figure)
        maps = _present(t, "local_joint_nees", LOCAL)
        if maps:
            keep(plot_local_consistency(None, t, algorithms=maps, title=f"World {world}"), "local-maps")
    return made


def _present(table: pd.DataFrame, quantity: str, wanted: Sequence[str]) -> list[str]:
    """Those of the wanted algorithms that have a quantity along the run; all that have it if none of them has."""
    if not ((table["quantity"] == quantity) & (table["submap"] >= 0)).any():
        return []
    found = algorithms_with(table, quantity, online=True)
    return [name for name in wanted if name in found] or found


def _timed(timings: pd.DataFrame) -> set[str]:
    """Algorithms with a time of any kind."""
    return set(timings.loc[timings["quantity"].isin(["seconds_cumulative", "seconds_total"]), "algorithm"])
