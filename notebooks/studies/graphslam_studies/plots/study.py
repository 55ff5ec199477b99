"""Figures of a Monte-Carlo study from its tidy table: consistency, errors with their bands, RMS.

Every function takes the rows of *one* world. The run is the unit of all bounds: errors of one run hang together.
Times and local maps are drawn by neighbours, and can be had from here too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_mean_bounds, chi2_quantile
from graphslam.core.geometry import Array, ArrayLike
from graphslam.plots import style
from graphslam_studies.evaluate.tables import values_of
from graphslam_studies.plots.algorithms import algorithm_label, algorithm_line
from graphslam_studies.plots.study_local import plot_local_consistency as plot_local_consistency
from graphslam_studies.plots.study_table import algorithms_with, curve_of
from graphslam_studies.plots.study_time import plot_cumulative_time as plot_cumulative_time

DOF = {"pose_nees": 3, "feature_nees": 2, "local_pose_nees": 3}
_NAMES = {"pose_nees": "end pose", "feature_nees": "features"}
_COMPONENTS = (("x", 1.0, "m"), ("y", 1.0, "m"), ("heading", np.degrees(1.0), "°"))
_RMS = (("pose_rms", "position", 1.0, "m"), ("heading_rms", "heading", np.degrees(1.0), "°"),
        ("feature_rms", "features", 1.0, "m"))  # fmt: skip


def median_bounds(dof: float, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of the median of ``runs`` independent χ²: quantiles of its order statistic, a Beta variable."""
    k = (runs + 1) / 2.0
    a = (1.0 - confidence) / 2.0
    order = stats.beta(k, runs + 1 - k)
    return float(stats.chi2.ppf(order.ppf(a), dof)), float(stats.chi2.ppf(order.ppf(1.0 - a), dof))


def plot_ci(
    ax: Axes | None,
    table: pd.DataFrame,
    quantity: str = "pose_nees",
    *,
    algorithms: Sequence[str] | None = None,
    dof: float | None = None,
    statistic: Literal["mean", "median"] = "mean",
    confidence: float = 0.95,
    log: bool | None = None,
    title: str | None = None,
) -> Axes:
    """Consistency index along the run, mean or median over the runs (Fig. 6 of Combined SLAM).

    ``CI = D²/χ²_{n,1-α}`` (eq. 20). The band is where the mean (median) of as many runs of a consistent estimator lies;
    below it an estimator is conservative. CI = 1 is the paper's one-sided limit.

    Parameters
    ----------
    table : DataFrame
        Of one world.
    quantity : str
        A NEES: ``pose_nees``, ``feature_nees``.
    algorithms : sequence of str, optional
        Default all that have it.
    dof : float, optional
        Degrees of freedom; known for the two named.
    statistic : {"mean", "median"}
        Means are ruled by the worst run; the median says what most runs do.
    log : bool, optional
        Logarithmic axis; default where a curve leaves the decade above the bounds.

    A run without a finite value at a submap is left out there, and the legend says how many such runs there are.
    """
    names = list(algorithms or algorithms_with(table, quantity, online=True))
    n = float(DOF[quantity] if dof is None else dof)
    ax = style.new_axes(ax, (8.0, 4.0))
    q = chi2_quantile(confidence, n)
    bounds_of = median_bounds if statistic == "median" else chi2_mean_bounds
    fewest, last, top, least = 10**9, 1.0, 0.0, np.inf
    for k, name in enumerate(names):
        submaps, d2 = curve_of(table, name, quantity)
        known = np.isfinite(d2)
        some = known.any(axis=0)
        short = int(np.sum(~known[:, some].all(axis=1)))
        y = np.array([np.median(c[np.isfinite(c)]) if statistic == "median" else c[np.isfinite(c)].mean() for c in
                      d2[:, some].T]) / q  # fmt: skip
        x = submaps[some] + 1
        label = algorithm_label(name) + (f" ({short} of {len(d2)} runs not to the end)" if short else "")
        every = max(1, len(x) // 10)
        ax.plot(x, y, lw=1.5, ms=4.5, markevery=(k * every // max(len(names), 1), every), label=label, zorder=3,
                **algorithm_line(name, k))  # fmt: skip
        fewest, last = min(fewest, len(d2)), max(last, float(x.max(initial=1.0)))
        top, least = max(top, float(y.max(initial=0.0))), min(least, float(y[y > 0].min(initial=np.inf)))
    low, high = (b / q for b in bounds_of(n, fewest, confidence))
    what = f"{confidence:.0%} bounds of the {statistic}, {fewest} run{'s' if fewest != 1 else ''}"
    ax.axhspan(low, high, color=style.BOUNDS, alpha=0.8, lw=0, label=what, zorder=0)
    consistent = (stats.chi2.ppf(0.5, n) if statistic == "median" else n) / q
    ax.axhline(consistent, color=style.GREY, lw=0.9, ls=":", label=f"{statistic} if consistent", zorder=1)
    ax.axhline(1.0, color=style.BLACK, lw=0.8, ls="--", label="CI = 1", zorder=1)
    if log or (log is None and top > 10.0 * max(high, 1.0)):
        ax.set_yscale("log")
        ax.set_ylim(bottom=0.5 * min(low, least))
    else:
        ax.set_ylim(bottom=0.0)
    ax.set_xlim(1.0, max(last, 2.0))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel(f"{statistic} consistency index of {_NAMES.get(quantity, quantity)}")
    ax.set_title(f"n = {n:g}, first base fixed" if title is None else title, fontsize="medium")
    style.legend(ax)
    return ax


def plot_error_band(
    ax: Axes | None,
    submaps: ArrayLike,
    error: ArrayLike,
    sigma: ArrayLike,
    *,
    label: str = "error",
    unit: str = "m",
    sigmas: float = 3.0,
    colour: str = style.ESTIMATE,
    title: str | None = None,
) -> Axes:
    """One component of the error along one run, over ± ``sigmas`` of its claimed standard deviation (Fig. 5).

    Parameters
    ----------
    submaps, error, sigma : (k,)
    """
    x, e, s = (np.asarray(v, dtype=np.float64) for v in (submaps, error, sigma))
    if not x.shape == e.shape == s.shape or np.any(s < 0):
        raise DataError("an error band needs as many standard deviations, none negative", got=(x.shape, s.shape))
    ax = style.new_axes(ax, (8.0, 2.6))
    outside = np.abs(e) > sigmas * s
    ax.fill_between(x, -sigmas * s, sigmas * s, color=colour, alpha=0.15, lw=0, label=f"±{sigmas:g}σ claimed")
    ax.plot(x, sigmas * s, color=colour, lw=0.8, alpha=0.7)
    ax.plot(x, -sigmas * s, color=colour, lw=0.8, alpha=0.7)
    ax.plot(x, e, color=style.BLACK, lw=1.2, label="error")
    if outside.any():
        ax.plot(x[outside], e[outside], "o", color=style.VERMILION, ms=3.0, label=f"outside ({outside.mean():.0%})")
    ax.axhline(0.0, color=style.GREY, lw=0.6)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel(f"{label} [{unit}]")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def plot_error_panels(
    table: pd.DataFrame,
    algorithm: str | None = None,
    *,
    run: int | None = None,
    axes: Sequence[Axes] | None = None,
    title: str | None = None,
) -> list[Axes]:
    """Error in x, y and heading with its 3σ band along one run of one algorithm (Fig. 5).

    Parameters
    ----------
    table : DataFrame
        Of one world.
    algorithm : str, optional
        Default ``rbpf-eif``, or else the first that has errors.
    run : int, optional
        Default the first run. A figure of one run is an example, not evidence.
    axes : three Axes, optional
    """
    names = algorithms_with(table, "error_x", online=True)
    name = algorithm or ("rbpf-eif" if "rbpf-eif" in names else names[0])
    own = table[(table["algorithm"] == name) & (table["submap"] >= 0)]
    runs = sorted(set(own["run"]))
    chosen = runs[0] if run is None and runs else run
    own = own[own["run"] == chosen]
    if own.empty:
        raise DataError(f"table has no run {chosen} of {name!r}", wanted=f"of {', '.join(names)}; runs {runs}")
    if axes is None:
        _, made = plt.subplots(3, 1, figsize=(8.0, 6.5), dpi=style.DPI, layout="constrained", sharex=True)
        axes = list(made)
    for ax, (component, factor, unit) in zip(axes, _COMPONENTS):
        submaps, error = values_of(own, name, f"error_{component}")
        at, sigma = values_of(own, name, f"sigma_{component}")
        if not np.array_equal(submaps, at):
            raise DataError(f"errors and standard deviations of {name!r} are of different submaps", where=component)
        style.new_axes(ax)
        plot_error_band(ax, submaps + 1, factor * error[0], factor * sigma[0], label=f"error of {component}", unit=unit)
        if ax is not axes[-1]:
            ax.set_xlabel("")
    axes[0].set_title(title or f"{algorithm_label(name)}, run {chosen}", fontsize="medium")
    return list(axes)


def plot_rms(
    ax: Axes | None,
    table: pd.DataFrame,
    quantity: str = "feature_rms",
    *,
    algorithms: Sequence[str] | None = None,
    factor: float = 1.0,
    label: str | None = None,
    unit: str = "m",
    log: bool | None = None,
    title: str | None = None,
) -> Axes:
    """A figure of whole runs, one row an algorithm: every run a point, mean and median marked (Fig. 7).

    Parameters
    ----------
    table : DataFrame
        Of one world.
    factor : float
        From the table's unit to ``unit``.
    log : bool, optional
        Logarithmic axis; default where the values span more than a factor of 30.
    """
    names = list(algorithms or algorithms_with(table, quantity, online=False))
    ax = style.new_axes(ax, (7.0, 0.9 + 0.4 * len(names)))
    whole = table[table["submap"] == -1]
    every: list[Array] = []
    for k, name in enumerate(names):
        rows = whole[(whole["algorithm"] == name) & (whole["quantity"] == quantity)]
        v = factor * rows["value"].to_numpy(dtype=np.float64)
        lost, v = int(np.sum(~np.isfinite(v))), v[np.isfinite(v)]
        y = len(names) - 1 - k
        colour = algorithm_line(name, k)["color"]
        ax.scatter(v, y + _spread(len(v)), s=14, color=colour, alpha=0.45, lw=0, zorder=2)
        if len(v):
            first = not every
            mean, median = float(v.mean()), float(np.median(v))
            ax.plot([median] * 2, [y - 0.3, y + 0.3], color=style.BLACK, lw=1.6, zorder=3,
                    label="median" if first else None)  # fmt: skip
            ax.plot([mean], [y], "D", color=colour, mec=style.BLACK, mew=0.8, ms=7, zorder=4)
            if first:
                ax.plot([], [], "D", color="white", mec=style.BLACK, mew=0.8, ms=7, label="mean")
                ax.plot([], [], "o", color=style.GREY, alpha=0.6, ms=4, lw=0, label="one run")
            every.append(v)
        if lost or not len(v):
            text = f"{lost} without a figure" if lost else "no figure"
            ax.text(0.995, y, text, transform=ax.get_yaxis_transform(), ha="right", va="center", fontsize="small")
    values = np.concatenate(every) if every else np.ones(1)
    if log or (log is None and values.min() > 0 and values.max() > 30.0 * values.min()):
        ax.set_xscale("log")
        # within a decade or two the default labels every minor tick, one over the other
        few = bool(values.min() > 0 and values.max() < 300.0 * values.min())
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if few else (1.0,)))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    else:
        ax.set_xlim(left=0.0)
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set_yticks(range(len(names)), [algorithm_label(name) for name in reversed(names)])
    ax.grid(False, axis="y")
    ax.set_xlabel(f"{label or quantity} [{unit}]")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def _spread(n: int) -> Array:
    """Offsets that keep points of a row apart; the same every time."""
    return np.asarray(0.44 * ((np.arange(n) * 0.618034) % 1.0 - 0.5), dtype=np.float64)


def plot_rms_panels(
    table: pd.DataFrame, *, algorithms: Sequence[str] | None = None, axes: Sequence[Axes] | None = None
) -> list[Axes]:
    """RMS of position, heading and features of every algorithm, side by side (Fig. 7)."""
    names = list(algorithms or algorithms_with(table, "feature_rms", online=False))
    if axes is None:
        size = (12.0, 1.1 + 0.32 * len(names))
        _, made = plt.subplots(1, 3, figsize=size, dpi=style.DPI, layout="constrained", sharey=True)
        axes = list(made)
    for ax, (quantity, what, factor, unit) in zip(axes, _RMS):
        plot_rms(ax, table, quantity, algorithms=names, factor=factor, label=f"RMS error of {what}", unit=unit)
        if ax is not axes[-1] and (legend := ax.get_legend()) is not None:
            legend.remove()
    return list(axes)
