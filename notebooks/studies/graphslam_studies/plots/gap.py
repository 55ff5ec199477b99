"""How far above the optimum: along the sequence, up the tree, step by step."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from graphslam.core.errors import DataError
from graphslam.core.geometry import ArrayLike
from graphslam.plots import style

FLOOR = 1e-9
"""A gap below this part of the objective is rounding, and drawn there."""


def plot_gap_along(ax: Axes | None, table: pd.DataFrame, *, title: str | None = None) -> Axes:
    """Objective above the optimum, relative to it, right after every submap.

    Parameters
    ----------
    table : DataFrame
        Of :func:`graphslam_studies.evaluate.gap.gap_along`. Submaps whose optimum is below 1 (nothing was seen twice
        yet) are left out.
    """
    if table.empty:
        raise DataError("no objectives to draw")
    ax = style.new_axes(ax, (8.0, 4.0))
    for k, (method, rows) in enumerate(table.groupby("method", sort=False)):
        known = rows[rows["optimum"] > 1.0]
        relative = (known["gap"] / known["optimum"]).clip(lower=FLOOR)
        every = max(1, len(known) // 10)
        ax.plot(known["submap"] + 1, relative, lw=1.4, ms=4.5, markevery=every, label=str(method), **style.line(k))
    ax.axhline(FLOOR, color=style.GREY, lw=0.8, ls=":", label=f"{FLOOR:g} and below: at the optimum")
    ax.set_yscale("log")
    ax.set_ylim(bottom=0.4 * FLOOR)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel("objective / optimum - 1")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def plot_tree_gap(ax: Axes | None, table: pd.DataFrame, *, value: str = "own", title: str | None = None) -> Axes:
    """The join tree: every join a box over the submaps below it, coloured by what it added to the objective.

    Parameters
    ----------
    table : DataFrame
        Of :func:`graphslam_studies.evaluate.gap.gap_by_tree`.
    value : {"own", "gap"}
        What a join has added, or the whole gap of the map it made.
    """
    if table.empty:
        raise DataError("no joins to draw")
    ax = style.new_axes(ax, (8.0, 3.6))
    ax.grid(False)
    shown = table[value].abs().clip(lower=1e-3)
    norm = LogNorm(float(shown.min()), float(max(shown.max(), 10.0 * shown.min())))
    cmap = colormaps["viridis"]
    for (level, first, last), v in zip(table[["level", "first", "last"]].to_numpy(), shown, strict=True):
        box = Rectangle((first + 0.5, level - 0.45), last - first + 1, 0.9, fc=cmap(norm(v)), ec="white", lw=0.6)
        ax.add_patch(box)
        if level >= table["level"].max() - 2:
            dark = norm(v) < 0.6
            ax.text(first + 1 + 0.5 * (last - first), level, f"{v:.3g}", ha="center", va="center", fontsize="small",
                    color="white" if dark else style.BLACK)  # fmt: skip
    ax.set_xlim(0.5, table["last"].max() + 1.5)
    ax.set_ylim(0.5, table["level"].max() + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel("level of the join")
    what = "added to the objective above the optimum" if value == "own" else "objective above the optimum"
    ax.figure.colorbar(ScalarMappable(norm, cmap), ax=ax, label=f"|{what}|" if value == "own" else what)
    if title:
        ax.set_title(title, fontsize="medium")
    return ax


def plot_convergence(
    ax: Axes | None, histories: Mapping[str, ArrayLike], *, optimum: float | None = None, title: str | None = None
) -> Axes:
    """Objective above the optimum, relative to it, before every Gauss–Newton step.

    Parameters
    ----------
    histories : mapping of start to (k,)
        Objectives, e.g. of :func:`graphslam_studies.evaluate.gap.polish_history`.
    optimum : float, optional
        Default the least of them all.
    """
    if not histories:
        raise DataError("no searches to draw")
    ax = style.new_axes(ax, (8.0, 3.8))
    best = min(float(np.min(np.asarray(h))) for h in histories.values()) if optimum is None else optimum
    for k, (label, history) in enumerate(histories.items()):
        h = np.asarray(history, dtype=np.float64)
        above = np.maximum((h - best) / max(best, 1e-300), FLOOR)
        ax.plot(above, lw=1.4, ms=5, label=f"{label}: {len(h) - 1} steps", **style.line(k))
    ax.set_yscale("log")
    ax.set_ylim(bottom=0.4 * FLOOR)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("Gauss–Newton steps")
    ax.set_ylabel("objective / optimum - 1")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax
