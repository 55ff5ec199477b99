"""Shaded oblique view of a surface, coloured by a value."""

from __future__ import annotations

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgba

from graphslam.core.geometry import Array
from graphslam.plots import style

WIDTH = 1400
"""Maximum width of the picture [pixels]; it is smaller if pixels would be smaller than the typical triangle."""
_LIGHT = np.array([0.35, -0.5, 0.79])
_EDGE = 0.6
"""Cosine between neighbouring normals below which an edge is drawn dark."""


def vertex_colours(values: Array, palette: str = "viridis") -> npt.NDArray[np.uint8]:
    """Colours ``(v, 4)`` of values, from their 2nd to their 98th percentile; grey where they are not finite."""
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, [0.02, 0.98]) if len(known) else (0.0, 1.0)
    share = np.clip((np.nan_to_num(values) - low) / max(float(high - low), 1e-12), 0.0, 1.0)
    out = np.asarray(255.0 * np.asarray(matplotlib.colormaps[palette](share))).astype(np.uint8)
    out[~np.isfinite(values)] = (128, 128, 128, 255)
    return out


def session_colours(session: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Colours ``(v, 4)`` of sessions, the same as of their paths; grey where there is none (−1)."""
    cycle = np.array([to_rgba(c) for c in style.CYCLE])
    out = np.asarray(255.0 * cycle[session % len(cycle)]).astype(np.uint8)
    out[session < 0] = (128, 128, 128, 255)
    return out


def plot_surface(
    vertices: Array,
    triangles: npt.NDArray[np.int64],
    values: Array,
    ax: Axes | None = None,
    *,
    label: str = "",
    title: str = "",
    slant: float = 40.0,
    edges: bool = False,
) -> Axes:
    """Draw triangles in parallel projection from the south with hidden surfaces removed; back faces are left out.

    The surface and, with `edges`, its edges alone correspond to the two parts of Fig. 5 of urban mapping.

    Parameters
    ----------
    vertices : (v, 3)
    triangles : (t, 3)
        Counter-clockwise as seen from the free side.
    values : (v,)
        Shown by colour; grey where they are not finite.
    slant : float
        Angle of the view from the vertical [deg]: 0 is from above.
    edges : bool
        Draw only creases and boundaries of the surface, on white, without the values.
    """
    ax = style.new_axes(ax)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(size, 1e-12)[:, None]
    s, k = np.sin(np.deg2rad(slant)), np.cos(np.deg2rad(slant))
    right, up, towards = np.array([1.0, 0, 0]), np.array([0.0, k, s]), np.array([0.0, -s, k])
    middle = (a + b + c) / 3.0
    front = (normal @ towards > 0.0) & (size > 0.0)
    u, v, depth = middle[front] @ right, middle[front] @ up, middle[front] @ towards
    span = max(float(np.ptp(u)), float(np.ptp(v)), 1e-6)
    pixel = max(span / WIDTH, 1.2 * float(np.median(np.sqrt(size))))
    ix, iy = ((x - x.min()) // pixel for x in (u, v))
    ix, iy = ix.astype(np.int64), iy.astype(np.int64)
    order = np.lexsort((-depth, ix, iy))
    first = np.concatenate([[True], (np.diff(ix[order]) != 0) | (np.diff(iy[order]) != 0)])
    top = order[first]
    value = values[triangles[front]].mean(axis=1)
    known = value[np.isfinite(value)]
    low, high = np.quantile(known, [0.02, 0.98]) if len(known) else (0.0, 1.0)
    norm = Normalize(float(low), float(max(high, low + 1e-9)))
    palette = matplotlib.colormaps["viridis"]
    colour = np.where(np.isfinite(value[top])[:, None], palette(norm(np.nan_to_num(value[top])))[:, :3], 0.6)
    shade = 0.45 + 0.55 * np.clip(normal[front][top] @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    picture = np.ones((int(iy.max()) + 1, int(ix.max()) + 1, 3))
    facing = np.zeros(picture.shape)
    picture[iy[top], ix[top]] = colour * shade[:, None]
    facing[iy[top], ix[top]] = normal[front][top]
    there = np.any(facing != 0, axis=2)
    folds = np.zeros(there.shape, bool)
    for axis in (0, 1):
        turned = np.sum(facing * np.roll(facing, 1, axis=axis), axis=2)
        both = there & np.roll(there, 1, axis=axis)
        picture[both & (turned < _EDGE)] *= 0.55
        folds |= (both & (turned < _EDGE)) | (there != np.roll(there, 1, axis=axis))
    if edges:
        picture = np.where(folds[..., None], 0.0, 1.0) * np.ones(3)
    extent = (float(u.min()), float(u.min() + pixel * picture.shape[1]), 0.0, float(pixel * picture.shape[0]))
    ax.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
    if not edges:
        ax.figure.colorbar(matplotlib.cm.ScalarMappable(norm, palette), ax=ax, label=label, shrink=0.7)
    ax.set_xlabel("x [m]")
    ax.grid(False)
    ax.set_yticks([])
    ax.set_title(title)
    return ax
