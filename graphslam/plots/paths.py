"""Comparison of several paths with their reported covariances, in two or three dimensions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import position_covariances
from graphslam.core.trajectory import Trajectory
from graphslam.plots import style
from graphslam.plots.map import plot_ellipses

GRAPH = "graph, before the refinement"
_COLOURS = {
    **style.NAMES,
    "RBPF": style.VERMILION,
    "SegSLAM": style.ESTIMATE,
}


def plot_paths(
    ax: Axes | None,
    paths: Mapping[str, Trajectory],
    *,
    truth: Trajectory | Array | None = None,
    ellipses: int = 8,
    plane: str = "xy",
    title: str | None = None,
) -> Axes:
    """Paths in one frame; nothing is aligned.

    Parameters
    ----------
    paths : mapping of label to Trajectory
        Those of :data:`graphslam.plots.style.NAMES`, "RBPF" and "SegSLAM" have colours of their own.
    truth : Trajectory or (n, ≥ dim), optional
    ellipses : int
        Number per path that has covariances, distributed over its length.
    plane : {"xy", "xz", "yz"}
        Plane of projection: view from above or from the side.
    """
    if plane not in ("xy", "xz", "yz"):
        raise ConfigError(f"plane {plane!r}; known: xy, xz, yz")
    ij = ["xyz".index(c) for c in plane]
    if not paths or any(p.dim <= max(ij) for p in paths.values()):
        raise DataError("no paths to draw in this plane", got=list(paths), wanted=plane)
    ax = style.new_axes(ax)
    if truth is not None:
        t = np.asarray(truth.positions if isinstance(truth, Trajectory) else truth)[:, ij]
        ax.plot(t[:, 0], t[:, 1], color=style.TRUTH, lw=1.0, ls="--", label="truth", zorder=4)
        ax.plot(*t[-1], "x", color=style.TRUTH, ms=7, mew=1.6, zorder=5)
    for k, (label, path) in enumerate(paths.items()):
        colour = _COLOURS.get(label, style.colour(k))
        p = path.positions[:, ij]
        ax.plot(p[:, 0], p[:, 1], color=colour, lw=1.5, label=label, zorder=2.5 if label == GRAPH else 3)
        ax.plot(*p[-1], style.MARKERS[k % len(style.MARKERS)], color=colour, ms=6, mec="white", mew=0.7, zorder=5)
        if path.covariances is None or ellipses < 1:
            continue
        along = arc_length(path.positions)
        at = np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], ellipses + 1)[1:]).clip(0, len(p) - 1))
        P = position_covariances(path.poses[at], path.covariances[at])[:, ij][:, :, ij]
        plot_ellipses(ax, p[at], P, colour=colour, label=style.ellipses(label))
    style.metric_axes(ax, *plane)
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax
