"""A path before and after its refinement by scans."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.core.geometry import Array
from graphslam.core.poses import position_covariances
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.plots import style


def plot_before_after(
    ax: Axes | None,
    graph: Trajectory,
    refined: Trajectory,
    *,
    truth: Trajectory | None = None,
) -> Axes:
    """Errors of both paths, each aligned, over time; without ground truth the correction made by the refinement.

    Parameters
    ----------
    graph, refined : Trajectory
        Start of the refinement, and its result. Covariances of the result are drawn as its reported σ.
    """
    ax = style.new_axes(ax, (8.0, 3.2))
    begin = refined.times[0]
    if truth is None:
        moved = ate(graph, refined)
        rms = float(np.sqrt(np.mean(moved.translation**2)))
        label = f"graph to refined path, RMS {rms:.3f} m"
        ax.plot(moved.times - begin, moved.translation, color=style.GRAPH, lw=1.4, label=label)
    else:
        for path, name, colour in ((graph, "graph", style.GRAPH), (refined, "refined", style.ESTIMATE)):
            e = ate(path, truth)
            label = f"{name}, RMS {e.statistics.rmse:.3f} m"
            ax.plot(e.times - begin, np.maximum(e.translation, 1e-4), color=colour, lw=1.4, label=label)
    if refined.covariances is not None:
        P = position_covariances(refined.poses, refined.covariances)
        sigma = np.sqrt(np.maximum(np.trace(P, axis1=1, axis2=2), 0.0))
        keep = sigma > 1e-4  # the first position is fixed
        label = "refined, σ of the position"
        ax.plot(refined.times[keep] - begin, sigma[keep], color=style.GREY, lw=1.0, ls="--", label=label)
    ax.set_yscale("log")
    ax.set_xlabel("time [s]")
    ax.set_ylabel("distance from ground truth [m]" if truth is not None else "distance [m]")
    ax.set_title("path before and after refinement", fontsize="medium")
    style.legend(ax)
    return ax


def plot_scans_along(points: Mapping[str, Array], paths: Mapping[str, Trajectory], *, title: str) -> Axes:
    """Scan points from above along several paths, one panel each; in 3-D coloured by height. Returns the last axes.

    Parameters
    ----------
    points : mapping of label to (q, 2) or (q, 3)
        In the frame of the path of the same label [m].
    """
    figure, panels = plt.subplots(1, len(points), figsize=(5.0 * len(points), 5.0), sharex=True, sharey=True)
    for ax, (name, x) in zip(np.atleast_1d(panels), points.items()):
        height = x[:, 2] if x.shape[1] == 3 else np.zeros(len(x))
        low, high = np.quantile(height, (0.02, 0.98))
        ax.scatter(*x[:, :2].T, c=height, vmin=low, vmax=high, cmap="viridis", s=0.3, lw=0, rasterized=True)
        ax.plot(*paths[name].positions[:, :2].T, color=style.VERMILION, lw=0.8)
        style.metric_axes(ax)
        ax.set_title(name, fontsize="medium")
    figure.suptitle(title, fontsize="medium")
    figure.tight_layout()
    return ax


def plot_yaw_bias(ax: Axes | None, knots: npt.ArrayLike) -> Axes:
    """Bias of the yaw rate over time.

    Parameters
    ----------
    knots : (k, 2)
        Time [s] and bias [rad/s].
    """
    t, bias = np.asarray(knots, dtype=np.float64).reshape(-1, 2).T
    ax = style.new_axes(ax, (8.0, 2.4))
    ax.plot(t - t[0], 1e3 * bias, color=style.ESTIMATE, marker="o", ms=3, lw=1.2)
    ax.axhline(0.0, color=style.GREY, lw=0.8)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("yaw bias [mrad/s]")
    ax.set_title("yaw rate bias estimated by the refinement", fontsize="medium")
    return ax
