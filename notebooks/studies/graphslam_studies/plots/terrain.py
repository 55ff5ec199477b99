"""Figure of terrain maps by distance band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Rectangle

from graphslam.core.errors import DataError
from graphslam.maps.terrain.pyramid import TerrainMap
from graphslam.plots import style


def plot_bands(
    found: TerrainMap,
    cells: Sequence[float],
    ax: Axes | None = None,
    *,
    place: npt.ArrayLike | None = None,
    title: str = "",
) -> Axes:
    """Which band of the pyramid speaks of each place: fine cells near the vehicle, coarse ones far off (urban mapping
    Fig. 6).

    Parameters
    ----------
    cells : sequence of float
        Widths of the cells of the bands [m], the finest first.
    place : (2,), optional
        Of the vehicle [m].

    Raises
    ------
    DataError
        The map speaks of more bands than there are widths.
    """
    if int(found.band.max(initial=-1)) >= len(cells):
        raise DataError("bands without a width", got=len(cells), wanted=f"{int(found.band.max()) + 1}")
    ax = style.new_axes(ax)
    ax.grid(False)
    ny, nx = found.band.shape
    x0, y0 = (float(v) for v in found.origin)
    extent = (x0, x0 + nx * found.cell, y0, y0 + ny * found.cell)
    colours = [colormaps["viridis"](v) for v in np.linspace(0.95, 0.15, len(cells))]
    shown = np.ma.masked_less(found.band, 0)
    norm = BoundaryNorm(np.arange(len(cells) + 1) - 0.5, len(cells))
    ax.imshow(shown, origin="lower", extent=extent, cmap=ListedColormap(colours), norm=norm, interpolation="nearest")
    for k, (colour, width) in enumerate(zip(colours, cells, strict=True)):
        share = float(np.mean(found.band == k))
        ax.add_patch(Rectangle((x0, y0), 0.0, 0.0, facecolor=colour, label=f"cells of {width:g} m ({share:.0%})"))
    if place is not None:
        ax.plot(*np.asarray(place, dtype=np.float64)[:2], "^", color=style.VERMILION, mec="white", ms=9,
                label="vehicle", lw=0)  # fmt: skip
    style.legend(ax)
    style.metric_axes(ax)
    ax.set_title(title)
    return ax
