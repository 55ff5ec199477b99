"""Ancestry of particles: their past paths, and common ancestors.

The poses of a step are stored once, as rows with the row of their parent in the previous step. Rows without descendants
are pruned at intervals, so a long run has one row per step for the common past and one per lineage for the recent past
(SegSLAM Fig. 2–3).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array

Ints = npt.NDArray[np.int64]


class Ancestry:
    """Ancestry tree of a particle filter.

    Each step: :meth:`record` the particles, then :meth:`branch` if they are resampled.

    Parameters
    ----------
    particles : int
        N.
    width : int
        Length of a pose, 3 or 7.
    prune_every : int
        Steps between prunings of extinct lineages; 0 = no pruning, for plots of short runs.
    """

    def __init__(self, particles: int, width: int, *, prune_every: int = 32) -> None:
        if particles < 1 or prune_every < 0:
            raise GeometryError(
                "impossible ancestry", got=f"{particles} particles, pruned every {prune_every}", wanted="≥ 1 and ≥ 0"
            )
        self.prune_every = prune_every
        self._n, self._width = particles, width
        self._poses: list[Array] = []  # by step: (rows, width)
        self._tags: list[Ints] = []  # (rows,)
        self._number: list[Ints] = []  # (rows,) particle number of a row
        self._parent: list[Ints] = []  # (rows,) row of the previous step; -1 in the first step
        self._current = np.full(particles, -1, dtype=np.int64)  # row of the last step of each particle
        self._tight = 0  # all rows of earlier steps had descendants at the last pruning
        self._looked = 0

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def particles(self) -> int:
        """N."""
        return self._n

    @property
    def rows(self) -> int:
        """Number of stored rows, of all steps."""
        return sum(map(len, self._parent))

    def record(self, poses: Array, tags: npt.ArrayLike | None = None) -> None:
        """Store the poses of the particles in this step.

        Parameters
        ----------
        poses : (N, 3) or (N, 7)
        tags : (N,) int, optional
            Any number per pose, such as the segment of its frame; default 0.
        """
        p = np.array(poses, dtype=np.float64)
        if p.shape != (self._n, self._width):
            raise GeometryError("poses do not fit the ancestry", got=p.shape, wanted=(self._n, self._width))
        self._poses.append(p)
        self._tags.append(np.array(np.broadcast_to(0 if tags is None else np.asarray(tags), self._n), dtype=np.int64))
        self._number.append(np.arange(self._n, dtype=np.int64))
        self._parent.append(self._current)
        self._current = np.arange(self._n, dtype=np.int64)
        if self.prune_every and len(self) - self._looked >= self.prune_every:
            self.prune()

    def branch(self, ancestors: Ints) -> None:
        """Particle i continues from particle ``ancestors[i]`` ``(N,)``."""
        self._current = self._current[ancestors]

    def prune(self) -> None:
        """Delete rows without descendants."""
        self._looked = len(self)
        alive = self._current
        for k in range(len(self) - 1, -1, -1):
            rows = len(self._parent[k])
            keep = np.zeros(rows, dtype=np.bool_)
            keep[alive] = True
            if keep.all():
                if k <= self._tight:
                    break  # all earlier rows have descendants here
                alive = self._parent[k]
                continue
            new = np.cumsum(keep) - 1  # row numbers after the deletion
            if k + 1 < len(self):
                self._parent[k + 1] = new[self._parent[k + 1]]
            else:
                self._current = new[self._current]
            self._poses[k] = self._poses[k][keep]
            for column in (self._tags, self._number, self._parent):
                column[k] = column[k][keep]
            alive = self._parent[k]
        self._tight = max(len(self) - 1, 0)

    def _backwards(self) -> Iterator[tuple[int, Ints]]:
        """Iterate backwards: step, and the row of each current particle's ancestor in it."""
        row = self._current
        for k in range(len(self) - 1, -1, -1):
            yield k, row
            row = self._parent[k][row]

    def paths(self) -> Array:
        """Past poses of every particle ``(steps, N, width)``."""
        out = np.empty((len(self), self._n, self._width))
        for k, row in self._backwards():
            out[k] = self._poses[k][row]
        return out

    def recent(self, steps: int) -> Array:
        """As :meth:`paths`, of the last ``steps`` steps only: ``(steps, N, width)``."""
        out = np.empty((min(steps, len(self)), self._n, self._width))
        for k, row in self._backwards():
            j = k - (len(self) - len(out))
            if j < 0:
                break
            out[j] = self._poses[k][row]
        return out

    def path(self, particle: int) -> Array:
        """Past poses of one particle ``(steps, width)``."""
        out = np.empty((len(self), self._width))
        row = int(self._current[particle])
        for k in range(len(self) - 1, -1, -1):
            out[k] = self._poses[k][row]
            row = int(self._parent[k][row])
        return out

    def tags(self) -> Ints:
        """Past tags of every particle ``(steps, N)``."""
        out = np.empty((len(self), self._n), dtype=np.int64)
        for k, row in self._backwards():
            out[k] = self._tags[k][row]
        return out

    def numbers(self) -> Ints:
        """Particle number of the ancestor of each current particle in every step ``(steps, N)``."""
        out = np.empty((len(self), self._n), dtype=np.int64)
        for k, row in self._backwards():
            out[k] = self._number[k][row]
        return out

    def survivors(self) -> Ints:
        """Number of distinct ancestors of the current particles in each step ``(steps,)``."""
        out = np.empty(len(self), dtype=np.int64)
        for k, row in self._backwards():
            out[k] = len(np.unique(row))
        return out

    def coalescence(self) -> int:
        """The last step with a single common ancestor of all current particles; -1 if there is none."""
        for k, row in self._backwards():
            if np.all(row == row[0]):
                return k
        return -1

    def links(self) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """Edges of the stored tree.

        Returns
        -------
        edges : (e, 3)
            Step; number of the particle there; number of its parent in the previous step.
        alive : (e,)
            Whether a current particle descends from it.
        """
        edges, alive = [], []
        row = self._current
        for k in range(len(self) - 1, 0, -1):
            living = np.zeros(len(self._parent[k]), dtype=np.bool_)
            living[row] = True
            number, parent = self._number[k], self._parent[k]
            edges.append(np.column_stack([np.full(len(number), k), number, self._number[k - 1][parent]]))
            alive.append(living)
            row = parent[living]
        if not edges:
            return np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.bool_)
        return np.concatenate(edges[::-1]), np.concatenate(alive[::-1])
