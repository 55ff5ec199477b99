"""Worlds of triangles and clouds of points seen from a corner of the sky, in parallel projection, to scale."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.plots import style
from graphslam.sim.raycast import RayCaster
from graphslam.sim.world import World

_LIGHT = np.array([0.35, -0.45, 0.82])  # a little aslant, so that neighbouring sides of a box differ


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewDirection:
    """Where one looks from.

    Parameters
    ----------
    azimuth : float
        Of the viewer, from the x axis towards y [rad].
    elevation : float
        Of the viewer above the plane, above 0 and at most π/2 [rad].
    """

    azimuth: float = float(np.radians(-62.0))
    elevation: float = float(np.radians(48.0))

    def __post_init__(self) -> None:
        if not (np.isfinite(self.azimuth) and 0.0 < self.elevation <= np.pi / 2):
            raise ConfigError(
                f"view: elevation = {self.elevation}, azimuth = {self.azimuth}; wanted 0 < elevation ≤ π/2"
            )

    @property
    def axes(self) -> Array:
        """Rows: to the right on the picture, up on it, towards the viewer ``(3, 3)``."""
        ca, sa, ce, se = np.cos(self.azimuth), np.sin(self.azimuth), np.cos(self.elevation), np.sin(self.elevation)
        return np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])

    def project(self, points: npt.ArrayLike) -> Array:
        """Points ``(n, 3)`` on the picture ``(n, 2)`` [m]."""
        return np.asarray(np.asarray(points, dtype=np.float64) @ self.axes[:2].T)


def plot_solid(
    world: World,
    ax: Axes | None = None,
    *,
    below: float,
    view: ViewDirection | None = None,
    margin: float = 6.0,
    pixels: int = 900,
    route: bool = True,
    title: str | None = None,
) -> Axes:
    """A world with everything above a height taken off, shaded, and the way on it, dotted where something hides it.

    Parameters
    ----------
    below : float
        The cut [m]; parts of the way above it are left out.
    margin : float
        What is shown beside the way [m].
    pixels : int
        Width of the picture.
    route : bool
        Draw it.

    Raises
    ------
    DataError
        Nothing of the world is below the cut.
    """
    view = ViewDirection() if view is None else view
    ax = style.new_axes(ax, (8.0, 5.0))
    p = world.route().positions(world.route().every(0.25))
    floor = max(float(world.vertices[:, 2].min()), float(p[:, 2].min()) - 1.0)
    if below <= floor:
        raise DataError(f"world {world.name} has nothing below the cut", got=below, wanted=f"> {floor:.2f} m")
    box = np.array([[x, y, z] for x in _ends(p[:, 0], margin) for y in _ends(p[:, 1], margin) for z in (floor, below)])
    (left, low), (right, high) = view.project(box).min(axis=0), view.project(box).max(axis=0)
    step = (right - left) / pixels
    u, v = np.arange(left + step / 2, right, step), np.arange(low + step / 2, high, step)
    caster = RayCaster.of(world)
    image = _shaded(caster, view, u, v, below, _ends(p[:, :2].T, margin))
    ax.imshow(image, origin="lower", extent=(u[0], u[-1], v[0], v[-1]), interpolation="bilinear", zorder=0)
    if route:
        on, xy = p[:, 2] < below, view.project(p)
        seen = on & _visible(caster, view, p + (0.0, 0.0, 0.2), below)
        for rows, ls, lw in ((on & ~seen, ":", 0.9), (seen, "-", 1.4)):
            line = np.where(rows[:, None], xy, np.nan)
            ax.plot(line[:, 0], line[:, 1], ls, color=style.VERMILION, lw=lw, zorder=3)
        ends = ((0, "^", style.GREEN, "start"), (-1, "s", style.YELLOW, "end"))
        for at, marker, colour, label in ends:
            if on[at]:
                ax.plot(*xy[at], marker, color=colour, ms=7, mec=style.BLACK, label=label, lw=0, zorder=4)
        style.legend(ax, outside=False, loc="lower left")
    _bare(ax, title)
    return ax


def plot_cloud(
    points: npt.ArrayLike,
    ax: Axes | None = None,
    *,
    view: ViewDirection | None = None,
    size: float = 1.5,
    path: npt.ArrayLike | None = None,
    colours: npt.ArrayLike | None = None,
    title: str | None = None,
) -> Axes:
    """Points, coloured by height; upon :func:`plot_solid` of the same view they lie where they were hit.

    With a path: the cloud it makes, as of raw and of calibrated dead reckoning (SegSLAM Fig. 15). With colours of their
    terrain: what a scan means to a vehicle (urban mapping Fig. 2).

    Parameters
    ----------
    points : (n, 3)
        [m]
    size : float
        Of a point.
    path : (m, 3), optional
        Drawn over the points, whatever hides it [m].
    colours : (n, 4), optional
        Of the points, 0 to 1, instead of those of their heights.

    Raises
    ------
    DataError
        No points, or not finite ones; colours of another number.
    """
    p = np.asarray(points, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or not len(p) or not np.all(np.isfinite(p)):
        raise DataError("no cloud to draw", got=p.shape, wanted="(n ≥ 1, 3), finite")
    own = None if colours is None else np.asarray(colours, dtype=np.float64)
    if own is not None and own.shape != (len(p), 4):
        raise DataError("colours do not belong to the points", got=own.shape, wanted=f"({len(p)}, 4)")
    view = ViewDirection() if view is None else view
    ax = style.new_axes(ax, (8.0, 5.0))
    order = np.argsort(p @ view.axes[2])  # the nearest last, on top
    xy = view.project(p[order])
    if own is not None:
        ax.scatter(xy[:, 0], xy[:, 1], c=own[order], s=size, lw=0, zorder=5)
    else:
        dots = ax.scatter(xy[:, 0], xy[:, 1], c=p[order, 2], s=size, cmap="viridis", lw=0, zorder=5)
        if ax.figure is not None:
            ax.figure.colorbar(dots, ax=ax, label="height [m]", shrink=0.7, pad=0.01)
    if path is not None:
        line = view.project(np.asarray(path, dtype=np.float64))
        ax.plot(line[:, 0], line[:, 1], color=style.VERMILION, lw=1.2, label="path", zorder=6)
        style.legend(ax, outside=False, loc="best")
    _bare(ax, title)
    return ax


def _ends(x: Array, margin: float) -> tuple[Array, Array]:
    return x.min(axis=-1) - margin, x.max(axis=-1) + margin


def _visible(caster: RayCaster, view: ViewDirection, points: Array, below: float) -> npt.NDArray[np.bool_]:
    """Is there nothing between points ``(n, 3)`` and the cut, towards the viewer?"""
    back = view.axes[2]
    ranges = caster.ranges(np.concatenate([points, np.broadcast_to(back, points.shape)], axis=-1))
    return np.asarray(~(ranges < (below - points[:, 2]) / back[2]))


def _shaded(
    caster: RayCaster, view: ViewDirection, u: Array, v: Array, below: float, sides: tuple[Array, Array]
) -> Array:
    """Colours ``(rows, columns, 4)`` of what rays meet that begin at the cut: grey by slope, blue-green by height."""
    right, up, back = view.axes
    grid = u[None, :, None] * right + v[:, None, None] * up
    # along the line of sight to the height of the cut
    origins = grid + ((below - grid[..., 2]) / back[2])[..., None] * back
    rays = np.concatenate([origins, np.broadcast_to(-back, origins.shape)], axis=-1).reshape(-1, 6)
    hits = origins - caster.ranges(rays).reshape(origins.shape[:2])[..., None] * back
    normals = np.cross(np.gradient(hits, axis=1), np.gradient(hits, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    bright = 0.55 + 0.45 * np.clip(np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT))), 0.0, 1.0)
    z = hits[..., 2]
    inside = np.all((hits[..., :2] >= sides[0]) & (hits[..., :2] <= sides[1]), axis=-1) & np.isfinite(z)
    low = float(np.min(z[inside], initial=below))
    image = matplotlib.colormaps["Blues"](0.10 + 0.55 * np.clip((z - low) / max(below - low, 1e-9), 0.0, 1.0))
    image[..., :3] *= np.nan_to_num(bright, nan=0.6)[..., None]
    image[~inside] = (1.0, 1.0, 1.0, 0.0)
    return np.asarray(image)


def _bare(ax: Axes, title: str | None) -> None:
    """Equal scales, and no axes: coordinates of the picture mean nothing."""
    ax.set_aspect("equal", adjustable="box")
    ax.grid(False)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)
    if title:
        ax.set_title(title, fontsize="medium")
