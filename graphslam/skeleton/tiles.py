"""Skeleton networks with measurements on disk, one tile in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.tile_store import Labels, Points, Tiles, write_tiles


def write_tiled_problem(problem: SkeletonProblem, folder: str | Path, size: int = 20_000) -> SkeletonProblem:
    """Write the measurements in tiles of ``size`` poses; results are bitwise equal to those of the network in memory.

    Odometry, tilt, GPS and poses stay in memory.
    """
    if size < 1:
        raise ConfigError(f"tiles of {size} poses; wanted 1 or more")
    if len(problem.normals):
        raise ConfigError("measurements with normals are not written in tiles")

    def blocks() -> Iterator[tuple[npt.NDArray[np.int64], Points, Labels]]:
        for a in range(0, problem.poses, size):
            b = min(a + size, problem.poses)
            lo, hi = problem.first[a], problem.first[b]
            yield np.diff(problem.first[a : b + 1]), problem.points[lo:hi], problem.landmark[lo:hi]

    return load_tiled_problem(problem, write_tiles(folder, blocks()))


def load_tiled_problem(problem: SkeletonProblem, tiles: Tiles) -> SkeletonProblem:
    """The network with the measurements of given tiles in place of its own."""
    nothing = np.empty((0, 3), np.float32), np.empty(0, np.int32)
    return replace(problem, points=nothing[0], landmark=nothing[1], first=tiles.first, tiles=tiles)
