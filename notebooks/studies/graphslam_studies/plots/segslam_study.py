"""Figures of the studies of SegSLAM: what the number of particles does to errors and run times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.plots import style

_LOOKS = {"rbpf": (style.VERMILION, "s"), "segslam": (style.BLUE, "o")}
_NAMES = {"rbpf": "RBPF", "segslam": "SegSLAM"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """A figure by the number of particles.

    Parameters
    ----------
    particles, values : (n,)
    low, high : (n,) or None
        Bounds of the values.
    points : mapping of particles to (runs,)
        Single runs.
    paper : (n,) or None
        The paper's figures, nan where it has none.
    """

    particles: Array
    values: Array
    low: Array | None = None
    high: Array | None = None
    points: Mapping[int, Array] | None = None
    paper: Array | None = None


def plot_by_particles(
    ax: Axes | None,
    curves: Mapping[str, Curve],
    *,
    label: str,
    reference: tuple[float, str] | None = None,
    limit: tuple[float, str] | None = None,
    log: bool = True,
    title: str | None = None,
) -> Axes:
    """Curves over the number of particles (SegSLAM Tables II and III as a picture).

    Parameters
    ----------
    curves : mapping of family to Curve
        ``rbpf``, ``segslam`` have their own colours and are beside each other.
    label : str
        Of the vertical axis.
    reference, limit : (value, text), optional
        Horizontal lines: what it would be without, and what would be good.
    log : bool
        Logarithmic vertical axis.

    Raises
    ------
    DataError
        Nothing to draw.
    """
    known = {name: c for name, c in curves.items() if len(c.particles)}
    if not known:
        raise DataError("no curves to draw", got=list(curves))
    ax = style.new_axes(ax, (7.0, 4.5))
    every = np.unique(np.concatenate([c.particles for c in known.values()]))
    for k, (name, c) in enumerate(known.items()):
        colour, marker = _LOOKS.get(name, (style.colour(k), style.MARKERS[k % len(style.MARKERS)]))
        beside = 1.0 + 0.06 * (k - 0.5 * (len(known) - 1))
        x = c.particles * beside
        for n, v in (c.points or {}).items():
            ax.plot(np.full(len(v), n * beside), v, "_", color=colour, ms=7.0, alpha=0.7, zorder=2)
        if c.low is not None and c.high is not None:
            ax.vlines(x, c.low, c.high, color=colour, lw=1.4, zorder=3)
        ax.plot(x, c.values, "-", marker=marker, color=colour, ms=5.5, lw=1.5, label=_NAMES.get(name, name), zorder=4)
        if c.paper is not None and np.isfinite(c.paper).any():
            has = np.isfinite(c.paper)
            there = f"{_NAMES.get(name, name)}, paper"
            ax.plot(x[has], c.paper[has], "--", marker=marker, mfc="white", color=colour, ms=5.0, lw=0.9,
                    label=there, zorder=3)  # fmt: skip
    if reference is not None:
        ax.axhline(reference[0], color=style.DEAD_RECKONING, lw=1.2, ls="-.", label=reference[1], zorder=1)
    if limit is not None:
        ax.axhline(limit[0], color=style.GREY, lw=1.0, ls=":", label=limit[1], zorder=1)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(FixedLocator([float(n) for n in every]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:.0f}"))
    ax.xaxis.set_minor_locator(NullLocator())
    if log:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        # less than a decade has one power of ten, if any: 2 and 5 are named as well
        ax.yaxis.set_minor_formatter(FuncFormatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "25" else ""))
    ax.set_xlabel("particles")
    ax.set_ylabel(label)
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax
