"""Figure that compares map-joining methods by truth, error and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from graphslam.core.errors import DataError
from graphslam.plots import style


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
        A line to compare with, e.g. ``(1.0, "consistent")``.
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
