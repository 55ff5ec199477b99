"""Figure of the memory that copies of evidence grids share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.core.errors import GridError
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.layout import BRICK_EDGE
from graphslam.plots import style


def plot_sharing(
    grid: EvidenceGrid, others: Sequence[EvidenceGrid], ax: Axes | None = None, *, title: str | None = None
) -> Axes:
    """Draw the bricks of a grid from above: how many of each column are its own, and where all are others' too (grey).

    Parameters
    ----------
    others : sequence of EvidenceGrid
        Of the same pool.
    """
    ax = style.new_axes(ax)
    at, shared = grid.brick_coordinates(), shared_bricks(grid, others)
    edge = BRICK_EDGE * grid.voxel_size
    if len(at):
        low = at[:, :2].min(axis=0)
        shape = at[:, :2].max(axis=0) - low + 1
        own, all_ = np.zeros(shape[::-1]), np.zeros(shape[::-1])
        column = tuple((at[:, :2] - low).T[::-1])
        np.add.at(all_, column, 1)
        np.add.at(own, column, ~shared)
        extent = (low[0] * edge, (low[0] + shape[0]) * edge, low[1] * edge, (low[1] + shape[1]) * edge)
        ax.imshow(np.where(all_ > 0, 0.88, np.nan), cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent)
        image = ax.imshow(
            np.where(own > 0, own, np.nan), cmap="viridis", vmin=0, vmax=max(own.max(), 1), origin="lower",
            extent=extent, interpolation="nearest",
        )  # fmt: skip
        if ax.figure is not None:
            ax.figure.colorbar(image, ax=ax, label="bricks of its own", shrink=0.8)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set_title(title or f"{int((~shared).sum())} of {len(at)} bricks its own")
    return ax


def shared_bricks(grid: GridTree, others: Sequence[GridTree]) -> npt.NDArray[np.bool_]:
    """Which bricks of a grid are bricks of others too, not merely equal ``(n,)``; ordered as its `brick_coordinates`.

    Parameters
    ----------
    others : sequence of EvidenceGrid
        Of the same pool.
    """
    if any(g.pool is not grid.pool for g in others):
        raise GridError("grids of different pools share nothing", wanted="one pool")
    with grid.pool.lock:
        mine = grid.packed_bricks()[:, 1]
        theirs = [g.packed_bricks()[:, 1] for g in others if g is not grid]
    return np.isin(mine, np.concatenate(theirs)) if theirs else np.zeros(len(mine), np.bool_)
