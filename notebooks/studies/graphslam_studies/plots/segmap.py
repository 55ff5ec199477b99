"""A SegMap: which segments there are, what each goes on from, and how a map sample grows through them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.ticker import MaxNLocator

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.plots import style
from graphslam_frontends.segslam.sampling import OPEN, MapSample
from graphslam_frontends.segslam.segmap import KINDS, MATCH, SegMap
from graphslam_studies.plots.segments import sample_paths

Place = tuple[float, float]


def plot_segmap(ax: Axes | None, segmap: SegMap, *, sample: MapSample | None = None, title: str | None = None) -> Axes:
    """The segments of a SegMap over the way, and their relations (SegSLAM Fig. 1, 4 and 5).

    A bar is a segment: of the particles that were alive at a boundary, each left one, stacked here over their interval.
    Where one bar ends all those begin that may follow it, whichever particle they are of (A6). A curved line leads
    from a segment that entered an older map to the segment it entered.

    Parameters
    ----------
    segmap : SegMap
        Only segments that are viable are drawn.
    sample : MapSample, optional
        Of this SegMap: the segments it is made of are drawn dark, and numbered in time.

    Raises
    ------
    DataError
        No segment is viable.
    """
    if not len(segmap.alive):
        raise DataError("no segment to draw", got="an empty SegMap", wanted="one that closed a segment")
    ax = style.new_axes(ax, (8.0, 3.6))
    along, intervals = segmap.path_length, segmap.intervals()
    place: dict[int, tuple[Place, Place]] = {}
    for a, b in intervals:
        for rank, i in enumerate(segmap.in_interval((int(a), int(b)))):
            place[int(i)] = ((float(along[a]), float(rank)), (float(along[b]), float(rank)))
    chosen = [] if sample is None else [int(i) for i in sample.segments[sample.in_time] if i != OPEN and i in place]
    rest = [p for i, p in place.items() if i not in chosen]
    ax.add_collection(LineCollection(rest, colors=style.SKY, linewidths=3.0, capstyle="butt", zorder=2))
    ax.plot([], [], color=style.SKY, lw=3.0, label=f"segments ({len(place)} of {segmap.particles} particles)")
    for k, i in enumerate(chosen):
        (x0, y), (x1, _) = place[i]
        ax.plot([x0, x1], [y, y], color=style.ESTIMATE, lw=4.0, solid_capstyle="butt", zorder=3,
                label=f"those of one map sample ({len(chosen)})" if k == 0 else None)  # fmt: skip
        ax.annotate(str(k), (0.5 * (x0 + x1), y), xytext=(0, 4), textcoords="offset points", ha="center",
                    fontsize="x-small", zorder=6)  # fmt: skip
    for n, x in enumerate(sorted({float(along[k]) for k in intervals.ravel()})):
        ax.axvline(x, color=style.BLACK, lw=0.6, ls="--", zorder=1, label="boundaries" if n == 0 else None)
    matches = [(i, int(segmap[i].source)) for i in place if segmap[i].kind == KINDS[MATCH]]
    matches = [(i, j) for i, j in matches if j in place]
    for n, (i, j) in enumerate(matches):
        (x0, y0), ((x1, y1), (x2, _)) = place[i][0], place[j]
        bold = i in chosen and j in chosen
        arrow = {"arrowstyle": "->", "connectionstyle": "arc3,rad=0.25", "color": style.VERMILION,
                 "lw": 1.4 if bold else 0.6, "alpha": 1.0 if bold else 0.45}  # fmt: skip
        ax.annotate("", (0.5 * (x1 + x2), y1), (x0, y0), arrowprops=arrow, zorder=5)
        if n == 0:
            ax.plot([], [], color=style.VERMILION, lw=1.2, label=f"entered an older map ({len(matches)})")
    ax.set_xlim(float(along[intervals.min()]), float(along[intervals.max()]))
    ax.set_ylim(-0.8, max(y for (_, y), _ in place.values()) + 1.2)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("way by odometry [m]")
    ax.set_ylabel("segment of its interval")
    return _titled(ax, title)


def plot_expansion(
    ax: Axes | None, segmap: SegMap, sample: MapSample, *, plane: str = "xy", title: str | None = None
) -> Axes:
    """How a map sample grows breadth-first from its root: its segments by their links from there (SegSLAM Fig. 7).

    Parameters
    ----------
    sample : MapSample
        In whose root's frame the paths are drawn.
    plane : {"xy", "xz", "yz"}
        Seen from above, or from the side.

    Raises
    ------
    DataError
        The sample holds no closed segment.
    """
    paths, matches, _ = sample_paths(segmap, sample)
    if not paths:
        raise DataError("a sample without a closed segment", got=len(sample), wanted="≥ 1")
    i, j = ("xyz".index(c) for c in plane)
    order = [k for k in sample.in_time.tolist() if sample.segments[k] != OPEN]
    depth = sample.depth[order]
    ax = style.new_axes(ax)
    norm, cmap = Normalize(0.0, max(float(depth.max()), 1.0)), colormaps["viridis"]
    for path, d in zip(paths, depth, strict=True):
        ax.plot(path[:, i], path[:, j], color=cmap(norm(float(d))), lw=1.8, zorder=2)
        middle = path[len(path) // 2]
        ax.annotate(str(int(d)), (middle[i], middle[j]), xytext=(3, 3), textcoords="offset points",
                    fontsize="x-small", zorder=6)  # fmt: skip
    for k, m in enumerate(matches):
        ax.plot([m.here[i], m.there[i]], [m.here[j], m.there[j]], color=style.VERMILION, lw=1.2, marker="o",
                ms=5.0, mfc="none", label=f"matches ({len(matches)})" if k == 0 else None, zorder=5)  # fmt: skip
    ax.plot(0.0, 0.0, "s", color=style.BLACK, ms=6, label="frame of the root", zorder=5)
    ax.figure.colorbar(ScalarMappable(norm, cmap), ax=ax, label="links from the root", shrink=0.8)
    style.metric_axes(ax, *plane)
    return _titled(ax, title, outside=False)


def plot_score_map(
    ax: Axes | None,
    positions: npt.ArrayLike,
    scores: npt.ArrayLike,
    *,
    boundaries: npt.ArrayLike = (),
    plane: str = "xy",
    title: str | None = None,
) -> Axes:
    """Predictive score where it was measured, and where segments end (SegSLAM Fig. 6, right).

    Parameters
    ----------
    positions : (n, dim)
        Of the body [m].
    scores : (n,)
        Share of the look-ahead beams that the map predicts; NaN where there is none, which is not drawn.
    boundaries : (k, dim), optional
        Positions at which segments end [m].
    plane : {"xy", "xz", "yz"}
        Seen from above, or from the side.

    Raises
    ------
    DataError
        Positions and scores differ in number, or there is no score.
    """
    p, y = np.asarray(positions, dtype=np.float64), np.asarray(scores, dtype=np.float64)
    i, j = ("xyz".index(c) for c in plane)
    if p.ndim != 2 or p.shape[1] <= max(i, j) or y.shape != p.shape[:1] or not np.isfinite(y).any():
        raise DataError("scores do not belong to the path", got=f"{y.shape} on {p.shape}", wanted="one each, one known")
    ax = style.new_axes(ax)
    known = np.isfinite(y)
    ax.plot(p[:, i], p[:, j], color=style.PALE, lw=1.0, zorder=1)
    dots = ax.scatter(p[known, i], p[known, j], c=y[known], s=14.0, cmap="viridis", vmin=0.0, vmax=1.0, lw=0, zorder=2)
    ends: Array = np.asarray(boundaries, dtype=np.float64).reshape(-1, p.shape[1])
    if len(ends):
        ax.plot(ends[:, i], ends[:, j], "x", color=style.VERMILION, ms=8, mew=2.0,
                label=f"segments end ({len(ends)})", zorder=3)  # fmt: skip
    ax.figure.colorbar(dots, ax=ax, label="share of beams predicted", shrink=0.8)
    style.metric_axes(ax, *plane)
    return _titled(ax, title, outside=False)


def _titled(ax: Axes, title: str | None, *, outside: bool = True) -> Axes:
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax, outside=outside, **({} if outside else {"loc": "best"}))
    return ax
