"""One submap in its own frame: where it went, what it saw, how sure it is, and correlation of its errors."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from graphslam.core.errors import DataError
from graphslam.core.geometry import tangent_to_vector_covariance
from graphslam.core.log import Truth
from graphslam.core.submap import Submap
from graphslam.plots import style
from graphslam.plots.map import landmark_blocks, plot_ellipses
from graphslam_studies.evaluate.submap_consistency import true_submap


def plot_local_map(
    ax: Axes | None,
    submap: Submap,
    *,
    truth: Truth | None = None,
    confidence: float = 0.95,
    title: str | None = None,
) -> Axes:
    """Draw a 2-D submap in the frame of its first pose, with the ellipses of exit and landmarks.

    Parameters
    ----------
    truth : Truth, optional
        True exit and landmarks are drawn over it, in the same frame: nothing is aligned.
    confidence : float
        Of the ellipses.
    """
    if submap.dim != 2:
        raise DataError(f"submap {submap.key} is 3-D", wanted="2-D")
    ax = style.new_axes(ax)
    if submap.trajectory is not None:
        p = submap.trajectory.positions
        ax.plot(p[:, 0], p[:, 1], color=style.ESTIMATE, lw=1.6, label="path", zorder=2)
    ax.plot(0.0, 0.0, "s", color=style.BLACK, ms=6, label="base: zero by definition", zorder=4)
    exit_block = tangent_to_vector_covariance(submap.exit_pose, submap.exit_covariance)[None, :2, :2]
    exit_label = f"exit, {confidence:.0%} ellipse"
    plot_ellipses(ax, submap.exit_pose[:2], exit_block, confidence=confidence, colour=style.ESTIMATE, label=exit_label)
    ax.plot(*submap.exit_pose[:2], "o", color=style.ESTIMATE, ms=4, zorder=4)
    m = submap.landmarks
    if m is not None and len(m):
        blocks = landmark_blocks(m.dense_covariance(), len(m), offset=3)
        plot_ellipses(ax, m.positions, blocks, confidence=confidence, label=style.ellipses("landmarks", confidence))
        ax.plot(m.positions[:, 0], m.positions[:, 1], ".", color=style.LANDMARK, ms=4, zorder=3)
    if truth is not None:
        exit_pose, _, points = true_submap(submap, truth)
        q = np.vstack([exit_pose[None, :2], points])
        ax.plot(q[:, 0], q[:, 1], "x", color=style.TRUTH, ms=6, mew=1.0, label="truth", zorder=5)
    style.metric_axes(ax)
    t0, t1 = submap.interval
    n = 0 if m is None else len(m)
    ax.set_title(
        title if title is not None else f"submap {submap.key}: {t1 - t0:.1f} s, {n} landmarks", fontsize="medium"
    )
    style.legend(ax)
    return ax


def plot_correlation(ax: Axes | None, submap: Submap, *, title: str | None = None) -> Axes:
    """Correlation coefficients of a landmark submap's vector ``[x, y, θ, l1x, l1y, …]`` as an image, -1 … 1."""
    if submap.landmarks is None:
        raise DataError(f"submap {submap.key} has no landmarks", wanted="a joint Gaussian over exit and landmarks")
    P = submap.landmarks.dense_covariance()
    sigma = np.sqrt(np.diag(P))
    ax = style.new_axes(ax, (5.5, 4.6))
    ax.grid(False)
    image = ax.imshow(P / np.outer(sigma, sigma), vmin=-1.0, vmax=1.0, cmap="RdBu_r", interpolation="nearest")
    d = 3 if submap.dim == 2 else 6
    ax.axhline(d - 0.5, color=style.BLACK, lw=0.8)
    ax.axvline(d - 0.5, color=style.BLACK, lw=0.8)
    ticks = [0.5 * (d - 1), 0.5 * (d + len(P) - 1)]
    ax.set_xticks(ticks, ["exit", "landmarks"])
    ax.set_yticks(ticks, ["exit", "landmarks"], rotation=90, va="center")
    ax.tick_params(length=0)
    ax.figure.colorbar(image, ax=ax, label="correlation", shrink=0.85)
    ax.set_title(title if title is not None else f"submap {submap.key}: correlation of its errors", fontsize="medium")
    return ax
