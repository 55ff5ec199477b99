"""Maps of one log by several methods, each laid onto the GPS fixes (Fig. 10 of Combined SLAM)."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_transform
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import gps_residuals
from graphslam.plots import style


def plot_gps_maps(
    paths: Mapping[str, Trajectory],
    gps: Gps,
    *,
    landmarks: Mapping[str, npt.ArrayLike] | None = None,
    columns: int = 3,
    axes: list[Axes] | None = None,
) -> list[Axes]:
    """One panel a method: fixes, path of the antenna and landmarks in the GPS frame.

    Every path is aligned by itself, rigidly and without scale, to all fixes it covers; titles say RMSE and median.

    Parameters
    ----------
    paths : mapping of label to Trajectory
        Poses of the base, each path in any frame of its own.
    gps : Gps
        With the antenna's lever.
    landmarks : mapping of label to (n, 2), optional
        In the frame of the path of the same label.
    columns : int
    axes : list of Axes, optional

    Returns
    -------
    list of Axes
        On the same scales.

    Raises
    ------
    DataError
        Nothing to draw, landmarks without a path, or a path that covers fewer than two fixes.
    """
    if not paths:
        raise DataError("no maps to draw")
    points = dict(landmarks or {})
    if set(points) - set(paths):
        raise DataError("landmarks without a path", got=sorted(set(points) - set(paths)), wanted=sorted(paths))
    if axes is None:
        columns = min(columns, len(paths))
        rows = -(-len(paths) // columns)
        _, made = plt.subplots(
            rows, columns, figsize=(4.2 * columns, 4.4 * rows), dpi=style.DPI, layout="constrained",
            sharex=True, sharey=True, squeeze=False,
        )  # fmt: skip
        axes = list(made.ravel())
        for ax in axes[len(paths) :]:
            ax.remove()
        axes = axes[: len(paths)]
    for k, (ax, (label, path)) in enumerate(zip(axes, paths.items(), strict=True)):
        scored = gps_residuals(path, gps)
        T, s = scored.T_gps_map, scored.statistics
        fixes = scored.points + scored.residuals
        route = path.transformed(T).points(scored.lever)
        ax = style.new_axes(ax)
        ax.plot(*fixes.T, "+", color=style.GPS, ms=5, mew=0.9, label="GPS", zorder=2)
        ax.plot(*route.T, color=style.ESTIMATE, lw=1.0, label="path of the antenna", zorder=3)
        title = f"{label}\nRMSE {s.rmse:.2f} m, median {s.median:.2f} m"
        if label in points:
            marks = np.asarray(points[label], dtype=np.float64).reshape(-1, 2)
            ax.plot(*se2_transform(T, marks).T, ".", color=style.LANDMARK, ms=2.5, label="landmark", zorder=2.5)
            title += f", {len(marks)} landmarks"
        ax.set_title(title, fontsize="medium")
        style.metric_axes(ax, "east", "north")
        ax.label_outer()
        if k == len(paths) - 1:
            style.legend(ax, outside=False, loc="best")
    return axes
