"""Says that kernels are being compiled, the one time they are.

Compiled code is kept on disk beside the package (or where ``NUMBA_CACHE_DIR`` says), so only the first use on a machine
waits; a first use that waits in silence looks like a hang.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from graphslam.evidence.kernels import without_garbage_collection
from graphslam.evidence.layout import BRICK_VOXELS, UNKNOWN
from graphslam.evidence.mark_kernels import mark_grids

if TYPE_CHECKING:
    from graphslam.evidence.grid import EvidenceGrid

_state = {"checked": False}


def is_compiled(kernel: Any) -> bool:
    """Whether compiled code of a kernel lies on disk, of this source or an older one; true also where nothing is
    compiled.
    """
    if not hasattr(kernel, "stats"):  # NUMBA_DISABLE_JIT
        return True
    source = Path(inspect.getsourcefile(kernel.py_func) or "")
    return any(Path(kernel.stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__name__}-*.nbi"))


def announce_compilation() -> None:
    """Load the kernels that insert a scan. If this machine has not compiled them yet, compile every kernel, with a line
    of progress on stderr.
    """
    if _state["checked"]:
        return
    _state["checked"] = True
    if not is_compiled(mark_grids):
        compile_kernels()
        return
    with without_garbage_collection():
        _first_half()[0][1]()
    if hasattr(mark_grids, "stats") and mark_grids.stats.cache_misses:  # it was code of an older source
        compile_kernels()


def compile_kernels(*, progress: bool = True) -> None:
    """Compile every kernel of the package by using it on a map of one voxel.

    Compiling is the compiler's own Python, on one core: a second process takes one half, where there is one to take it.
    """
    _state["checked"] = True
    other = _start_other_half()
    with (
        without_garbage_collection(),
        tqdm(desc="compiling evidence kernels, once", unit="part", file=sys.stderr, disable=not progress) as bar,
    ):
        uses = _first_half()
        bar.reset(total=len(uses) + 1)
        for name, use in uses:
            bar.set_postfix_str(name)
            use()
            bar.update()
        bar.set_postfix_str("files")
        if other is None or other.wait() != 0:
            for _, use in _second_half():
                use()
        bar.update()


def _start_other_half() -> subprocess.Popen[bytes] | None:
    if not sys.executable or (os.cpu_count() or 1) < 2:
        return None
    try:
        return subprocess.Popen(
            [sys.executable, "-c", "from graphslam.evidence.compile import _as_other_half as f; f()"],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError:
        return None


def _as_other_half() -> None:
    """All that the second process does."""
    _state["checked"] = True  # or it would look for a process of its own
    with without_garbage_collection():
        for _, use in _second_half():
            use()


def _first_half() -> list[tuple[str, Callable[[], object]]]:
    """Small pieces of work: what a filter does with its maps."""
    from graphslam.evidence.batch import update_grids
    from graphslam.evidence.grid import EvidenceGrid

    grid = EvidenceGrid(1.0)
    other = grid.copy()
    point = np.array([[3.0, 0.0, 0.0]])
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1))
    return [
        ("scans", lambda: update_grids([grid, other], poses, point)),
        ("values", lambda: grid.values_at(point)),
        ("casts", lambda: grid.cast(None, point, 5.0)),
        ("points", lambda: grid.log_odds_at(point)),
        ("boxes", lambda: (grid.box_query(-point, point), grid.bounding_box())),
        ("sums", lambda: (grid.entropy(), grid.memory())),
    ]


def _second_half() -> list[tuple[str, Callable[[], object]]]:
    """Small pieces of work: what is done with whole maps. None of it inserts a scan, which is compiled elsewhere."""
    from graphslam.evidence.compact import compact
    from graphslam.evidence.formats import to_dense
    from graphslam.evidence.grid import EvidenceGrid

    grid = EvidenceGrid(1.0)
    values = np.full((1, BRICK_VOXELS), UNKNOWN, np.int16)
    values[0, 0] = 100
    return [
        ("bricks", lambda: grid.write_bricks([[0, 0, 0]], values)),
        ("merges", lambda: grid.merge(grid.copy())),
        ("clouds", grid.occupied_cloud),
        ("dense", lambda: to_dense(grid, dtype=np.float32)),
        ("compaction", lambda: compact([grid, grid.copy()])),
        ("files", lambda: _through_files(grid)),
    ]


def _through_files(grid: EvidenceGrid) -> None:
    from graphslam.evidence.octomap import read_octomap, write_octomap

    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".bt", ".ot"):
            write_octomap(grid, Path(folder) / f"one{suffix}")
            read_octomap(Path(folder) / f"one{suffix}")
