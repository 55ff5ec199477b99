"""How sure segments are of where they end, and how far off they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import position_covariances
from graphslam.core.submap import Submap
from graphslam.plots import style
from graphslam_studies.evaluate.exit_nees import ExitNees
from graphslam_studies.plots.exit_points import draw_exits

_COLOURS = (style.ESTIMATE, style.PURPLE, style.GREEN)


def plot_segment_exit(
    ax: Axes | None,
    handovers: Mapping[str, Submap],
    *,
    exits: Array | None = None,
    weights: Array | None = None,
    truth: Array | None = None,
    confidence: float = 0.95,
    title: str | None = None,
) -> Axes:
    """Where a segment ends, from above, in the frame of its own start: particles, Gaussians, truth.

    Parameters
    ----------
    handovers : mapping of label to Submap
        Of one segment, with different covariances.
    exits : (n, 7) or (n, 3), optional
        Of the particles, in the same frame.
    weights : (n,), optional
        The area of a dot grows with them.
    truth : (7,) or (3,), optional
    confidence : float
        Of the ellipses.

    Raises
    ------
    DataError
        Nothing to draw.
    """
    if not handovers:
        raise DataError("no submap to draw")
    ax = style.new_axes(ax, (5.5, 4.5))
    if exits is not None:
        w = np.full(len(exits), 1.0 / len(exits)) if weights is None else weights
        area = np.clip(20.0 * len(exits) * w, 3.0, 90.0)
        ax.scatter(exits[:, 0], exits[:, 1], s=area, color=style.GREY, alpha=0.6, lw=0, zorder=2,
                   label=f"{len(exits)} segments of the interval")  # fmt: skip
    ends = {
        label: (s.exit_pose[:2], position_covariances(s.exit_pose[None], s.exit_covariance[None])[0, :2, :2])
        for label, s in handovers.items()
    }
    draw_exits(ax, ends, colours=_COLOURS, truth=truth, truth_label="truth", confidence=confidence, title=title)
    style.legend(ax)
    return ax


def plot_exit_nees(
    ax: Axes | None, scores: Mapping[str, ExitNees], *, confidence: float = 0.95, title: str | None = None
) -> Axes:
    """Squared error of every segment's exit in units of its covariance, for several covariances (log scale).

    Consistent ones scatter around 1 and leave the grey band (quantiles of a single χ²) once in twenty times.

    Parameters
    ----------
    scores : mapping of label to ExitNees
        Of the same segments, in order.
    confidence : float
        Of the band.

    Raises
    ------
    DataError
        Nothing to draw, or different segments.
    """
    lengths = {len(s.values) for s in scores.values()}
    if len(lengths) != 1 or lengths == {0}:
        raise DataError("no exits to draw, or different ones", got=sorted(lengths), wanted="as many of each")
    ax = style.new_axes(ax, (7.0, 3.4))
    n = lengths.pop()
    dof = next(iter(scores.values())).dof
    tail = 0.5 * (1.0 - confidence)
    low, high = chi2_quantile(tail, dof) / dof, chi2_quantile(1.0 - tail, dof) / dof
    ax.axhspan(low, high, color=style.BOUNDS, alpha=0.6, lw=0, zorder=0, label=f"consistent, {confidence:.0%}")
    ax.axhline(1.0, color=style.GREY, lw=0.7, zorder=1)
    x = np.arange(n)
    for k, (label, s) in enumerate(scores.items()):
        y = np.maximum(s.values / s.dof, 1e-3)
        text = (
            f"{label}: mean {s.per_dof:,.1f}, {int(np.sum(s.values <= chi2_quantile(confidence, dof)))} of {n} inside"
        )
        ax.vlines(x + 0.12 * k, 1.0, y, color=_COLOURS[k % len(_COLOURS)], lw=1.2, alpha=0.6, zorder=2)
        ax.plot(x + 0.12 * k, y, style.MARKERS[k % len(style.MARKERS)], color=_COLOURS[k % len(_COLOURS)], ms=5.5,
                label=text, zorder=3)  # fmt: skip
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("segment of the settled chain")
    ax.set_ylabel("NEES / degree of freedom")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax, outside=False, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncol=1)
    return ax
