"""The maps of one run as several methods see it, side by side with the truth (Fig. 4 of Combined SLAM)."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, se2_between, se2_inverse, se2_transform
from graphslam.core.log import Truth
from graphslam.core.submap import Submap
from graphslam.evaluate.consistency import nees
from graphslam.evaluate.map_error import match_ids
from graphslam.join.submap_solver import SubmapEstimate
from graphslam.plots import style
from graphslam.plots.map import landmark_blocks, plot_ellipses

Ids = npt.NDArray[np.int64]


def plot_method_maps(
    maps: Mapping[str, SubmapEstimate | Submap],
    truth: Truth,
    *,
    start: float = 0.0,
    confidence: float = 0.95,
    columns: int = 2,
    axes: list[Axes] | None = None,
) -> list[Axes]:
    """One panel a method: true and estimated path, true and estimated features, ellipses, a line between the two.

    Nothing is aligned: all is in the frame of the first base. A panel's title says the RMS error of the features and
    how many of them lie in their ellipses.

    Parameters
    ----------
    maps : mapping of label to SubmapEstimate or Submap
        Joined maps, or single maps over the whole run. Features have the ids of the ground truth; those without are
        left out.
    start : float
        Stamp of the first base [s].
    confidence : float
        Of the ellipses.

    Returns
    -------
    list of Axes
        On the same scales.
    """
    if not maps:
        raise DataError("no maps to draw")
    base = truth.trajectory.interpolate(np.array([start]))[0]
    path = se2_between(base, truth.trajectory.poses)
    marks = se2_transform(se2_inverse(base), truth.landmarks)
    if axes is None:
        rows = -(-len(maps) // columns)
        _, made = plt.subplots(
            rows, min(columns, len(maps)), figsize=(5.0 * min(columns, len(maps)), 4.8 * rows), dpi=style.DPI,
            layout="constrained", sharex=True, sharey=True, squeeze=False,
        )  # fmt: skip
        axes = list(made.ravel())
        for ax in axes[len(maps) :]:
            ax.remove()
        axes = axes[: len(maps)]
    for k, (ax, (label, one)) in enumerate(zip(axes, maps.items(), strict=True)):
        poses, ids, points, blocks = _state(one)
        a, b = match_ids(ids, truth.landmark_ids)
        ax = style.new_axes(ax)
        ax.plot(path[:, 0], path[:, 1], color=style.TRUTH, lw=0.9, ls="--", label="truth", zorder=2)
        ax.plot(marks[b, 0], marks[b, 1], "x", color=style.TRUTH, ms=3, mew=0.7, label="true feature", zorder=3)
        plot_ellipses(ax, points[a], blocks[a], confidence=confidence, label=f"feature, {confidence:.0%} ellipse")
        lines = np.stack([points[a], marks[b]], axis=1)
        ax.add_collection(LineCollection(list(lines), colors=style.GREY, linewidths=0.5, alpha=0.7, zorder=2.2))
        ax.plot(poses[:, 0], poses[:, 1], color=style.ESTIMATE, lw=1.2, label="path", zorder=3.5)
        error = marks[b] - points[a]
        inside = nees(error, blocks[a]) <= chi2_quantile(confidence, 2)
        rms = np.sqrt(np.mean(np.sum(error**2, axis=1)))
        ax.set_title(f"{label}: RMS {rms:.3g} m, {inside.mean():.0%} of {len(a)} inside", fontsize="medium")
        style.metric_axes(ax)
        ax.label_outer()
        if k == len(axes) - 1:
            style.legend(ax, outside=False, loc="best")
    return axes


def _state(one: SubmapEstimate | Submap) -> tuple[Array, Ids, Array, Array]:
    """Path, ids, features and their marginals."""
    if isinstance(one, SubmapEstimate):
        at = 3 * (len(one.poses) - 1) + np.arange(2 * len(one.landmark_ids))
        blocks = landmark_blocks(one.covariance_block(at), len(one.landmark_ids))
        return one.poses, one.landmark_ids, one.landmarks, blocks
    if one.dim != 2 or one.landmarks is None:
        raise DataError(f"submap {one.key} is no 2-D landmark map")
    poses = one.trajectory.poses if one.trajectory is not None else np.vstack([np.zeros(3), one.exit_pose])
    marks = one.landmarks
    return poses, marks.ids, marks.positions, landmark_blocks(marks.dense_covariance(), len(marks), offset=3)
