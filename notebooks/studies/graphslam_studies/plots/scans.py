"""One scan: what the laser returned, and the landmarks that were seen in it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, rotation2, se2_transform
from graphslam.core.records import LandmarkObservations, LaserScans
from graphslam.plots import style
from graphslam.plots.map import plot_ellipses


def scan_points(scans: LaserScans, k: int) -> Array:
    """Returns of scan ``k`` as points ``(n, 2)`` in the base frame; beams without a return are left out."""
    r = np.asarray(scans.ranges[k], dtype=np.float64)
    hit = np.isfinite(r) & (r < scans.max_range)
    local = r[hit, None] * np.stack([np.cos(scans.bearings[hit]), np.sin(scans.bearings[hit])], -1)
    return se2_transform(scans.T_base_sensor, local)


def observed_points(observations: LandmarkObservations, k: int) -> tuple[Array, Array]:
    """Landmarks of scan ``k`` as points ``(n, 2)`` in the base frame, with first-order covariances ``(n, 2, 2)``."""
    rows = observations.scan(k)
    r, b = observations.ranges[rows], observations.bearings[rows]
    points = se2_transform(observations.T_base_sensor, r[:, None] * np.stack([np.cos(b), np.sin(b)], -1))
    # along the beam σ_r, across it r σ_β
    spread = np.zeros((len(r), 2, 2))
    spread[:, 0, 0] = observations.sigmas[rows, 0] ** 2
    spread[:, 1, 1] = (r * observations.sigmas[rows, 1]) ** 2
    R = rotation2(b + observations.T_base_sensor[2])
    return points, np.asarray(R @ spread @ np.swapaxes(R, -1, -2))


def plot_scan(
    ax: Axes | None,
    time: float,
    *,
    scans: LaserScans | None = None,
    landmarks: LandmarkObservations | Mapping[str, LandmarkObservations] | None = None,
    confidence: float = 0.95,
    max_gap: float = 0.05,
    title: str | None = None,
) -> Axes:
    """Draw the scan nearest to ``time`` in the base frame: returns, and landmarks with their ellipses.

    Parameters
    ----------
    time : float
        Instant [s].
    scans : LaserScans, optional
        Raw returns.
    landmarks : LandmarkObservations, or mapping of label to LandmarkObservations, optional
        Several lists have different markers; only the first gets ellipses.
    confidence : float
        Of the ellipses.
    max_gap : float
        A list without a scan this near to ``time`` is an error [s].

    Raises
    ------
    DataError
        Neither scans nor landmarks, or no scan near ``time``.
    """
    lists = landmarks if isinstance(landmarks, Mapping) else {} if landmarks is None else {"landmark": landmarks}
    if scans is None and not lists:
        raise DataError("nothing to draw", wanted="scans or landmarks")
    ax = style.new_axes(ax)
    if scans is not None:
        p = scan_points(scans, _nearest(scans.times, time, max_gap, "scan"))
        ax.plot(p[:, 0], p[:, 1], ".", color=style.GREY, ms=3, label=f"return ({len(p)})", zorder=2)
    for n, (label, observations) in enumerate(lists.items()):
        p, P = observed_points(observations, _nearest(observations.times, time, max_gap, label))
        if n == 0:
            plot_ellipses(ax, p, P, confidence=confidence, label=f"{label}, {confidence:.0%} ellipse")
        ax.plot(
            p[:, 0],
            p[:, 1],
            "os^Dv"[n % 5],
            mfc="none",
            mec=style.LANDMARK if n == 0 else style.colour(n - 1),
            ms=9 + 4 * n,
            mew=1.2,
            label=f"{label} ({len(p)})",
            zorder=3,
        )
    sensor = scans.T_base_sensor if scans is not None else next(iter(lists.values())).T_base_sensor
    ax.plot(*sensor[:2], "^", color=style.BLACK, ms=7, label="sensor", zorder=4)
    style.metric_axes(ax, "ahead", "left")
    ax.set_title(title if title is not None else f"scan at {time:.2f} s", fontsize="medium")
    style.legend(ax)
    return ax


def _nearest(times: Array, time: float, max_gap: float, what: str) -> int:
    k = int(np.argmin(np.abs(times - time))) if len(times) else -1
    if k < 0 or abs(times[k] - time) > max_gap:
        raise DataError(
            f"no {what} near the time asked for", got="none" if k < 0 else f"{times[k]:.3f} s", wanted=f"{time:.3f} s"
        )
    return k
