"""GPS residuals on the ground: which way each pass over a place disagrees with the map."""

from __future__ import annotations

from matplotlib.axes import Axes

from graphslam.core.geometry import Array
from graphslam.evaluate.gps import GpsResiduals
from graphslam.evaluate.gps_repeatability import fix_segments
from graphslam.plots import style


def plot_gps_vectors(
    ax: Axes | None,
    residuals: GpsResiduals,
    *,
    scale: float = 10.0,
    gap: float = 2.0,
    path: Array | None = None,
    title: str | None = None,
) -> Axes:
    """Residual of every fix as an arrow from the map's point towards the fix, enlarged, a colour a segment.

    Parameters
    ----------
    scale : float
        Enlargement of the arrows; the legend says it.
    gap : float
        A pause longer than this starts a new segment [s].
    path : (n, 2), optional
        Path in the GPS frame, as background.
    """
    ax = style.new_axes(ax)
    if path is not None:
        ax.plot(path[:, 0], path[:, 1], color=style.PALE, lw=1.5, label="path", zorder=1)
    segment = fix_segments(residuals.times, gap)
    p, r = residuals.points, residuals.residuals
    for k in range(int(segment.max(initial=-1)) + 1):
        of = segment == k
        ax.quiver(
            p[of, 0],
            p[of, 1],
            scale * r[of, 0],
            scale * r[of, 1],
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.0016,
            color=style.colour(k),
            zorder=3,
        )
    ax.plot([], [], color=style.colour(0), lw=1.5, label=f"map → fix, × {scale:g}; one colour a segment")
    ax.update_datalim(p + scale * r)
    ax.autoscale_view()
    style.metric_axes(ax, "east", "north")
    ax.set_title(title if title is not None else f"GPS residuals of {len(p)} fixes", fontsize="medium")
    style.legend(ax, outside=False, loc="best")
    return ax
