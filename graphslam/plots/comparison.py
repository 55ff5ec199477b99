"""Methods side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
"""Of χ²: below it an objective is drawn as the optimum."""


def plot_comparison(
    ax: Axes | None,
    table: pd.DataFrame | Sequence[Mapping[str, object]],
    value: str,
    *,
    by: str = "method",
    unit: str = "",
    errors: str | None = None,
    reference: tuple[float, str] | None = None,
    band: tuple[float, float, str] | None = None,
    log: bool = False,
    label: str | None = None,
    title: str | None = None,
) -> Axes:
    """One horizontal bar (or point) per method, labelled with its figure; a method without a figure says so.

    Parameters
    ----------
    table : DataFrame or sequence of mappings
        One row per method.
    value : str
        Column that is drawn.
    by : str
        Column that names the methods.
    unit : str
        Of the value, for the axis.
    errors : str, optional
        Column of half widths (e.g. 1.96 standard errors).
    reference : (value, label), optional
        A line to compare with, e.g. ``(1.0, "honest")``.
    band : (low, high, label), optional
        A range to compare with, e.g. two-sided bounds.
    log : bool
        Logarithmic axis; then points instead of bars, because a bar's length would mean nothing.
    label : str, optional
        Of the axis; default the column and its unit.
    """
    frame = pd.DataFrame(list(table)) if not isinstance(table, pd.DataFrame) else table
    for column in (value, by, *([errors] if errors else [])):
        if column not in frame:
            raise DataError(f"table has no column {column!r}", wanted=", ".join(map(str, frame.columns)))
    if frame.empty:
        raise DataError("no methods to compare")
    names = [str(n) for n in frame[by]]
    v = pd.to_numeric(frame[value], errors="coerce").to_numpy(dtype=np.float64)
    half = None if errors is None else pd.to_numeric(frame[errors], errors="coerce").to_numpy(dtype=np.float64)
    ax = style.new_axes(ax, (7.0, 0.8 + 0.45 * len(names)))
    at = np.arange(len(names))[::-1]
    if band is not None:
        ax.axvspan(band[0], band[1], color=style.BOUNDS, alpha=0.8, lw=0, label=band[2], zorder=0)
    colours = [style.colour(k) for k in range(len(names))]
    if log:
        if np.any(v <= 0):
            raise DataError(f"{value!r} is not positive: no logarithmic axis", got=float(np.nanmin(v)), wanted="> 0")
        ax.set_xscale("log")
        ax.scatter(v, at, s=70, color=colours, zorder=3)
        ax.set_ylim(-0.6, len(names) - 0.4)
    else:
        ax.barh(at, np.nan_to_num(v), height=0.62, color=colours, zorder=2)
    if half is not None:
        ax.errorbar(v, at, xerr=half, fmt="none", ecolor=style.BLACK, elinewidth=1.0, capsize=3, zorder=3)
    if reference is not None:
        ax.axvline(reference[0], color=style.BLACK, lw=1.0, ls="--", label=reference[1], zorder=2.5)
    ends = np.nan_to_num(v) + (0.0 if half is None else np.nan_to_num(half))
    for y, x, end in zip(at, v, ends):
        text = f"{x:.4g}" if np.isfinite(x) else "no figure"
        if np.isfinite(x) or not log:
            box = {"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7}
            shift = (7, 0) if log else (4, 0)
            ax.annotate(
                text,
                (end, y),
                xytext=shift,
                textcoords="offset points",
                va="center",
                fontsize="small",
                bbox=box,
                zorder=4,
            )
        else:  # a point that is nowhere: say so at the edge
            ax.text(0.01, y, text, transform=ax.get_yaxis_transform(), va="center", fontsize="small")
    ax.margins(x=0.12)
    ax.set_yticks(at, names)
    ax.grid(False, axis="y")
    name = value if label is None else label
    ax.set_xlabel(f"{name} [{unit}]" if unit else name)
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def comparison_figure(comparison: pd.DataFrame) -> Axes:
    """The same submaps joined in every way, before and after refinement: what filtering costs, at a glance.

    Parameters
    ----------
    comparison : DataFrame
        Of :func:`graphslam.compare`. Panels without figures (NEES and CI without a truth) are left out.

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
        if k == 0:  # gaps of filters span decades, and that of the optimum is none
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
