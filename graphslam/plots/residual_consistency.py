"""Consistency of a map without ground truth: loops against each other, and withheld GPS against its prediction."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import MaxNLocator

from graphslam.core.gaussian import chi2_quantile
from graphslam.evaluate.gps_innovation import GpsInnovations
from graphslam.evaluate.loop_consistency import LoopConsistency
from graphslam.plots import style


def plot_loop_matrix(ax: Axes | None, loops: LoopConsistency) -> Axes:
    """``D²/3`` of every pair of loops (off the diagonal) and of every loop against the chain (on it).

    A consistent map gives white. A false loop appears as a dark cross, an overconfident front end as a dark matrix, a
    conservative one as a pale blue matrix.
    """
    ax = style.new_axes(ax, (6.5, 5.5))
    ax.grid(False)
    ratio = np.clip(loops.d2 / 3.0, 1e-2, 1e2)
    image = ax.imshow(ratio, cmap="RdBu_r", norm=LogNorm(1e-2, 1e2), interpolation="nearest", origin="upper")
    bar = ax.figure.colorbar(image, ax=ax, shrink=0.85)
    bar.set_label("D² / 3   (consistent: 1)")
    bar.ax.axhline(chi2_quantile(loops.confidence, 3) / 3.0, color=style.BLACK, lw=1.0)
    names = [f"{a}–{b}" for a, b in zip(loops.loops.a, loops.loops.b)]
    every = max(1, len(names) // 15)
    at = np.arange(0, len(names), every)
    ax.set_xticks(at, [names[k] for k in at], rotation=90, fontsize="x-small")
    ax.set_yticks(at, [names[k] for k in at], fontsize="x-small")
    ax.set_xlabel("loop (submaps)")
    ax.set_ylabel("loop (submaps)")
    t = loops.test()
    name = f"{t['loops']} loops: mean D²/3 {t['value']:.2f} [{t['low']:.2f}, {t['high']:.2f}], {t['verdict']}"
    ax.set_title(name, fontsize="medium")
    return ax


def plot_innovations(ax: Axes | None, gps: GpsInnovations, *, title: str | None = None) -> Axes:
    """NIS of every withheld fix over time, with the limit of one fix and the mean with its two-sided bounds."""
    ax = style.new_axes(ax, (8.0, 3.2))
    each = gps.tests()[0]
    t = gps.times - gps.times[0]
    band = f"{gps.confidence:.0%} bounds of the mean, worth {each['dof']:.0f} dof"
    d = gps.dim
    ax.axhspan(d * each["low"], d * each["high"], color=style.BOUNDS, alpha=0.8, lw=0, label=band, zorder=0)
    ax.plot(t, gps.nis, ".", color=style.GPS, ms=4, label="withheld fix", zorder=3)
    ax.axhline(d * each["value"], color=style.ESTIMATE, lw=1.2, label=f"mean {d * each['value']:.2f} (consistent: {d})")
    limit = chi2_quantile(gps.confidence, d)
    ax.axhline(limit, color=style.BLACK, lw=0.8, ls="--", label=f"{gps.confidence:.0%} of consistent fixes below")
    ax.set_yscale("log")
    ax.set_ylim(bottom=1e-2)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("time [s]")
    ax.set_ylabel("NIS")
    ax.set_title(title if title is not None else f"{len(t)} withheld fixes: {each['verdict']}", fontsize="medium")
    style.legend(ax)
    return ax
