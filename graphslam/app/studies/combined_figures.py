"""Figures 5–9 of Combined SLAM from the study's own tables, a set for every world."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from graphslam.plots.save import save
from graphslam.plots.study import (
    plot_cumulative_time,
    plot_error_panels,
    plot_local_honesty,
    plot_rms_panels,
)
from graphslam.plots.study_growth import plot_ci_panels, plot_growth_panels

SINGLE = ("ekf", "rbpf")
JOINED = ("ekf-eif", "rbpf-eif", "default-eif", "default-online", "default-optimum")
ERRORS = ("ekf", "rbpf", "ekf-eif", "rbpf-eif", "default-optimum")
WHOLE = (
    *("ekf", "rbpf", "ekf-eif", "ekf-eif-tree", "rbpf-eif", "rbpf-eif-tree", "default-eif-tree"),
    *("ekf-eif+polish", "rbpf-eif+polish", "default-eif+polish", "default-isam2", "full-batch"),
)


def figures(table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
    """Draw them; algorithms that a world has no figures of are left out."""
    made: list[Path] = []
    for world in dict.fromkeys(table["world"]):
        t, s = table[table["world"] == world], timings[timings["world"] == world]
        made += _world(str(world), t, s, folder)
    return made


def _world(world: str, t: pd.DataFrame, s: pd.DataFrame, folder: Path) -> list[Path]:
    made: list[Path] = []

    def here(names: tuple[str, ...], quantity: str) -> list[str]:
        there = set(t.loc[t["quantity"] == quantity, "algorithm"])
        return [n for n in names if n in there]

    for name in here(ERRORS, "error_x"):
        axes = plot_error_panels(t, name, title=f"world {world}, {name}, one run")
        made.append(save(axes[0], folder / f"{world}-fig5-{name}.png"))
    for label, names in (("single", SINGLE), ("joined", JOINED)):
        for statistic in ("mean", "median"):
            axes = plot_ci_panels(t, algorithms=names, statistic=statistic, title=f"world {world}")  # type: ignore[arg-type]
            made.append(save(axes[0], folder / f"{world}-fig6-{label}-{statistic}.png"))
    made.append(
        save(plot_growth_panels(t, algorithms=here(SINGLE + JOINED, "error_x"))[0], folder / f"{world}-fig7-growth.png")
    )
    made.append(save(plot_rms_panels(t, algorithms=here(WHOLE, "feature_rms"))[0], folder / f"{world}-fig7-end.png"))
    made.append(save(plot_local_honesty(None, t, title=world), folder / f"{world}-local-maps.png"))
    if len(s):
        join = plot_cumulative_time(
            None, s, algorithms=("rbpf-ekf", "rbpf-eif", "rbpf-eif-tree"), title=f"world {world}, joining"
        )
        made.append(save(join, folder / f"{world}-fig8-joining.png"))
        whole = plot_cumulative_time(
            None, s, algorithms=("ekf", "rbpf", "rbpf-eif", "rbpf-eif-tree"), title=f"world {world}"
        )
        made.append(save(whole, folder / f"{world}-fig9-time.png"))
    return made
