"""Every run of every algorithm: the figure of a study in which single runs fail and a mean hides it."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from graphslam.core.errors import DataError
from graphslam.plots import style


def plot_runs(table: pd.DataFrame, *, label: str, log: bool | None = None) -> Axes:
    """One panel a world, one row an algorithm: runs as points, their median as a bar, the mean with its interval.

    Parameters
    ----------
    table : DataFrame
        ``world, run, algorithm, value`` of one quantity.
    label : str
        Of the horizontal axis.
    log : bool, optional
        Logarithmic axis; default where positive values span more than a factor of fifty.

    Returns
    -------
    Axes
        The first panel.
    """
    if table.empty:
        raise DataError("no runs to draw", got=0)
    worlds, names = list(dict.fromkeys(table["world"])), list(dict.fromkeys(table["algorithm"]))
    size = (3.2 * len(worlds) + 1.6, 0.32 * len(names) + 1.2)
    _, axes = plt.subplots(
        1, len(worlds), figsize=size, dpi=style.DPI, sharey=True, squeeze=False, layout="constrained"
    )
    values = table["value"].to_numpy(dtype=np.float64)
    positive = values[values > 0]
    wide = len(positive) == len(values) and positive.max() > 50 * positive.min()
    for world, ax in zip(worlds, axes[0]):
        style.new_axes(ax)
        of = table[table["world"] == world]
        for row, name in enumerate(names):
            v = of.loc[of["algorithm"] == name, "value"].dropna().to_numpy(dtype=np.float64)
            if not len(v):
                continue
            # deterministic spread, so that equal runs can be told apart
            y = row + 0.28 * (np.argsort(np.argsort(v, kind="stable"), kind="stable") / max(len(v) - 1, 1) - 0.5)
            ax.plot(v, y, ".", color=style.SKY, ms=3.5, zorder=2)
            ax.plot([np.median(v)] * 2, [row - 0.3, row + 0.3], color=style.BLACK, lw=1.2, zorder=3)
            half = 1.96 * v.std(ddof=1) / np.sqrt(len(v)) if len(v) > 1 else 0.0
            ax.errorbar(v.mean(), row, xerr=half, fmt="D", ms=4, color=style.VERMILION, lw=1.2, capsize=2, zorder=4)
        if log or (log is None and wide):
            ax.set_xscale("log")
        else:
            ax.set_xlim(left=min(0.0, float(np.nanmin(values))))
        ax.set_title(f"{world} ({of['run'].nunique()} runs)", fontsize="medium")
        ax.set_xlabel(label, fontsize="small")
    first: Axes = axes[0, 0]
    first.set_yticks(np.arange(len(names)), names)
    first.set_ylim(len(names) - 0.5, -0.5)
    first.plot([], [], ".", color=style.SKY, label="run")
    first.plot([], [], color=style.BLACK, lw=1.2, label="median")
    first.errorbar([], [], xerr=[], fmt="D", ms=4, color=style.VERMILION, label="mean ± 1.96 s.e.")
    last: Axes = axes[0, -1]
    last.legend(*first.get_legend_handles_labels(), loc="best", fontsize="x-small", framealpha=0.8, edgecolor="none")
    return first
