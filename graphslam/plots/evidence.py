"""Plots of evidence grids: sections and height maps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, STEP, UNKNOWN
from graphslam.plots import style

_AXES = {"x": 0, "y": 1, "z": 2}


def voxel_bounds(grid: EvidenceGrid) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First and one past the last voxel of the grid's bricks, ``(3,)`` each; zeros for an empty grid."""
    c = grid.brick_coordinates()
    if len(c) == 0:
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    return BRICK_EDGE * c.min(axis=0), BRICK_EDGE * (c.max(axis=0) + 1)


def grid_section(
    grid: EvidenceGrid, axis: str = "z", at: float = 0.0
) -> tuple[Array, tuple[float, float, float, float]]:
    """Probabilities of the voxels a plane cuts, ``(rows, columns)``, NaN where nothing is known, and their extent [m].

    Columns and rows are the other two axes in the order x, y, z.
    """
    if axis not in _AXES or (grid.dim == 2 and axis != "z"):
        raise ConfigError(f"no section across {axis!r}; wanted x, y or z (z for a 2-D grid)")
    k = _AXES[axis]
    u, v = (i for i in range(3) if i != k)
    first, last = voxel_bounds(grid)
    size = grid.voxel_size
    a, b = np.arange(first[u], last[u]), np.arange(first[v], last[v])
    points = np.empty((len(b), len(a), 3))
    points[..., u] = (a[None, :] + 0.5) * size
    points[..., v] = (b[:, None] + 0.5) * size
    points[..., k] = at
    values = grid.values_at(points.reshape(-1, 3)[:, : grid.dim]).reshape(len(b), len(a))
    extent = (first[u] * size, last[u] * size, first[v] * size, last[v] * size)
    return probability(values), extent


def probability(values: npt.NDArray[np.int16]) -> Array:
    """Values of voxels as probabilities, NaN where nothing is known."""
    p = 1.0 / (1.0 + np.exp(-values.astype(np.float64) * STEP))
    p[values == UNKNOWN] = np.nan
    return np.asarray(p)


def plot_section(
    grid: EvidenceGrid, ax: Axes | None = None, *, axis: str = "z", at: float = 0.0, title: str | None = None
) -> Axes:
    """Draw the voxels a plane cuts: white free, black occupied, grey unknown.

    Parameters
    ----------
    axis : {"z", "x", "y"}
        The plane's normal.
    at : float
        Where the plane lies on that axis [m].
    """
    ax = style.new_axes(ax)
    p, extent = grid_section(grid, axis, at)
    ax.set_facecolor("0.72")
    if p.size:
        ax.imshow(p, cmap="gray_r", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest")
    names = [n for n in _AXES if n != axis]
    ax.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", aspect="equal")
    ax.set_title(title or (f"{axis} = {at:g} m" if grid.dim == 3 else f"{grid.voxel_size:g} m voxels"))
    return ax


def plot_heights(
    grid: EvidenceGrid, ax: Axes | None = None, *, below: float | None = None, title: str | None = None
) -> Axes:
    """Draw the highest occupied voxel of each column, coloured by its height, over all known columns (grey).

    Parameters
    ----------
    grid : EvidenceGrid
        3-D.
    below : float, optional
        Leave out voxels above this height [m]: removes the roof of a building.
    """
    if grid.dim != 3:
        raise ConfigError("a 2-D grid has no heights; use plot_section")
    ax = style.new_axes(ax)
    first, last = voxel_bounds(grid)
    shape = last[:2] - first[:2]
    size = grid.voxel_size
    top = np.full((shape[1], shape[0]), -np.inf)
    known = np.zeros((shape[1], shape[0]), bool)
    for coordinates, bricks in grid.brick_blocks():
        values = bricks.reshape(-1, BRICK_EDGE, BRICK_EDGE, BRICK_EDGE)
        occupied = (values >= grid.model.threshold_step) & (values != UNKNOWN)
        z = (BRICK_EDGE * coordinates[:, 2, None] + np.arange(BRICK_EDGE) + 0.5) * size  # (n, 8)
        if below is not None:
            occupied &= (z <= below)[:, :, None, None]
        heights = np.where(occupied, z[:, :, None, None], -np.inf).max(axis=1)  # (n, 8 y, 8 x)
        seen = (values != UNKNOWN).any(axis=1)
        for (bx, by, _), h, s in zip(coordinates, heights, seen):
            i, j = BRICK_EDGE * by - first[1], BRICK_EDGE * bx - first[0]
            block = (slice(i, i + BRICK_EDGE), slice(j, j + BRICK_EDGE))
            top[block] = np.maximum(top[block], h)
            known[block] |= s
    extent = (first[0] * size, last[0] * size, first[1] * size, last[1] * size)
    if known.any():
        ax.imshow(np.where(known, 0.88, np.nan), cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent)
        finite = np.isfinite(top)
        limits = Normalize(*np.percentile(top[finite], [1, 99])) if finite.any() else None
        image = ax.imshow(
            np.where(finite, top, np.nan), cmap="viridis", norm=limits, origin="lower", extent=extent,
            interpolation="nearest",
        )  # fmt: skip
        if ax.figure is not None:
            ax.figure.colorbar(image, ax=ax, label="height [m]", shrink=0.8)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    if title:
        ax.set_title(title)
    return ax
