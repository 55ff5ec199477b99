"""Plot of the segments of a path and of the matches between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.trajectory import Trajectory
from graphslam.plots import style

Path = Trajectory | npt.ArrayLike

REASON_STYLES = ("-", "--", ":", "-.")


@dataclass(frozen=True, slots=True)
class DrawnMatch:
    """A match by re-entry, drawn between the start of a segment and the matching point of the entered one.

    Parameters
    ----------
    here, there : (dim,)
        Positions of the body in the frame of the figure [m]. If far apart, the sample disagrees with the match.
    """

    here: Array
    there: Array


def plot_segments(
    ax: Axes | None,
    paths: Sequence[Path],
    *,
    matches: Sequence[DrawnMatch] = (),
    labels: Sequence[str] | None = None,
    truth: Path | None = None,
    plane: str = "xy",
    title: str | None = None,
) -> Axes:
    """Trajectories of segments, each in a colour of its own, with their matches (SegSLAM Fig. 12).

    Parameters
    ----------
    paths : sequence of Trajectory or (n, dim)
        In one frame and in the order of time; :func:`sample_paths` makes them from a map sample.
    matches : sequence of DrawnMatch
        Matches.
    labels : sequence of str, optional
        Text at the start of each; default its number.
    truth : Trajectory or (n, dim), optional
    plane : {"xy", "xz", "yz"}
        Plane of projection: view from above or from the side.
    """
    if not paths:
        raise DataError("no segment to draw")
    i, j = plan_axes(plane)
    rows = [plan_positions(p, max(i, j)) for p in paths]
    ax = style.new_axes(ax)
    if truth is not None:
        t = plan_positions(truth, max(i, j))
        ax.plot(t[:, i], t[:, j], color=style.TRUTH, lw=0.8, ls="--", label="truth", zorder=1)
    for k, p in enumerate(rows):
        ax.plot(p[:, i], p[:, j], color=style.colour(k), lw=1.6, zorder=2)
        ax.plot(p[0, i], p[0, j], marker=style.MARKERS[k % len(style.MARKERS)], color=style.colour(k), ms=4.5,
                mec="white", mew=0.5, zorder=4)  # fmt: skip
        ax.annotate(str(k) if labels is None else labels[k], (p[0, i], p[0, j]), xytext=(4, 4),
                    textcoords="offset points", fontsize="x-small", color=style.BLACK, zorder=6)  # fmt: skip
    for k, match in enumerate(matches):
        here, there = np.asarray(match.here), np.asarray(match.there)
        ax.plot([here[i], there[i]], [here[j], there[j]], color=style.BLACK, lw=1.2, marker="o", ms=5.0, mfc="none",
                label=f"matches ({len(matches)})" if k == 0 else None, zorder=5)  # fmt: skip
    style.metric_axes(ax, *plane)
    finish_plan(ax, title)
    return ax


def placed_segments(T: Array, poses: Array) -> Array:
    """Positions ``(n, dim)`` of poses moved into another frame."""
    g = group_of(T)
    return g.compose(np.broadcast_to(T, poses.shape), poses)[:, : g.dim]


def plan_positions(path: Path, column: int) -> Array:
    p = path.positions if isinstance(path, Trajectory) else np.asarray(path, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] <= column or not len(p):
        raise DataError("a path cannot be drawn in this plane", got=p.shape, wanted=f"(n ≥ 1, ≥ {column + 1})")
    return p


def plan_axes(plane: str) -> tuple[int, int]:
    if plane not in ("xy", "xz", "yz"):
        raise ConfigError(f"plane {plane!r}; known: xy, xz, yz")
    return "xyz".index(plane[0]), "xyz".index(plane[1])


def finish_plan(ax: Axes, title: str | None) -> None:
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
