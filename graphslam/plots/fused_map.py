"""Plots of fused maps: each floor as a plan with the path on it, and a vertical cut."""

from __future__ import annotations

from itertools import chain, starmap

import numpy as np
from matplotlib.axes import Axes

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, UNKNOWN
from graphslam.maps.export import floor_plan
from graphslam.plots import style
from graphslam.plots.evidence import plot_section, probability, voxel_bounds

# Walls are black here, which in other figures is the colour of the ground truth: that is light blue here.
BELOW = 1.5
"""A path is drawn on a floor's plan down to this distance below its band [m]."""


def plot_storey(
    grid: EvidenceGrid,
    low: float,
    high: float,
    ax: Axes | None = None,
    *,
    path: Trajectory | None = None,
    truth: Trajectory | None = None,
    title: str | None = None,
) -> Axes:
    """Plan of a band of heights: the most occupied voxel of every column; white free, black occupied, grey unknown.

    Parameters
    ----------
    grid : EvidenceGrid
        3-D.
    low, high : float
        The band [m].
    path : Trajectory, optional
        ``T_world_body``; drawn where it is in the band, or less than 1.5 m below.
    truth : Trajectory, optional
        Ground-truth path in the same frame, drawn in the same way.
    """
    ax = plot_section(floor_plan(grid, low, high), ax, title=title or f"{low:.1f} to {high:.1f} m")
    for track, color, label in ((truth, style.SKY, "truth"), (path, style.VERMILION, "path")):
        if track is not None:
            p = track.positions
            here = (p[:, 2] > low - BELOW) & (p[:, 2] < high)
            line = np.where(here[:, None], p, np.nan)
            ax.plot(line[:, 0], line[:, 1], color=color, lw=0.9, label=label)
    if path is not None or truth is not None:
        style.legend(ax)
    return ax


def cut_plane(path: Trajectory) -> tuple[int, float]:
    """Vertical cut that shows most of the map: its horizontal normal (0 or 1) and its position on that axis [m].

    Along the longer side of the path, through the middle of its climbing parts or, if there are none, of the path.
    """
    p = path.positions
    across = 1 if np.ptp(p[:, 0]) >= np.ptp(p[:, 1]) else 0
    step = np.diff(p, axis=0)
    climbs = np.abs(step[:, 2]) > 0.05 * np.maximum(np.linalg.norm(step[:, :2], axis=1), 1e-9)
    rising = np.ptp(p[:, 2]) > 1.5 and climbs.any()
    return across, float(np.median(p[:-1][climbs, across] if rising else p[:, across]))


def slab(grid: EvidenceGrid, axis: int, low: float, high: float) -> tuple[Array, tuple[float, float, float, float]]:
    """Probabilities ``(heights, columns)`` of the most occupied voxel across a slab, NaN where nothing is known.

    Parameters
    ----------
    grid : EvidenceGrid
        3-D.
    axis : {0, 1}
        Across the slab.
    low, high : float
        Voxels whose centres lie in between [m].

    Returns
    -------
    probabilities, extent : of the other horizontal axis and of heights [m]
    """
    size = grid.voxel_size
    first, last = (int(np.ceil(v / size - 0.5)) for v in (low, high))
    if grid.dim != 3 or axis not in (0, 1) or last <= first:
        raise ConfigError(f"no slab of a {grid.dim}-D grid across axis {axis} from {low} to {high} m")
    start, end = voxel_bounds(grid)
    along = 1 - axis
    out = np.full((int(end[2] - start[2]), int(end[along] - start[along])), UNKNOWN, np.int16)
    blocks = ((BRICK_EDGE * c, v.reshape(-1, BRICK_EDGE, BRICK_EDGE, BRICK_EDGE)) for c, v in grid.brick_blocks())
    for c, v in chain.from_iterable(starmap(zip, blocks)):  # v: z, y, x
        k = np.arange(c[axis], c[axis] + BRICK_EDGE)
        keep = (k >= first) & (k < last)
        if keep.any():
            # unknown is the least value there is
            top = (v[:, keep, :].max(axis=1)) if axis == 1 else (v[:, :, keep].max(axis=2))
            i, j = int(c[2] - start[2]), int(c[along] - start[along])
            block = out[i : i + BRICK_EDGE, j : j + BRICK_EDGE]
            np.maximum(block, top, out=block)
    extent = (start[along] * size, end[along] * size, start[2] * size, end[2] * size)
    return probability(out), extent


def plot_cut(
    grid: EvidenceGrid,
    path: Trajectory,
    ax: Axes | None = None,
    *,
    truth: Trajectory | None = None,
    title: str | None = None,
) -> Axes:
    """A slab of the map of 2 m from the side, along the longer side of the path and through its climbing parts.

    Heights are exaggerated by a factor of 2.

    Parameters
    ----------
    grid : EvidenceGrid
        3-D.
    path : Trajectory
        ``T_world_body``.
    truth : Trajectory, optional
        Ground-truth path in the same frame.
    """
    if path.dim != 3:
        raise DataError("a path in the plane has no side", got=f"{path.dim}-D", wanted="3-D")
    axis, at = cut_plane(path)
    p, extent = slab(grid, axis, at - 1.0, at + 1.0)
    ax = style.new_axes(ax, (9.0, 3.2))
    ax.set_facecolor("0.72")
    if p.size:
        ax.imshow(p, cmap="gray_r", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest")
    for track, color, label in ((truth, style.SKY, "truth"), (path, style.VERMILION, "path, all of it")):
        if track is not None:
            q = track.positions
            ax.plot(q[:, 1 - axis], q[:, 2], color=color, lw=0.9, label=label)
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero((p >= 0.5).any(axis=1))  # the sky is known, too, but of no interest
    if len(rows):
        size = grid.voxel_size
        ax.set_ylim(extent[2] + size * rows[0] - 0.5, extent[2] + size * (rows[-1] + 1) + 0.5)
    ax.set_aspect(2.0)
    names = "xy"
    ax.set(xlabel=f"{names[1 - axis]} [m]", ylabel="z [m]")
    ax.set_title(title or f"{names[axis]} = {at:.1f} m", fontsize="medium")
    style.legend(ax, outside=False, loc="upper right")
    return ax
