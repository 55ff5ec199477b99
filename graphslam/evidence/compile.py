"""Compile all kernels of the package by running them on a tiny map: ``python -m graphslam.evidence.compile``."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from graphslam.core.jit import COMPILING, without_garbage_collection
from graphslam.evidence.batch import update_grids
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.formats import to_dense
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.jit_notice import start_compiling
from graphslam.evidence.layout import BRICK_VOXELS, UNKNOWN
from graphslam.evidence.octomap import read_octomap, write_octomap


def compile_kernels() -> None:
    """Compile all kernels.

    The compiler runs on one core, so a second process compiles one half if there is more than one core.
    """
    other = start_compiling("half", subprocess.Popen) if (os.cpu_count() or 1) > 1 else None
    with without_garbage_collection():
        for use in _first_half():
            use()
        if other is None or other.wait() != 0:
            for use in _second_half():
                use()


def _first_half() -> list[Callable[[], object]]:
    """Small calls of the functions that a filter uses."""
    grid = EvidenceGrid(1.0)
    other = grid.copy()
    point = np.array([[3.0, 0.0, 0.0]])
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1))
    return [
        lambda: update_grids([grid, other], poses, point),
        lambda: grid.values_at(point),
        lambda: grid.cast(None, point, 5.0),
        lambda: grid.log_odds_at(point),
        lambda: (grid.box_query(-point, point), grid.bounding_box()),
        lambda: (grid.entropy(), grid.memory()),
    ]


def _second_half() -> list[Callable[[], object]]:
    """Small calls of functions on whole maps. They insert no scan, because the first half compiles that."""
    grid = EvidenceGrid(1.0)
    values = np.full((1, BRICK_VOXELS), UNKNOWN, np.int16)
    values[0, 0] = 100
    return [
        lambda: grid.write_bricks([[0, 0, 0]], values),
        lambda: grid.merge(grid.copy()),
        grid.occupied_cloud,
        lambda: to_dense(grid, dtype=np.float32),
        lambda: compact_grids([grid, grid.copy()]),
        lambda: _through_files(grid),
    ]


def _through_files(grid: EvidenceGrid) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".bt", ".ot"):
            write_octomap(grid, Path(folder) / f"one{suffix}")
            read_octomap(Path(folder) / f"one{suffix}")


if __name__ == "__main__":
    os.environ[COMPILING] = "1"
    if sys.argv[1:] == ["half"]:
        with without_garbage_collection():
            for work in _second_half():
                work()
    else:
        compile_kernels()
