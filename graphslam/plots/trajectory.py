"""Plots of the errors of a trajectory against GPS, or against a reference."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import GpsResiduals
from graphslam.evaluate.trajectory_error import TrajectoryError
from graphslam.plots import style
from graphslam.plots.paths import plot_paths

# A pause between fixes longer than this starts a new segment: no line is drawn over it [s].
SEGMENT_GAP = 2.0


def plot_gps_residuals(
    ax: Axes | None, residuals: GpsResiduals | Mapping[str, GpsResiduals], *, title: str | None = None
) -> Axes:
    """Distance between fixes and path against time, with RMSE and median of each trajectory.

    Parameters
    ----------
    residuals : GpsResiduals, or mapping of label to GpsResiduals
    """
    ax = style.new_axes(ax, (7.0, 3.2))
    top = 0.0
    named = residuals if isinstance(residuals, Mapping) else {"path": residuals}
    for k, (label, r) in enumerate(named.items()):
        s = r.statistics
        t, e = r.times, r.errors
        breaks = np.flatnonzero(np.diff(t) > SEGMENT_GAP) + 1
        t, e = np.insert(t, breaks, np.nan), np.insert(e, breaks, np.nan)
        text = f"{label}: RMSE {s.rmse:.2f} m, median {s.median:.2f} m, {s.count} fixes"
        ax.plot(t, e, color=style.colour(k), lw=0.5, marker=style.MARKERS[k], ms=2.5, label=text)
        top = max(top, s.maximum)
        ax.axhline(s.rmse, color=style.colour(k), lw=0.9, ls="--")
    ax.set_xlabel("time [s]")
    ax.set_ylabel("distance to fix [m]")
    ax.set_title(
        title if title is not None else "GPS residuals (rigid alignment, no scale; dashed: RMSE)", fontsize="medium"
    )
    ax.set_ylim(0.0, top * (1.08 + 0.12 * len(named)))  # room for the legend
    style.legend(ax, outside=False, loc="upper left")
    return ax


def plot_trajectory_error(estimate: Trajectory, reference: Trajectory, error: TrajectoryError) -> Axes:
    """Both paths from above, and the absolute error over time; returns the axes of the paths.

    Parameters
    ----------
    estimate : Trajectory
        Aligned (:meth:`TrajectoryError.aligned`).
    error : TrajectoryError
        ATE.
    """
    figure, (above, below) = plt.subplots(2, 1, figsize=(7.0, 7.5), height_ratios=(2.5, 1.0))
    plot_paths(above, {"estimate": estimate}, truth=reference, title=f"alignment: {error.alignment}")
    s = error.statistics
    below.plot(error.times, error.translation, color=style.ESTIMATE, lw=1.0)
    below.axhline(s.rmse, color=style.VERMILION, lw=0.9, ls="--", label=f"RMSE {s.rmse:.3g} m")
    below.set_xlabel("time [s]")
    below.set_ylabel("ATE [m]")
    style.legend(below, outside=False)
    figure.tight_layout()
    return above
