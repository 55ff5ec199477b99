"""Comparison figure of several methods."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.plots import style

BEFORE, AFTER = "the method's own map", "after refinement"
GAP = 1e-3
"""χ² gap below which an objective is plotted as optimal."""


def comparison_figure(comparison: pd.DataFrame) -> Axes:
    """The same submaps joined by every method, before and after refinement: shows the cost of filtering.

    Parameters
    ----------
    comparison : DataFrame
        Of :func:`graphslam.compare`. Panels without values (NEES and CI without ground truth) are left out.

    Returns
    -------
    Axes
        The first panel.
    """
    if comparison.empty:
        raise DataError("no methods to compare")
    own, best = (pd.to_numeric(comparison[k], errors="coerce") for k in ("objective", "objective_polished"))
    optimum = float(np.nanmin(np.concatenate([own, best])))
    n = pd.to_numeric(comparison["nees_dof"], errors="coerce")
    panels = [(own - optimum, best - optimum, f"χ² above the optimum ({optimum:.6g})")]
    for key, scale, label in (("nees", n, "NEES/n"), ("ci", 1.0, "consistency index")):
        after = pd.to_numeric(comparison[key], errors="coerce") / scale
        before = pd.to_numeric(comparison[f"{key}_unpolished"], errors="coerce") / scale
        if after.notna().any():
            panels.append((before.fillna(after), after.where(best.notna()), label))
    names = [str(m) for m in comparison["method"]]
    size = (1.5 + 4.0 * len(panels), 1.4 + 0.5 * len(names))
    figure, axes = plt.subplots(1, len(panels), figsize=size, dpi=style.DPI, layout="constrained", sharey=True)
    at = np.arange(len(names))[::-1]
    for k, (ax, (before, after, label)) in enumerate(zip(np.atleast_1d(axes), panels)):
        style.new_axes(ax)
        if label == "NEES/n":
            low, high = chi2_mean_bounds(int(n.iloc[0]), 1)
            ax.axvspan(low / n.iloc[0], high / n.iloc[0], color=style.BOUNDS, lw=0, zorder=0, label="95 % bounds")
        if label == "consistency index":
            ax.axvline(1.0, color=style.BLACK, lw=1.0, ls="--", zorder=1, label="upper 95 % bound")
        ax.hlines(at, np.fmin(before, after), np.fmax(before, after), color=style.GREY, lw=2.0, zorder=2)
        ax.scatter(before, at, s=80, color="white", edgecolors=style.VERMILION, linewidths=2.0, zorder=3, label=BEFORE)
        ax.scatter(after, at, s=42, color=style.BLUE, zorder=4, label=AFTER)
        for y, x in zip(at, before):
            text = f"{x:.3g}" if k or x > GAP else "0"
            ax.annotate(text, (x, y), xytext=(0, 8), textcoords="offset points", ha="center", fontsize="small")
        if k == 0:  # gaps of filters span decades, and that of the optimum is zero
            ax.set_xscale("symlog", linthresh=GAP)
            ax.set_xlim(left=-0.5 * GAP)
        ax.margins(x=0.15)
        ax.set_xlabel(label)
        ax.set_yticks(at, names)
        ax.set_ylim(-0.6, len(names) - 0.3)
        ax.grid(False, axis="y")
    handles: dict[str, Any] = {}
    for ax in np.atleast_1d(axes):
        handles |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=len(handles), frameon=False)
    return np.atleast_1d(axes)[0]
