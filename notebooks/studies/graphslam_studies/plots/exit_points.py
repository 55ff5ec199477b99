"""The ends of submaps as several hand-overs have them: what pictures of exits have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from graphslam.core.geometry import Array
from graphslam.plots import style
from graphslam.plots.map import plot_ellipses


def draw_exits(
    ax: Axes,
    ends: Mapping[str, tuple[Array, Array]],
    *,
    colours: Sequence[str],
    truth: Array | None,
    truth_label: str,
    confidence: float,
    title: str | None,
) -> None:
    """Draw positions with their ellipses and the truth, on equal scales in metres.

    Parameters
    ----------
    ends : mapping of label to ((2,), (2, 2))
        Positions and covariances in one frame.
    colours : sequence of str
        Taken in turn.
    truth : (2,) or more, optional
        Position first.
    confidence : float
        Of the ellipses.
    """
    for k, (label, (at, P)) in enumerate(ends.items()):
        colour = colours[k % len(colours)]
        plot_ellipses(ax, at, np.asarray(P)[None], confidence=confidence, colour=colour, alpha=0.12,
                      label=f"{label}, {confidence:.0%}")  # fmt: skip
        ax.plot(*at, style.MARKERS[k % len(style.MARKERS)], color=colour, ms=5, mec="white", mew=0.6, zorder=4)
    if truth is not None:
        ax.plot(*truth[:2], "x", color=style.TRUTH, ms=9, mew=1.8, label=truth_label, zorder=5)
    style.metric_axes(ax)
    if title:
        ax.set_title(title, fontsize="medium")
