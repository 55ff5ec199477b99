"""Which particle descends from which: paths back in time, and how soon they meet.

A step's poses are written once, as rows, and each row remembers the row of the step before that it went on from. What
nobody descends from any more is thrown away now and then, so that a long run holds one row a step for what all
particles share, and as many as there are lineages for the recent past (SegSLAM Fig. 2–3).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array

Ints = npt.NDArray[np.int64]


class Ancestry:
    """The family tree of a particle filter.

    Each step: :meth:`record` the particles as they stand, then :meth:`branch` if they are resampled.

    Parameters
    ----------
    particles : int
        N.
    width : int
        Length of a pose, 3 or 7.
    prune_every : int
        Steps between two looks for lineages that died out; 0 = keep them, for pictures of short runs.
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
        self._number: list[Ints] = []  # (rows,) which particle a row was
        self._parent: list[Ints] = []  # (rows,) row of the step before; -1 in the first step
        self._current = np.full(particles, -1, dtype=np.int64)  # row of the last step each particle stands on
        self._tight = 0  # rows of steps before this one all had descendants at the last look
        self._looked = 0

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def particles(self) -> int:
        """N."""
        return self._n

    @property
    def rows(self) -> int:
        """Rows held, of all steps."""
        return sum(map(len, self._parent))

    def record(self, poses: Array, tags: npt.ArrayLike | None = None) -> None:
        """Write down where the particles stand in this step.

        Parameters
        ----------
        poses : (N, 3) or (N, 7)
        tags : (N,) int, optional
            Whatever belongs to a pose, as the segment whose frame it is in; default 0.
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
        """Particle i goes on from what particle ``ancestors[i]`` was ``(N,)``."""
        self._current = self._current[ancestors]

    def prune(self) -> None:
        """Throw away rows that no particle descends from."""
        self._looked = len(self)
        alive = self._current
        for k in range(len(self) - 1, -1, -1):
            rows = len(self._parent[k])
            keep = np.zeros(rows, dtype=np.bool_)
            keep[alive] = True
            if keep.all():
                if k <= self._tight:
                    break  # everything before has descendants here
                alive = self._parent[k]
                continue
            new = np.cumsum(keep) - 1  # row numbers after the others are gone
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
        """Step by step towards the beginning: step, row each of today's particles had then."""
        row = self._current
        for k in range(len(self) - 1, -1, -1):
            yield k, row
            row = self._parent[k][row]

    def paths(self) -> Array:
        """Poses of every particle's own past ``(steps, N, width)``."""
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
        """Poses of one particle's past ``(steps, width)``."""
        out = np.empty((len(self), self._width))
        row = int(self._current[particle])
        for k in range(len(self) - 1, -1, -1):
            out[k] = self._poses[k][row]
            row = int(self._parent[k][row])
        return out

    def tags(self) -> Ints:
        """Tags of every particle's own past ``(steps, N)``."""
        out = np.empty((len(self), self._n), dtype=np.int64)
        for k, row in self._backwards():
            out[k] = self._tags[k][row]
        return out

    def numbers(self) -> Ints:
        """Which particle each of today's particles was in every step ``(steps, N)``."""
        out = np.empty((len(self), self._n), dtype=np.int64)
        for k, row in self._backwards():
            out[k] = self._number[k][row]
        return out

    def survivors(self) -> Ints:
        """Number of different ancestors that today's particles had in each step ``(steps,)``."""
        out = np.empty(len(self), dtype=np.int64)
        for k, row in self._backwards():
            out[k] = len(np.unique(row))
        return out

    def coalescence(self) -> int:
        """The last step in which all of today's particles were one; -1 if they never were."""
        for k, row in self._backwards():
            if np.all(row == row[0]):
                return k
        return -1

    def links(self) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """What is left of the tree, edge by edge.

        Returns
        -------
        edges : (e, 3)
            Step; number of the particle there; number of the one it went on from, in the step before.
        alive : (e,)
            Whether some particle of today descends from it.
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
