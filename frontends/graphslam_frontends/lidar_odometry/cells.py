"""A point map in several levels of Gaussian cells, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam_frontends.lidar_odometry import cell_kernels as kernels

PARTS = 512
"""Number of hash bins for gradients by parts of space."""
_FIRST_ROOM = 1 << 12


@dataclass(frozen=True, slots=True)
class LevelConfig:
    """One level of the map.

    Parameters
    ----------
    size : float
        Edge of a cell [m].
    least : float
        σ added to that of a cell [m]: a quarter of the cell on coarse levels; with less, the weights are 0 at the
        initial guess.
    planes : bool
        Only the component normal to a surface constrains a point. Otherwise the full covariance of thick cells does,
        too. A surface constrains along its normal only, and collinear points only as a part of a wider surface.
    """

    size: float
    least: float
    planes: bool


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of a match at a pose.

    Parameters
    ----------
    H, g : (6, 6), (6,)
        Right tangent, rotation first.
    every : (6, 6)
        Information of the same points if each constrained every direction.
    overlap : float
        Sum of the weights over the number of points.
    known : float
        Share of the points with an informative cell near them.
    quality : float
        Mean weight of these points: the quality of the fit where the map has cells.
    misfit : float
        Weighted mean of the squared Mahalanobis distance.
    """

    H: Array
    g: Array
    every: Array
    overlap: float
    known: float
    quality: float
    misfit: float


class CellMap:
    """One level of Gaussian cells (see `cell_kernels`)."""

    def __init__(self, config: LevelConfig) -> None:
        self.config = config
        self.cells = _empty(_FIRST_ROOM, 1 if config.planes else 3)

    def __len__(self) -> int:
        return int(np.count_nonzero(self.cells.updated[: self.cells.used[0]]))

    @property
    def centres(self) -> Array:
        """Centres of the cells that are in use ``(n, 3)``, world [m]."""
        used = int(self.cells.used[0])
        return np.asarray(self.cells.centre[:used][self.cells.updated[:used] > 0])

    def add(self, points: Array, scan: int, wide: CellMap | None = None) -> None:
        """Add points ``(n, 3)``, world frame, to their cells; ``scan`` is an increasing number.

        ``wide`` is a level of wider cells that already contains them; collinear points get the normals of its surfaces.
        """
        # every point may create a block, and a match as many again
        self.room(2 * len(points))
        c = self.config
        around = (self.cells, 0.0) if wide is None else (wide.cells, wide.config.size)
        kernels.add_points(self.cells, points, scan, (c.size, c.least, c.planes), around)

    def room(self, more: int) -> None:
        """Allocate space for more blocks."""
        c = self.cells
        if int(c.used[0]) + more > len(c.cube):
            self._copy(-1, more)

    def keep_since(self, scan: int) -> None:
        """Delete the cells without points since a scan."""
        self._copy(scan, 0)

    def _copy(self, scan: int, more: int) -> None:
        c = self.cells
        kept = np.flatnonzero((c.seen[: c.used[0]] >= scan) & (c.number[: c.used[0]] > 0))
        out, n = _empty(2 * (len(kept) + more), c.root.shape[1]), len(kept)
        for name in ("cube", "number", "mean", "scatter", "updated", "centre", "root", "seen", "made"):
            getattr(out, name)[:n] = getattr(c, name)[kept]
        kernels.enter_keys(out.keys, out.slots, out.cube[:n])
        out.used[0] = n
        self.cells = out

    def nearest(self, points: Array) -> npt.NDArray[np.int64]:
        """The cell of each point ``(n, 3)``, as an index; negative: none."""
        self.room(len(points))
        out = np.empty(len(points), np.int64)
        kernels.nearest_cells(self.cells, points, self.config.size, out)
        return out

    def scores(self, points: Array, R: Array, t: Array) -> Array:
        """Scores, 0 to 1, of points ``(n, 3)`` at rotations ``(m, 3, 3)`` about a position ``t``."""
        out, sigma = np.zeros(len(R)), 0.4 * self.config.size
        for k in range(0, len(points), 8):
            self.room(8 * len(R))
            kernels.score_rotations(self.cells, points[k : k + 8], R, t, self.config.size, sigma, out)
        return out / max(len(points), 1)

    def fit(self, points: Array, R: Array, t: Array, scale: float) -> NormalEquations:
        """Normal equations of points ``(n, 3)``, body frame, at a pose."""
        return self.descend(points, R.copy(), t.copy(), scale, np.eye(6), (np.inf, np.inf), 1)

    def descend(
        self, points: Array, R: Array, t: Array, scale: float, prior: Array, still: tuple[float, float], most: int
    ) -> NormalEquations:
        """At most ``most`` Gauss–Newton steps; the pose is updated in place (see `cell_kernels.descend_pose`)."""
        out = np.empty((6, 6)), np.empty(6), np.empty(13)
        start, size, done = (R.copy(), t.copy(), prior), self.config.size, -1
        while done < 0:
            self.room(2 * len(points))
            most += done + 1
            done = kernels.descend_pose(self.cells, points, (R, t), start, size, scale, (*still, most), out)
        return _fit(len(points), *out)

    def known(self, points: Array) -> npt.NDArray[np.bool_]:
        """Which points ``(n, 3)``, world frame, have an informative cell near them."""
        at = self.nearest(points)
        return np.asarray((at >= 0) & (np.abs(self.cells.root[at]).max(axis=(1, 2)) > 0.0))

    def by_slot(self, points: Array, R: Array, t: Array, scale: float, ends: Array) -> tuple[Array, Array, Array]:
        """See `cell_kernels.information_by_slot`: ``(s, 6, 6)``, ``(6, 6)`` and ``(c, 6)``.

        A cell belongs to the first slot whose end is not before the mean number of its scans.
        """
        at = self.nearest(points @ R.T + t)
        slot = np.minimum(np.searchsorted(ends, self.cells.made[at]), len(ends) - 1)
        cells = at, np.argsort(at, kind="stable"), slot
        H, M, G = np.empty((len(ends), 6, 6)), np.empty((6, 6)), np.empty((PARTS, 6))
        kernels.information_by_slot(self.cells, points, (R, t), scale, cells, (H, M, G))
        return H, M, G


def _fit(n: int, H: Array, g: Array, sums: Array) -> NormalEquations:
    near = max(sums[1], 1.0)
    return NormalEquations(
        H, g, _every(sums[3:]), sums[0] / max(n, 1), sums[1] / max(n, 1), sums[0] / near, sums[2] / max(sums[0], 1e-12)
    )


def _every(m: Array) -> Array:
    second = np.array([[m[4], m[5], m[6]], [m[5], m[7], m[8]], [m[6], m[8], m[9]]])
    out = np.zeros((6, 6))
    out[:3, :3] = np.trace(second) * np.eye(3) - second
    a, b, c = m[1:4]
    out[:3, 3:] = [[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]
    out[3:, :3] = out[:3, 3:].T
    out[3:, 3:] = m[0] * np.eye(3)
    return out


def _empty(blocks: int, rows: int) -> kernels.Cells:
    blocks = max(blocks, _FIRST_ROOM)
    if blocks > 1 << 26:
        raise DataError("the map of a lidar is too large", got=f"{blocks} cells", wanted=f"at most {1 << 26}")
    table = 1 << int(np.ceil(np.log2(2 * blocks)))
    return kernels.Cells(
        keys=np.full(table, -1, np.int64),
        slots=np.zeros(table, np.int32),
        cube=np.zeros(blocks, np.int64),
        number=np.zeros(blocks, np.int32),
        mean=np.zeros((blocks, 3)),
        scatter=np.zeros((blocks, 6)),
        updated=np.zeros(blocks, np.int32),
        centre=np.zeros((blocks, 3)),
        root=np.zeros((blocks, rows, 3)),
        seen=np.full(blocks, -1, np.int64),
        made=np.zeros(blocks),
        around=np.zeros((blocks, 27), np.int32),
        n_around=np.full(blocks, -1, np.int32),
        near=np.full((blocks, 64), kernels.UNKNOWN, np.int8),
        used=np.zeros(1, np.int64),
    )


def first_rows_by_cube(
    points: Array, size: float, ranges: tuple[float, float] = (0.0, np.inf)
) -> npt.NDArray[np.int64]:
    """Rows of the first point in each cube of edge ``size``, of the points within ranges."""
    rows = np.empty(len(points), np.int64)
    return rows[: kernels.thin_kernel(points, size, ranges[0] ** 2, ranges[1] ** 2, rows)]


def evenly_spaced_rows(n: int, most: int) -> npt.NDArray[np.int64]:
    """At most ``most`` of n rows, evenly spaced."""
    return np.arange(n, dtype=np.int64) if n <= most else np.arange(most, dtype=np.int64) * n // most
