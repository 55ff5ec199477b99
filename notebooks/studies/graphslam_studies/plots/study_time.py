"""Computing time of a Monte-Carlo study from its timings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from graphslam.plots import style
from graphslam_studies.evaluate.tables import values_of
from graphslam_studies.plots.algorithms import algorithm_label, algorithm_line
from graphslam_studies.plots.study_table import algorithms_with, curve_of


def plot_cumulative_time(
    ax: Axes | None,
    timings: pd.DataFrame,
    *,
    algorithms: Sequence[str] | None = None,
    log: bool | None = None,
    title: str | None = None,
) -> Axes:
    """Seconds spent up to each submap, median over the runs with its 10-90 % range (Fig. 8 and 9).

    A method that joins all submaps at once, as the tree does, has its total only: a level line.

    Parameters
    ----------
    timings : DataFrame
        Of one world: ``seconds_cumulative`` along the run, or ``seconds_total``.
    """
    online = set(timings.loc[(timings["quantity"] == "seconds_cumulative") & (timings["submap"] >= 0), "algorithm"])
    names = list(algorithms or algorithms_with(timings, "seconds_cumulative", online=True))
    ax = style.new_axes(ax, (8.0, 4.0))
    last, ends, levels = 2.0, [], []
    for k, name in enumerate(names):
        look: Mapping[str, Any] = algorithm_line(name, k)
        if name not in online:
            levels.append((name, look))
            continue
        submaps, seconds = curve_of(timings, name, "seconds_cumulative")
        x = submaps + 1
        middle = np.nanmedian(seconds, axis=0)
        low, high = np.nanquantile(seconds, [0.1, 0.9], axis=0)
        every = max(1, len(x) // 10)
        ax.fill_between(x, low, high, color=look["color"], alpha=0.15, lw=0)
        ax.plot(x, middle, lw=1.5, ms=4.5, markevery=(k * every // len(names), every),
                label=f"{algorithm_label(name)}: {middle[-1]:.3g} s", **look)  # fmt: skip
        last = max(last, float(x[-1]))
        ends += [float(middle[-1])]
    for name, look in levels:
        _, seconds = values_of(timings[timings["submap"] == -1], name, "seconds_total")
        total = float(np.nanmedian(seconds))
        ax.axhline(total, color=look["color"], ls=look["linestyle"], lw=1.3)
        ax.plot([last], [total], ms=6, clip_on=False, label=f"{algorithm_label(name)}, all at once: {total:.3g} s",
                **{**look, "linestyle": "none"})  # fmt: skip
        ends += [total]
    if log or (log is None and max(ends) > 30.0 * min(e for e in ends if e > 0)):
        ax.set_yscale("log")
    else:
        ax.set_ylim(bottom=0.0)
    ax.set_xlim(1.0, last)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel("cumulative time [s]")
    ax.set_title("median and 10–90 % of the runs" if title is None else title, fontsize="medium")
    style.legend(ax)
    return ax
