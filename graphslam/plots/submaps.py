"""Plot of the chain of submaps: each map in its own colour, with its frame and its exit pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from graphslam.core.errors import DataError
from graphslam.core.geometry import (
    Array,
    ArrayLike,
    rotation2,
    se2_compose,
    se2_transform,
    tangent_to_vector_covariance,
)
from graphslam.core.submap import Submap
from graphslam.plots import style
from graphslam.plots.map import landmark_blocks, plot_ellipses


def chain_poses(submaps: Sequence[Submap]) -> Array:
    """Base poses ``(m + 1, 3)`` by composing the exits: the chain before any loop closure."""
    poses = np.zeros((len(submaps) + 1, 3))
    for k, s in enumerate(submaps):
        poses[k + 1] = se2_compose(poses[k], s.exit_pose)
    return poses


def plot_submap_chain(
    ax: Axes | None,
    submaps: Sequence[Submap],
    node_poses: ArrayLike | None = None,
    *,
    landmark_ellipses: bool = False,
    ellipse_scale: float = 1.0,
    title: str | None = None,
) -> Axes:
    """Draw 2-D submaps at the poses of their bases; ellipses of exits are relative to the base of the submap.

    Parameters
    ----------
    node_poses : (m, 3) or (m + 1, 3), optional
        World poses of the bases, as solved; default the chain of exits from the origin.
    landmark_ellipses : bool
        Also draw each landmark's ellipse within its submap.
    ellipse_scale : float
        Enlarge every ellipse by this factor, stated in the legend: the σ of exits of good submaps is a few centimetres.
    """
    if not submaps:
        raise DataError("no submaps to draw")
    if any(s.dim != 2 for s in submaps):
        raise DataError("submap chain is drawn in 2-D", got="3-D submaps")
    poses = chain_poses(submaps) if node_poses is None else np.asarray(node_poses, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 3 or len(poses) not in (len(submaps), len(submaps) + 1):
        raise DataError("node poses do not fit the submaps", got=poses.shape, wanted=f"({len(submaps)}, 3)")
    ax = style.new_axes(ax)
    grow = ellipse_scale**2
    enlarged = "" if ellipse_scale == 1.0 else f" × {ellipse_scale:g}"
    exits = np.zeros((len(submaps), 2))
    covs = np.zeros((len(submaps), 2, 2))
    for k, (s, base) in enumerate(zip(submaps, poses)):
        colour = style.colour(k)
        if s.trajectory is not None:
            p = se2_transform(base, s.trajectory.positions)
        else:  # only its start and end are known
            p = se2_transform(base, np.array([[0.0, 0.0], s.exit_pose[:2]]))
        ax.plot(p[:, 0], p[:, 1], color=colour, lw=1.6, ls="-" if s.trajectory is not None else "--", zorder=2)
        exits[k] = se2_transform(base, s.exit_pose[:2])
        R = rotation2(base[2])
        covs[k] = R @ tangent_to_vector_covariance(s.exit_pose, s.exit_covariance)[:2, :2] @ R.T
        if s.landmarks is not None and len(s.landmarks):
            q = se2_transform(base, s.landmarks.positions)
            ax.plot(q[:, 0], q[:, 1], style.MARKERS[k % len(style.MARKERS)], color=colour, ms=3, alpha=0.8, zorder=3)
            if landmark_ellipses:
                blocks = R @ landmark_blocks(s.landmarks.dense_covariance(), len(s.landmarks), offset=3) @ R.T
                plot_ellipses(ax, q, grow * blocks, colour=colour, alpha=0.08)
    label = f"exit, 95% ellipse{enlarged}"
    plot_ellipses(ax, exits, grow * covs, colour=style.BLACK, label=label, alpha=0.12)
    _plot_frames(ax, poses[: len(submaps)])
    ax.plot([], [], color=style.CYCLE[0], marker="o", ms=3, label="submap")
    style.metric_axes(ax)
    ax.set_title(title if title is not None else f"{len(submaps)} submaps", fontsize="medium")
    style.legend(ax)
    return ax


def _plot_frames(ax: Axes, poses: Array) -> None:
    """x axes long and y axes short, so that a frame can be recognised without colour."""
    extent = float(np.max(np.ptp(poses[:, :2], axis=0), initial=0.0))
    size = max(0.025 * extent, 0.5)
    x = poses[:, :2] + size * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], -1)
    y = poses[:, :2] + 0.5 * size * np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], -1)
    segments = [*np.stack([poses[:, :2], x], 1), *np.stack([poses[:, :2], y], 1)]
    ax.add_collection(LineCollection(segments, colors=style.BLACK, linewidths=1.1, label="base frame", zorder=4))
