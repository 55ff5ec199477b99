"""Paths of several sessions in one map."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.plots import style
from graphslam.plots.map import Path, plot_ellipses, positions_of


def plot_merged(
    ax: Axes | None,
    paths: Mapping[str, Path],
    landmarks: npt.ArrayLike,
    covariances: npt.ArrayLike,
    seen_by: npt.ArrayLike,
) -> Axes:
    """Paths of several sessions and their common landmarks, in the frame of the first.

    Parameters
    ----------
    paths : mapping of str to Trajectory or (n, ≥ 2)
    landmarks, covariances : (n, 2), (n, 2, 2)
        Preferably of the map's shape: in the frame of one base, all covariances include the heading uncertainty of that
        base.
    seen_by : (n,)
        Number of sessions that observed each landmark; landmarks of a single session are hollow.
    """
    ax = style.new_axes(ax)
    points, seen = np.asarray(landmarks, dtype=np.float64).reshape(-1, 2), np.asarray(seen_by)
    for k, (name, path) in enumerate(paths.items()):
        p = positions_of(path)
        colour = style.CYCLE[k % len(style.CYCLE)]
        line = style.LINE_STYLES[(k // len(style.CYCLE)) % len(style.LINE_STYLES)]
        ax.plot(p[:, 0], p[:, 1], line, color=colour, lw=0.9, alpha=0.75, label=name, zorder=2)
        ax.plot(p[0, 0], p[0, 1], "o", color=colour, ms=6, mec="white", mew=0.8, zorder=4)
    plot_ellipses(ax, points, covariances, colour=style.BLACK, label="shape, 95% ellipse")
    shared = seen > 1
    ax.plot(points[shared, 0], points[shared, 1], "k.", ms=4, zorder=3.4)
    if np.any(~shared):
        alone = points[~shared]
        ax.plot(alone[:, 0], alone[:, 1], "o", mfc="none", mec="k", ms=5, label="seen by one", zorder=3.4)
    style.metric_axes(ax)
    ax.set_title(f"{len(paths)} sessions, {len(points)} landmarks, {int(shared.sum())} of them shared")
    style.legend(ax)
    return ax
