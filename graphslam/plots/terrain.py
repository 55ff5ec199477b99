"""Plan of the terrain classes: traversable, not traversable and unknown."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, to_rgba
from matplotlib.patches import Rectangle

from graphslam.core.geometry import Array
from graphslam.maps.terrain.pyramid import HAZARDS, TerrainClass, TerrainMap
from graphslam.plots import style

COLOURS = {k: style.TERRAIN[k.name.lower()] for k in TerrainClass}
NAMES = {
    TerrainClass.UNKNOWN: "unknown",
    TerrainClass.FREE: "free",
    TerrainClass.ABOVE_REACH: "free, something above reach",
    TerrainClass.STEP: "curb, step",
    TerrainClass.STEEP: "steep",
    TerrainClass.OBSTACLE: "obstacle",
    TerrainClass.HOLE: "hole, drop",
}


def class_colours(classes: npt.NDArray[np.int8]) -> npt.NDArray[np.uint8]:
    """Colours ``(n, 4)`` of classes ``(n,)``; grey where nothing is known."""
    table = [to_rgba(COLOURS[k] if k is not TerrainClass.UNKNOWN else style.GREY) for k in TerrainClass]
    return np.asarray(np.round(255.0 * np.array(table))).astype(np.uint8)[classes]


def plot_terrain(
    found: TerrainMap, ax: Axes | None = None, *, path: Array | None = None, plain: bool = False, title: str = ""
) -> Axes:
    """Draw the classes of a terrain map.

    Parameters
    ----------
    path : (n, 2), optional
        Path of the vehicle, drawn over it [m].
    plain : bool
        Three colours only: green free, red a hazard, white unknown.
    """
    ax = style.new_axes(ax)
    classes = found.classes.astype(np.int64)
    colours = [COLOURS[k] for k in TerrainClass]
    if plain:
        classes = np.where(np.isin(classes, [int(k) for k in HAZARDS]), 2, np.minimum(classes, 1))
        colours = [COLOURS[TerrainClass.UNKNOWN], COLOURS[TerrainClass.FREE], COLOURS[TerrainClass.OBSTACLE]]
    ny, nx = classes.shape
    x0, y0 = (float(v) for v in found.origin)
    ax.imshow(
        classes,
        origin="lower",
        extent=(x0, x0 + nx * found.cell, y0, y0 + ny * found.cell),
        cmap=ListedColormap(colours),
        norm=BoundaryNorm(np.arange(len(colours) + 1) - 0.5, len(colours)),
        interpolation="nearest",
    )
    if path is not None:
        ax.plot(path[:, 0], path[:, 1], color=style.BLUE, lw=0.9, label="path")
    if plain:
        named = list(zip(colours, ("unknown", "free", "hazard"), strict=True))
    else:
        there = set(np.unique(classes).tolist())
        named = [(COLOURS[k], NAMES[k]) for k in TerrainClass if int(k) in there]
    for colour, label in named:
        ax.add_patch(Rectangle((x0, y0), 0.0, 0.0, facecolor=colour, edgecolor=style.GREY, label=label))
    style.legend(ax)
    style.metric_axes(ax)
    ax.set_title(title)
    return ax
