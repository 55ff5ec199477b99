"""Correlative search: scores of a cloud at all poses of a lattice in a map; the distinct best are starts.

Drift at a loop closure can exceed the convergence range of an iterative matcher, and in repetitive places (pillars,
doors) the nearest optimum is often wrong. So all translations and headings within the drift are scored (Olson 2009,
"Real-time correlative scan matching"), and *several* modes are returned for an iterative matcher and its gates.

There is no pruning: for one heading the points are rounded to cells once; all translations then sum shifted rows of the
field, which takes a few tenths of a nanosecond per point and start.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError, GeometryError
from graphslam.core.geometry import Array, ArrayLike, wrap_angle
from graphslam.core.points import check_pose, evenly_spaced, finite_points, transform_points, voxel_downsample
from graphslam.registration.search_field import SearchField
from graphslam.registration.search_kernels import local_maxima, score_block

MOST_STARTS = 50_000_000
SLICE = 30_000_000
"""Points times starts of one slice of a search, some milliseconds."""
SLICE_MODES = 16
"""Modes that are refined in one slice."""

V = TypeVar("V")
P = ParamSpec("P")


def last_value(work: Generator[None, None, V]) -> V:
    """Do all of the work; returns its result."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            value: V = end.value
            return value


def at_once(work: Callable[P, Generator[None, None, V]]) -> Callable[P, V]:
    """The function that does all slices of ``work`` in one call."""

    @wraps(work)
    def whole(*args: P.args, **kwargs: P.kwargs) -> V:
        return last_value(work(*args, **kwargs))

    return whole


def timed_slices(work: Generator[None, None, V]) -> Generator[None, None, tuple[V, float]]:
    """Pass the slices on; returns the result and the wall time of the slices, without the time between them [s]."""
    seconds = 0.0
    while True:
        begin = time.perf_counter()
        try:
            next(work)
        except StopIteration as end:
            return end.value, seconds + time.perf_counter() - begin
        seconds += time.perf_counter() - begin
        yield


@dataclass(frozen=True, slots=True)
class SearchStart:
    """A start pose for an iterative matcher.

    Parameters
    ----------
    T : (3,) or (7,)
        ``T_target_source``.
    score : float
        Mean of the field at the points, 0 … 1.
    offset : tuple of float
        Offset from the centre of the search: x, y[, z] [m] in the target's axes, heading [rad].
    """

    T: Array
    score: float
    offset: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchConfig:
    """Configuration of a search.

    Parameters
    ----------
    most_points : int
        Most source points: one per cell of the field, evenly selected.
    apart : float
        Two starts nearer than this [m], with headings that differ by less than ``turned`` [rad], are one mode.
    refine : bool
        Refine each of ``4 keep`` modes at every cell and quarters of the heading step, and sort by the refined score:
        the distance of the lattice to the optimum differs between modes.
    """

    most_points: int = 300
    apart: float = 1.5
    turned: float = 0.35
    refine: bool = True
    coarse_points: int = 100
    """Most source points on a coarse field, see :func:`correlative_search`."""
    coarse_modes: int = 64
    """Modes of a coarse field that are refined in the finer one."""

    def __post_init__(self) -> None:
        check_options(self, "search: ", {"> 0": "*"})


@dataclass(frozen=True, slots=True)
class SearchLattice:
    """Offsets of the search, symmetric about zero; each ``(n,)``."""

    x: Array
    y: Array
    z: Array
    yaw: Array
    steps: tuple[int, int, int] = field(default=(1, 1, 1))
    """Cells of the field between neighbours along x, y, z."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Number of headings, z, y, x: the shape of the scores."""
        return len(self.yaw), len(self.z), len(self.y), len(self.x)

    def axes(self) -> list[tuple[int, bool]]:
        """For x, y, z: the step in cells, and whether there is more than one offset."""
        return [(s, len(a) > 1) for s, a in zip(self.steps, (self.x, self.y, self.z))]

    def places(self, index: npt.NDArray[np.int64]) -> Array:
        """Offsets ``(k, 4)`` x, y, z, heading of elements ``(k, 4)`` of the scores."""
        return np.stack([self.x[index[:, 3]], self.y[index[:, 2]], self.z[index[:, 1]], self.yaw[index[:, 0]]], 1)


def make_lattice(
    field: SearchField, half_widths: Sequence[float], steps: Sequence[float], reach: float
) -> SearchLattice:
    """The offsets within ``half_widths``; arguments as for :func:`correlative_search`, ``reach`` for a heading step of
    0 [m].
    """
    n = field.dim + 1
    names = ("x", "y", "z", "heading")[: n - 1] + ("heading",) if n == 4 else ("x", "y", "heading")
    half, step = np.array(half_widths, dtype=np.float64), np.array(steps, dtype=np.float64)
    if half.shape != (n,) or step.shape != (n,) or not np.all(np.isfinite(half) & np.isfinite(step) & (half >= 0)):
        raise ConfigError(f"search: half widths {half_widths}, steps {steps}; wanted {n} of each: {', '.join(names)}")
    cells = np.rint(step[:-1] / field.cell)
    if np.any(cells < 1) or np.any(np.abs(cells * field.cell - step[:-1]) > 1e-6):
        raise ConfigError(f"search: steps {step[:-1]} m are no multiples of the field's cell, {field.cell} m")
    if step[-1] < 0:
        raise ConfigError(f"search: a heading step of {step[-1]} rad; wanted a positive one, or 0 for the field's σ")
    if step[-1] == 0:
        step[-1] = float(np.clip(field.sigma / max(reach, 1e-9), 0.005, 0.2))
    counts = np.floor(half / step + 1e-9)
    counts[-1] = min(counts[-1], np.floor(np.pi / step[-1]))
    if not np.prod(2 * counts + 1) <= MOST_STARTS:
        raise ConfigError(f"search: {np.prod(2 * counts + 1):.3g} starts; wanted at most {MOST_STARTS}")
    axes = [np.arange(-c, c + 1) * s for c, s in zip(counts, step)]
    whole = [int(c) for c in cells] + [1]
    return SearchLattice(axes[0], axes[1], axes[2] if n == 4 else np.zeros(1), axes[-1], (whole[0], whole[1], whole[2]))


def _score_in_slices(
    points: Array, field: SearchField, around: Array, lattice: SearchLattice
) -> Generator[None, None, npt.NDArray[np.uint32]]:
    """Sum of the field, in 1/255, at all points for every offset of a lattice, in slices of some headings.

    Parameters
    ----------
    points : (n, dim)
        In the source frame, finite [m].
    around : (3,) or (7,)

    Returns
    -------
    (headings, z, y, x) uint32
    """
    phases = field._in_phases(lattice.steps)
    scores = np.zeros(lattice.shape, np.uint32)
    first = np.array([lattice.x[0], lattice.y[0], lattice.z[0]])
    counts, steps = np.array(lattice.shape[:0:-1]), np.array(lattice.steps)
    # cells are computed at the centre of the lattice, so that they do not depend on its width
    back = np.rint(first / field.cell).astype(np.int64)
    still = np.zeros_like(lattice.yaw)
    turned = offset_pose(around, np.stack([still, still, still, lattice.yaw], -1))
    cells = field._cells(transform_points(turned[:, None], points).reshape(-1, field.dim)) + back
    cells = cells.reshape(len(turned), -1, 3)
    size = max(1, int(SLICE // max(len(points) * counts.prod(), 1)))
    for k in range(0, len(turned), size):
        if k:
            yield
        score_block(cells[k : k + size], counts, steps, phases, scores[k : k + size])
    return scores


score_lattice = at_once(_score_in_slices)


def offset_pose(around: Array, offset: ArrayLike) -> Array:
    """The pose moved by x, y, z [m] along the target's axes and rotated about the vertical axis through itself [rad].

    Parameters
    ----------
    around : (3,) or (7,)
    offset : (..., 4)
        x, y, z, heading; z is ignored in 2-D.

    Returns
    -------
    (..., 3) or (..., 7)
    """
    move = np.asarray(offset, dtype=np.float64)
    if len(around) == 3:
        return np.concatenate([around[:2] + move[..., :2], wrap_angle(around[2] + move[..., 3:])], -1)
    half, none = 0.5 * move[..., 3], np.zeros(move.shape[:-1])
    turn = np.stack([none, none, np.sin(half), np.cos(half)], -1)
    turned = se3.quat_normalize(se3.quat_multiply(turn, around[3:]))
    return np.concatenate([around[:3] + move[..., :3], turned], -1)


def search_in_slices(
    source: Any,
    field: SearchField,
    around: Any,
    half_widths: Sequence[float],
    steps: Sequence[float] | None = None,
    keep: int = 6,
    *,
    coarse: SearchField | None = None,
    config: SearchConfig | None = None,
) -> Generator[None, None, list[SearchStart]]:
    """Distinct candidate poses of the source in the map, best first.

    In slices of bounded work; :data:`correlative_search` does them in one call.

    Parameters
    ----------
    source : (m, dim)
        Points in the source frame [m]; non-finite points are ignored.
    field : SearchField
        Of the map.
    around : (3,) or (7,)
        ``T_target_source`` at the centre of the search. Its roll and pitch are kept.
    half_widths : (x, y, z, heading), in two dimensions (x, y, heading)
        Of the search [m, rad].
    steps : as ``half_widths``, optional
        Of the lattice. Those of x, y, z are multiples of the field's cell; a heading step of 0 is chosen so that
        distant points move by σ of the field. Default: two cells, and 0.
    keep : int
        Most modes to return.
    coarse : SearchField, optional
        Of the same map, with larger cells and σ for the steps of the lattice: few points are scored on it, and only the
        best modes in ``field``. The search can then be about ten times wider in the same time.

    Returns
    -------
    list of SearchStart
        Local maxima of the lattice that are not near a better one. Empty without points, or without overlap with the
        map.
    """
    config = SearchConfig() if config is None else config
    T = check_pose(around, field.dim, what="pose to search around")
    p = finite_points(source, what="source points")
    if p.shape[1] != field.dim:
        raise GeometryError("source and field differ in dimension", got=p.shape[1], wanted=field.dim)
    if keep < 1:
        raise ConfigError(f"search: {keep} modes wanted; wanted at least 1")
    p = evenly_spaced(voxel_downsample(p, field.cell), config.most_points)
    step = (*[2.0 * (coarse or field).cell] * field.dim, 0.0) if steps is None else steps
    reach = float(np.quantile(np.hypot(p[:, 0], p[:, 1]), 0.9)) if len(p) else 1.0
    lattice = make_lattice(field, half_widths, step, reach)
    if not len(p):
        return []
    if coarse is None:
        few, seen, modes = p, lattice, 4 * keep
        sums = yield from _score_in_slices(p, field, T, lattice)
    else:
        few, modes = evenly_spaced(p, config.coarse_points), max(config.coarse_modes, keep)
        seen = make_lattice(coarse, half_widths, step, reach)
        sums = yield from _score_in_slices(few, coarse, T, seen)
    yield
    scores = _shares(sums, len(few))
    scores[sums == 0] = -np.inf
    top = local_maxima(scores)
    places, score = seen.places(top), scores[tuple(top.T)]
    if config.refine or coarse is not None:
        places = places[_distinct(places, score, modes, config)]
        places, score = yield from _refine(p, field, T, lattice, places)
    starts = []
    for s in _distinct(places, score, keep, config):
        x, y, z, yaw = (float(v) for v in places[s])
        shown = (x, y, z, yaw) if field.dim == 3 else (x, y, yaw)
        starts.append(SearchStart(offset_pose(T, places[s]), float(score[s]), shown))
    return starts


correlative_search = at_once(search_in_slices)


def _shares(sums: npt.NDArray[np.uint32], points: int) -> npt.NDArray[np.float32]:
    return sums.astype(np.float32) / np.float32(255.0 * points)


def _refine(
    points: Array, field: SearchField, around: Array, lattice: SearchLattice, places: Array
) -> Generator[None, None, tuple[Array, Array]]:
    """Best offsets within half a step of each of ``places (k, 4)``, with scores."""
    turn = lattice.yaw[1] - lattice.yaw[0] if len(lattice.yaw) > 1 else 0.0
    half: list[Array] = [
        field.cell * np.arange(-(c // 2), c // 2 + 1.0) if wide else np.zeros(1) for c, wide in lattice.axes()
    ]
    near = SearchLattice(half[0], half[1], half[2], np.arange(-2, 3) * 0.25 * turn if turn else np.zeros(1))
    found, score = places.copy(), np.empty(len(places))
    for k, at in enumerate(places):
        if k % SLICE_MODES == 0:
            yield
        scores = _shares(score_lattice(points, field, offset_pose(around, at), near), len(points))
        best = np.unravel_index(int(np.argmax(scores)), scores.shape)
        found[k], score[k] = at + near.places(np.array([best]))[0], scores[best]
    return found, score


def _distinct(places: Array, scores: Array, keep: int, config: SearchConfig) -> list[int]:
    """Indices of the best of ``places (k, 4)``, best first, leaving out those near a better one."""
    left = np.argsort(-scores, kind="stable")
    chosen: list[int] = []
    while len(left) and len(chosen) < keep:
        chosen.append(int(left[0]))
        d = places[left] - places[left[0]]
        near = np.sum(d[:, :3] ** 2, axis=1) < config.apart**2
        left = left[~(near & (np.abs(wrap_angle(d[:, 3])) < config.turned))]
    return chosen
