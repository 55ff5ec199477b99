"""Honesty of the local maps of a Monte-Carlo study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.plots import style
from graphslam_studies.plots.algorithms import algorithm_label, algorithm_line
from graphslam_studies.plots.study_table import algorithms_with, curve_of


def plot_local_consistency(
    ax: Axes | None,
    table: pd.DataFrame,
    *,
    algorithms: Sequence[str] | None = None,
    confidence: float = 0.95,
    title: str | None = None,
) -> Axes:
    """Histogram of the joint NEES/n of local maps and that of consistent maps of the same sizes.

    Densities are over ln(NEES/n), so every area is one. The expected curve is the mean of the χ²_n/n densities of the
    maps' own dimensions n. Maps of one run use different data: each is a unit.

    Parameters
    ----------
    table : DataFrame
        Of one world, with ``local_joint_nees`` and ``local_joint_dof``.
    """
    names = list(algorithms or algorithms_with(table, "local_joint_nees", online=True))
    ax = style.new_axes(ax, (8.0, 4.0))
    found = {}
    for name in names:
        at, d2 = curve_of(table, name, "local_joint_nees")
        same, dof = curve_of(table, name, "local_joint_dof")
        if d2.shape != dof.shape or not np.array_equal(at, same):
            raise DataError(f"local maps of {name!r} lack a NEES or its degrees of freedom", got=(d2.shape, dof.shape))
        known = np.isfinite(d2) & np.isfinite(dof) & (d2 > 0)
        found[name] = d2[known], dof[known]
    ratios = np.concatenate([d2 / dof for d2, dof in found.values()])
    left = min(0.3, float(ratios.min(initial=0.3)))
    right = max(3.0, float(np.quantile(ratios, 0.995)))
    most = max(len(d2) for d2, _ in found.values())
    edges = np.geomspace(left, right, 1 + int(np.clip(2.5 * np.sqrt(most), 12, 60)))
    x = np.geomspace(left, right, 400)
    sizes, counts = np.unique(found[names[0]][1], return_counts=True)
    f = stats.chi2.pdf(x[:, None] * sizes, sizes) * sizes * x[:, None]
    ax.fill_between(
        x, f @ counts / counts.sum(), color=style.BOUNDS, alpha=0.8, lw=0, label="consistent (χ²)", zorder=0
    )
    for k, (name, (d2, dof)) in enumerate(found.items()):
        r, look = d2 / dof, algorithm_line(name, k)
        beyond = int(np.sum(r > right))
        density = np.histogram(r, edges)[0] / (len(r) * np.diff(np.log(edges)))
        inside = np.mean(d2 < stats.chi2.ppf(confidence, dof))
        label = f"{algorithm_label(name)}: mean {d2.sum() / dof.sum():.3g}, {inside:.0%} inside {confidence:.0%}"
        label += f", {beyond} beyond" if beyond else ""
        ax.stairs(density, edges, color=look["color"], lw=1.6, ls=look["linestyle"], label=label, zorder=3)
    ax.axvline(1.0, color=style.BLACK, lw=0.8, ls="--", zorder=1)
    ax.set_xscale("log")
    ax.set_xlim(left, right)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("joint NEES / n of a local map")
    ax.set_ylabel("density over ln(NEES / n)")
    ax.set_title(f"{most} local maps, each in the frame of its first pose" if title is None else title,
                 fontsize="medium")  # fmt: skip
    # long labels: under the axes, which they would else squeeze
    style.legend(ax, outside=False, loc="upper left", bbox_to_anchor=(0.0, -0.2), borderaxespad=0.0)
    return ax
