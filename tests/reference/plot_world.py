"""Floor plans of simulated worlds, with the way driven on them."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from scipy.spatial import cKDTree

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.plots import style
from graphslam.sim.world import World
from tests.reference.mesh_section import mesh_section


def plot_world(
    world: World,
    ax: Axes | None = None,
    *,
    level: int | None = None,
    heights: tuple[float, ...] = (0.5, 1.2),
    band: tuple[float, float] = (-1.2, 1.8),
    arrow_every: float = 20.0,
    title: str | None = None,
) -> Axes:
    """Draw sections through a level, and the way: dark where it runs on that level, pale elsewhere.

    Parameters
    ----------
    world : World
    ax : Axes or None
    level : int, optional
        Of ``world.meta["levels"]``; None follows the floor: sections at ``heights`` above every floor height the way
        has, each drawn only near the way (for tunnels that rise and fall).
    heights : tuple of float
        Of the sections above the level's floor [m].
    band : (low, high)
        Parts of the way this far below and above the level's floor count as on it [m].
    arrow_every : float
        Driven distance between two arrows [m].
    """
    levels = [float(z) for z in world.meta.get("levels", [])]
    if level is not None and not 0 <= level < len(levels):
        raise ConfigError(f"world {world.name}: no level {level}; wanted 0 … {len(levels) - 1}")
    ax = style.new_axes(ax, (9.0, 6.0))
    route = world.route()
    s = route.every(0.25)
    p = route.positions(s)
    if level is None:
        lines, here = _following_sections(world, p, heights), np.ones(len(s), bool)
    else:
        floor = levels[level]
        lines = [mesh_section(world.vertices, world.triangles, floor + h) for h in heights]
        here = (p[:, 2] > floor + band[0]) & (p[:, 2] < floor + band[1])
    greys = np.linspace(0.25, 0.6, len(heights))
    for height, segments, g in zip(heights, lines, greys):
        label = f"walls {height:g} m above the floor"
        ax.add_collection(LineCollection(list(segments), colors=[(g, g, g)], linewidths=0.7, label=label, zorder=2))
    ax.plot(p[:, 0], p[:, 1], color=style.PALE, lw=1.0, label="way, other levels", zorder=1) if not here.all() else None
    ax.plot(
        np.where(here, p[:, 0], np.nan),
        np.where(here, p[:, 1], np.nan),
        color=style.BLUE,
        lw=1.4,
        label="way",
        zorder=3,
    )
    arrows = np.arange(arrow_every / 2, route.length, arrow_every)
    arrows = arrows[here[np.searchsorted(s, arrows)]]
    q, h = route.positions(arrows), route.headings(arrows)
    ax.quiver(q[:, 0], q[:, 1], np.cos(h), np.sin(h), color=style.BLUE, units="dots", width=2.0, scale=0.06, zorder=4)
    ends = [(p[0], here[0], "^", "start", style.GREEN), (p[-1], here[-1], "s", "end", style.VERMILION)]
    for point, on, marker, label, colour in ends:
        if on:
            ax.plot(point[0], point[1], marker, color=colour, ms=7, mec=style.BLACK, label=label, zorder=5)
    style.metric_axes(ax)
    ax.autoscale_view()
    where = "" if level is None else f", level {level}: floor at {levels[level]:.1f} m"
    ax.set_title(title if title is not None else f"{world.name}{where}; {route.length:.0f} m driven", fontsize="medium")
    style.legend(ax)
    return ax


def _following_sections(world: World, path: Array, heights: tuple[float, ...], reach: float = 9.0) -> list[Array]:
    """Sections at many floor heights, each kept only where the nearest point of the way has that height."""
    step = 0.5
    bins = np.round(path[:, 2] / step).astype(int)
    tree = cKDTree(path[:, :2])
    found: list[list[Array]] = [[np.zeros((0, 2, 2))] for _ in heights]
    for b in np.unique(bins):
        for lines, height in zip(found, heights):
            segments = mesh_section(world.vertices, world.triangles, step * b + height)
            distance, nearest = tree.query(segments.mean(axis=1))
            lines.append(segments[(distance < reach) & (bins[nearest] == b)])
    return [np.concatenate(lines) for lines in found]
