"""Plot of the loops of a run over its path: accepted, rejected and removed ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.plots import style

# verdict -> colour, line, width: loops in the graph are emphasised
_LINES = {
    "rejected": (style.GREY, ":", 0.9),
    "undone": (style.PURPLE, "--", 1.4),
    "switched-off": (style.ORANGE, "--", 1.4),
    "accepted": (style.VERMILION, "-", 2.0),
}


def plot_loops(
    ax: Axes | None,
    path: ArrayLike,
    nodes: ArrayLike,
    loops: Sequence[tuple[int, int, str]],
    *,
    names: Sequence[object] | None = None,
    title: str | None = None,
) -> Axes:
    """Path from above, and a line between the two nodes of every loop.

    Parameters
    ----------
    path : (n, ≥ 2)
        Positions along the path [m].
    nodes : (m, ≥ 2)
        Positions of the nodes, in the same frame.
    loops : sequence of (i, j, verdict)
        Nodes and ``accepted``, ``rejected``, ``switched-off`` or ``undone``.
    names : sequence, optional
        One per loop, written beside those that are, or were, in the graph.
    """
    p, x = np.asarray(path, dtype=np.float64), np.asarray(nodes, dtype=np.float64)
    for i, j, verdict in loops:
        if not (0 <= i < len(x) and 0 <= j < len(x)) or verdict not in _LINES:
            raise DataError(
                "loop cannot be drawn", got=(i, j, verdict), wanted=f"nodes 0 to {len(x) - 1}, one of {sorted(_LINES)}"
            )
    ax = style.new_axes(ax)
    ax.plot(p[:, 0], p[:, 1], color=style.ESTIMATE, lw=1.2, label="path", zorder=2)
    ax.plot(x[:, 0], x[:, 1], ".", color=style.ESTIMATE, ms=3.5, label="nodes", zorder=2.1)
    for k, (verdict, (colour, line, width)) in enumerate(_LINES.items()):
        ends = np.array([(i, j) for i, j, v in loops if v == verdict], dtype=np.int64).reshape(-1, 2)
        if not len(ends):
            continue
        segments: Array = np.stack([x[ends[:, 0], :2], x[ends[:, 1], :2]], axis=1)
        lines = LineCollection(list(segments), colors=colour, linestyles=line, linewidths=width, zorder=3 + k)
        lines.set_label(f"{verdict} ({len(ends)})")
        ax.add_collection(lines)
        points = segments.reshape(-1, 2)  # where i and j coincide the line has no length
        ax.plot(points[:, 0], points[:, 1], "o", color=colour, ms=4.0, mfc="none", mew=1.0, zorder=3 + k)
    for (i, j, verdict), name in zip(loops, names or ()):
        if verdict != "rejected":
            u, v = 0.5 * (x[i, :2] + x[j, :2])
            ax.annotate(
                str(name), (float(u), float(v)), xytext=(4, 4), textcoords="offset points", fontsize="small", zorder=9
            )
    style.metric_axes(ax)
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax
