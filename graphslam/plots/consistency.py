"""Consistency curves of an estimator over the submaps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import ArrayLike
from graphslam.evaluate.consistency import Consistency
from graphslam.plots import style


def plot_consistency(
    ax: Axes | None,
    curves: Mapping[str, Consistency],
    *,
    submaps: ArrayLike | None = None,
    figure: Literal["nees", "ci"] = "nees",
    log: bool | None = None,
    title: str | None = None,
) -> Axes:
    """Mean normalised NEES (or CI) over the runs against the submap number, with the two-sided consistency bounds.

    Parameters
    ----------
    curves : mapping of label to Consistency
        One per algorithm, of the same quantity; columns are submaps.
    submaps : (k,), optional
        Numbers of the columns; default 1, 2, …
    figure : {"nees", "ci"}
        ``nees``: mean D²/n, consistent = 1. ``ci``: mean D²/χ²_{n,1-α} (Combined SLAM eq. 20) with its limit 1.
    log : bool, optional
        Logarithmic axis; default where the curves leave the decade around the bounds.
    """
    ax = style.new_axes(ax, (8.0, 4.0))
    top = 0.0
    for k, (label, c) in enumerate(curves.items()):
        mean, low, high = c.curve()
        n = c.dof[0]
        x = np.arange(1, len(mean) + 1) if submaps is None else np.asarray(submaps, dtype=np.float64)
        # D²/χ² is D²/n times a constant, so the bounds carry over
        factor = np.ones_like(n) if figure == "nees" else n / np.array([chi2_quantile(c.confidence, v) for v in n])
        if k == 0:
            name = f"{c.confidence:.0%} bounds, {c.runs} run{'s' if c.runs != 1 else ''}"
            ax.fill_between(x, low * factor, high * factor, color=style.BOUNDS, alpha=0.8, lw=0, label=name, zorder=0)
            ax.plot(x, factor, color=style.GREY, lw=0.9, ls=":", label="expected if consistent", zorder=1)
        every = max(1, len(x) // 12)
        ax.plot(x, mean * factor, lw=1.5, ms=4, markevery=(k * every // 4, every), label=label, **style.line(k))
        top = max(top, float(np.nanmax(mean / high)))
    first = next(iter(curves.values()))
    if figure == "ci":
        ax.axhline(1.0, color=style.BLACK, lw=0.8, ls="--", label="CI = 1", zorder=1)
    if log or (log is None and top > 4.0):
        ax.set_yscale("log")
    else:
        ax.set_ylim(bottom=0.0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel(
        f"mean NEES/n of {first.quantity}" if figure == "nees" else f"mean consistency index of {first.quantity}"
    )
    ax.set_title(title if title is not None else f"n = {first.dimension:g}, {first.gauge}", fontsize="medium")
    style.legend(ax)
    return ax
