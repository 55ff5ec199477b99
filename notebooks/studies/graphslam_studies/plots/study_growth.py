"""How errors grow along the run in a Monte-Carlo study (Fig. 7 of Combined SLAM, left)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from graphslam.core.geometry import Array
from graphslam.plots import style
from graphslam_studies.evaluate.tables import values_of
from graphslam_studies.plots.algorithms import algorithm_label, algorithm_line
from graphslam_studies.plots.study_table import algorithms_with

Component = Literal["position", "heading", "features"]
_LABELS = {"position": "RMS position error [m]", "heading": "RMS heading error [°]", "features": "RMS of features [m]"}


def rms_over_runs(table: pd.DataFrame, algorithm: str, component: Component) -> tuple[Array, Array]:
    """Submaps ``(k,)`` and the root mean square over the runs of an error of the end pose, or of features ``(k,)``."""
    online = table[table["submap"] >= 0]
    if component == "features":
        submaps, values = values_of(online, algorithm, "feature_rms")
        square = values**2
    elif component == "heading":
        submaps, values = values_of(online, algorithm, "error_heading")
        square = np.degrees(values) ** 2
    else:
        submaps, x = values_of(online, algorithm, "error_x")
        square = x**2 + values_of(online, algorithm, "error_y")[1] ** 2
    return submaps, np.sqrt(np.nanmean(square, axis=0))


def plot_error_growth(
    ax: Axes | None,
    table: pd.DataFrame,
    component: Component = "position",
    *,
    algorithms: Sequence[str] | None = None,
    title: str | None = None,
) -> Axes:
    """RMS error over the runs right after every submap.

    Parameters
    ----------
    table : DataFrame
        Of one world, with ``error_x``, ``error_y``, ``error_heading`` or ``feature_rms`` along the run.
    component : {"position", "heading", "features"}
    algorithms : sequence of str, optional
        Default all that have it.
    """
    quantity = "feature_rms" if component == "features" else "error_x"
    names = list(algorithms or algorithms_with(table, quantity, online=True))
    ax = style.new_axes(ax, (8.0, 3.5))
    for k, name in enumerate(names):
        submaps, rms = rms_over_runs(table, name, component)
        every = max(1, len(submaps) // 10)
        look = algorithm_line(name, k)
        ax.plot(submaps + 1, rms, lw=1.4, ms=4.5, markevery=every, label=algorithm_label(name), **look)
    ax.set_ylim(bottom=0.0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel(_LABELS[component])
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def plot_growth_panels(table: pd.DataFrame, *, algorithms: Sequence[str] | None = None) -> list[Axes]:
    """Position, heading and features, one above the other."""
    _, made = plt.subplots(3, 1, figsize=(8.0, 8.0), dpi=style.DPI, layout="constrained", sharex=True)
    axes = list(made)
    for ax, component in zip(axes, ("position", "heading", "features"), strict=True):
        plot_error_growth(ax, table, component, algorithms=algorithms)  # type: ignore[arg-type]
        if ax is not axes[-1]:
            ax.set_xlabel("")
        if ax is not axes[0] and (legend := ax.get_legend()) is not None:
            legend.remove()
    return axes
