"""The slow obvious twin of the ancestry: every particle carries its whole past with it."""

from __future__ import annotations

import copy

import numpy as np

from graphslam.core.geometry import Array


class FamilyTree:
    """N lists of (step, number of the particle it was, pose, tag)."""

    def __init__(self, particles: int) -> None:
        self.past: list[list[tuple[int, int, Array, int]]] = [[] for _ in range(particles)]
        self.steps = 0
        self.edges: list[tuple[int, int, int]] = []
        self._last = [-1] * particles

    def record(self, poses: Array, tags: Array) -> None:
        for i, past in enumerate(self.past):
            if self.steps:
                self.edges.append((self.steps, i, self._last[i]))
            past.append((self.steps, i, poses[i].copy(), int(tags[i])))
            self._last[i] = i
        self.steps += 1

    def branch(self, ancestors: Array) -> None:
        self.past = [copy.copy(self.past[a]) for a in ancestors]
        self._last = [self._last[a] for a in ancestors]

    def paths(self) -> Array:
        return np.array([[past[k][2] for past in self.past] for k in range(self.steps)])

    def tags(self) -> Array:
        return np.array([[past[k][3] for past in self.past] for k in range(self.steps)])

    def numbers(self) -> Array:
        return np.array([[past[k][1] for past in self.past] for k in range(self.steps)])

    def survivors(self) -> list[int]:
        return [len({past[k][1] for past in self.past}) for k in range(self.steps)]

    def coalescence(self) -> int:
        return max((k for k, s in enumerate(self.survivors()) if s == 1), default=-1)

    def living_edges(self) -> set[tuple[int, int, int]]:
        return {(k, past[k][1], past[k - 1][1]) for past in self.past for k in range(1, self.steps)}
