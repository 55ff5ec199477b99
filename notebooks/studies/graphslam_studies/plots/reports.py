"""What the front end says of its submaps, one point a submap, marked by the reason the submap ended."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import Array
from graphslam.core.submap import Submap
from graphslam.plots import style


def plot_report(
    ax: Axes | None,
    submaps: Sequence[Submap],
    key: str,
    *,
    label: str | None = None,
    limit: tuple[float, str] | None = None,
    title: str | None = None,
) -> Axes:
    """One figure of every submap's report against its key.

    Parameters
    ----------
    key : str
        Name of a number in the reports, e.g. ``min_ess``, ``scans``.
    label : str, optional
        Of the vertical axis; default the key.
    limit : (value, label), optional
        A line to compare with.

    Raises
    ------
    DataError
        A report lacks the key, or there are no submaps.
    """
    ax = style.new_axes(ax, (8.0, 3.2))
    _points(ax, submaps, np.array([_number(s, key) for s in submaps]))
    if limit is not None:
        ax.axhline(limit[0], color=style.BLACK, lw=0.9, ls="--", label=limit[1], zorder=1)
    ax.set_ylim(bottom=0.0)
    return _finish(ax, key if label is None else label, title)


def plot_submap_chi2(
    ax: Axes | None, submaps: Sequence[Submap], *, confidence: float = 0.95, title: str | None = None
) -> Axes:
    """χ²/dof of every submap's own least squares, over the two-sided bounds that right noise figures would give.

    Parameters
    ----------
    submaps : sequence of Submap
        Their reports hold ``chi2`` and ``dof``.
    confidence : float
        Of the bounds, for each submap by itself.
    """
    chi2 = np.array([_number(s, "chi2") for s in submaps])
    dof = np.array([_number(s, "dof") for s in submaps])
    if np.any(dof < 1):
        k = int(np.argmax(dof < 1))
        raise DataError(f"submap {submaps[k].key} has no degrees of freedom", got=dof[k], wanted="≥ 1")
    ax = style.new_axes(ax, (8.0, 3.2))
    bounds = np.array([chi2_mean_bounds(d, 1, confidence) for d in dof]) / dof[:, None]
    keys = np.array([s.key for s in submaps])
    ax.fill_between(keys, bounds[:, 0], bounds[:, 1], step="mid", color=style.BOUNDS, alpha=0.8, lw=0, zorder=0)
    ax.fill_between([], [], color=style.BOUNDS, alpha=0.8, lw=0, label=f"{confidence:.0%} bounds")
    ax.axhline(1.0, color=style.BLACK, lw=0.8, ls=":", label="right noise", zorder=1)
    _points(ax, submaps, chi2 / dof)
    ax.set_ylim(bottom=0.0)
    return _finish(ax, "χ² / dof", title)


def _points(ax: Axes, submaps: Sequence[Submap], values: Array) -> None:
    reasons = [str(s.report.get("ended", "unknown")) for s in submaps]
    keys = np.array([s.key for s in submaps])
    for n, reason in enumerate(sorted(set(reasons), key=lambda r: (-reasons.count(r), r))):
        of = np.array([r == reason for r in reasons])
        ax.plot(
            keys[of],
            values[of],
            style.MARKERS[n % len(style.MARKERS)],
            color=style.colour(n),
            ms=4.5,
            label=f"ended: {reason} ({int(of.sum())})",
            zorder=3,
        )


def _number(submap: Submap, key: str) -> float:
    value = submap.report.get(key)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise DataError(f"report of submap {submap.key} has no number {key!r}", got=value, wanted=sorted(submap.report))
    return float(value)


def _finish(ax: Axes, label: str, title: str | None) -> Axes:
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("submap")
    ax.set_ylabel(label)
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax
