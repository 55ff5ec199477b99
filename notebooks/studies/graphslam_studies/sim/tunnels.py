"""Tunnels with rough walls: the surface of a union of galleries, cut out of rock.

The void is where a field is negative: the least, over straight galleries, of a distance-like function of one gallery,
roughened by noise that depends on the place alone. Its zero surface is meshed by surface nets (Gibson 1998): one vertex
for every cell that the surface passes, the mean of the points where it crosses the cell's edges. A level or sloping
plane stays exactly a plane, neighbouring facets share their vertices, and where galleries meet no wall is left between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.sim.world import Triangles

Field = npt.NDArray[np.float32]
# Value of the field in solid rock, far from any gallery: anything greater than a gallery's margin.
_ROCK = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Gallery:
    """A straight gallery.

    Parameters
    ----------
    start, end : (3,)
        Of the middle line of its floor [m].
    level : (float, float)
        Floor is level so far from either end [m]; it rises evenly between.
    half_width, height : float
        From the middle to a wall, from the floor to the roof [m].
    """

    start: Array
    end: Array
    level: tuple[float, float]
    half_width: float
    height: float

    @property
    def length(self) -> float:
        """In the plan [m]."""
        return float(np.hypot(*(self.end - self.start)[:2]))

    def along(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distance along the gallery, negative before its start, and from its middle line, in the plan [m].

        The ends are round: beyond them the distance is that from the end.
        """
        direction = (self.end - self.start)[:2] / self.length
        dx, dy = x - self.start[0], y - self.start[1]
        t = dx * direction[0] + dy * direction[1]
        inside = np.clip(t, 0.0, self.length)
        return t, np.hypot(dx - inside * direction[0], dy - inside * direction[1])

    def floor(self, t: Array) -> Array:
        """Height of the floor at distances ``(...)`` along the gallery [m].

        Without a level part at an end the slope goes on beyond it, so that two galleries that meet at a bend agree.
        """
        a, b = self.level
        share = (t - a) / (self.length - a - b)
        share = np.clip(share, 0.0 if a > 0 else None, 1.0 if b > 0 else None)
        return np.asarray(self.start[2] + share * (self.end[2] - self.start[2]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rock:
    """How the walls look.

    Parameters
    ----------
    cell : float
        Edge of the cells the surface is meshed with [m].
    roughness : float
        Greatest depth of the fine noise, either way [m].
    grain : float
        Its wavelength [m].
    waviness, wave : float
        The same of slow changes of width and height.
    """

    cell: float = 0.4
    roughness: float = 0.6
    grain: float = 1.5
    waviness: float = 0.5
    wave: float = 6.0


def lattice_noise(shape: tuple[int, int, int], cell: float, wavelength: float, rng: np.random.Generator) -> Field:
    """Noise in [-1, 1] at the nodes of a grid: random numbers ``wavelength`` apart, linear between them."""
    counts = [int(np.ceil(n * cell / wavelength)) + 2 for n in shape]
    values = rng.uniform(-1.0, 1.0, counts).astype(np.float32)
    for axis, n in enumerate(shape):
        at = (np.arange(n) * cell / wavelength).astype(np.float32)
        k = at.astype(np.intp)
        w = (at - k).reshape([-1 if a == axis else 1 for a in range(3)])
        values = np.take(values, k, axis) * (1 - w) + np.take(values, k + 1, axis) * w
    return values


def rock_field(galleries: list[Gallery], rock: Rock, rng: np.random.Generator) -> tuple[Field, Array]:
    """The field at the nodes of a grid, and the place ``(3,)`` of its first node [m]; negative in the void."""
    margin = 1.5
    ends = np.array([p for g in galleries for p in (g.start, g.end)])
    reach = max(max(g.half_width, g.height) for g in galleries) + margin
    low = ends.min(axis=0) - [reach, reach, margin]
    n = np.ceil((ends.max(axis=0) + reach - low) / rock.cell).astype(int) + 1
    shape = (int(n[0]), int(n[1]), int(n[2]))
    field = np.full(shape, _ROCK, np.float32)
    rough = rock.roughness * lattice_noise(shape, rock.cell, rock.grain, rng)
    rough += rock.waviness * lattice_noise(shape, rock.cell, rock.wave, rng)
    z = low[2] + rock.cell * np.arange(shape[2])
    for g in galleries:
        box = np.sort(np.array([g.start, g.end]), axis=0)
        first = np.floor((box[0] - g.half_width - margin - low) / rock.cell).astype(int).clip(0)
        last = np.ceil((box[1] + g.half_width + margin - low) / rock.cell).astype(int) + 1
        x = low[0] + rock.cell * np.arange(first[0], last[0])
        y = low[1] + rock.cell * np.arange(first[1], last[1])
        t, r = g.along(x[:, None], y[None, :])
        near = r < g.half_width + margin
        i, j = np.nonzero(near)
        h = z[None, :] - g.floor(t[near])[:, None]
        # upright walls up to one metre, then half an ellipse up to the roof
        arch = np.maximum(h - 1.0, 0.0) * (g.half_width / (g.height - 1.0))
        wall = (np.hypot(r[near][:, None], arch) - g.half_width).astype(np.float32)
        at = (i + first[0], j + first[1])
        wall += rough[at]
        # the floor is not roughened: the robot drives there
        void = np.maximum(wall, -h).astype(np.float32)
        field[at] = np.minimum(field[at], void)
    return field, low


def surface_nets(field: Field, low: Array, cell: float) -> tuple[Array, Triangles]:
    """Mesh of the zero surface of a field (Gibson 1998).

    Parameters
    ----------
    field : (a, b, c)
        At the nodes of a grid. Values of exactly 0 count as positive. The surface must not reach the grid's border,
        where it would be left open.
    low : (3,)
        Place of node (0, 0, 0) [m].
    cell : float
        Distance of the nodes [m].

    Returns
    -------
    vertices : (v, 3)
    triangles : (t, 3) int32
    """
    inside = field < 0.0
    total = np.zeros(tuple(n - 1 for n in field.shape), np.int8)
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    for c in corners:
        total += inside[_window(field.shape, c)]
    cells = np.argwhere((total > 0) & (total < 8))
    number = np.full(total.shape, -1, np.int32)
    number[tuple(cells.T)] = np.arange(len(cells), dtype=np.int32)
    # vertex: mean of the crossings on the cell's twelve edges
    crossing, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for axis in range(3):
        for c in corners:
            if c[axis]:
                continue
            a = cells + c
            b = a.copy()
            b[:, axis] += 1
            fa, fb = field[tuple(a.T)].astype(np.float64), field[tuple(b.T)].astype(np.float64)
            cut = (fa < 0) != (fb < 0)
            point = a.astype(np.float64)
            point[:, axis] += np.where(cut, fa / np.where(cut, fa - fb, 1.0), 0.0)
            crossing += np.where(cut[:, None], point, 0.0)
            count += cut
    vertices = low + cell * crossing / count[:, None]
    # facet: the four cells around every edge that the surface crosses
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        a = np.argwhere(
            np.take(inside, range(field.shape[axis] - 1), axis) != np.take(inside, range(1, field.shape[axis]), axis)
        )
        a = a[(a[:, u] > 0) & (a[:, v] > 0) & (a[:, u] < field.shape[u] - 1) & (a[:, v] < field.shape[v] - 1)]
        around = []
        for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
            b = a.copy()
            b[:, u] -= du
            b[:, v] -= dv
            around.append(number[tuple(b.T)])
        quads.append(np.column_stack(around))
    q = np.concatenate(quads)
    return vertices, np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]).astype(np.int32)


def _window(shape: tuple[int, ...], offset: tuple[int, ...]) -> tuple[slice, ...]:
    """Slices of all nodes that are corner ``offset`` of a cell."""
    return tuple(slice(o, n - 1 + o) for n, o in zip(shape, offset))
