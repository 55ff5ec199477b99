"""Says that kernels are being compiled, the one time they are.

Compiled code is kept on disk beside the package (or where ``NUMBA_CACHE_DIR`` says), so only the first use on a machine
waits; a first use that waits in silence looks like a hang.
"""

from __future__ import annotations

import inspect
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from graphslam.evidence.mark_kernels import mark_grids

if TYPE_CHECKING:
    from graphslam.evidence.grid import EvidenceGrid

_state = {"checked": False}


def is_compiled(kernel: Any) -> bool:
    """Whether compiled code of a kernel lies on disk, no older than its source; true also where nothing is compiled."""
    if not hasattr(kernel, "stats"):  # NUMBA_DISABLE_JIT
        return True
    source = Path(inspect.getsourcefile(kernel.py_func) or "")
    folder = Path(kernel.stats.cache_path)
    indices = folder.glob(f"{source.stem}.{kernel.py_func.__name__}-*.nbi")
    return any(i.stat().st_mtime >= source.stat().st_mtime for i in indices)


def announce_compilation() -> None:
    """Compile every kernel now, with a line of progress on stderr, if this machine has not done so before."""
    if _state["checked"]:
        return
    _state["checked"] = True
    if is_compiled(mark_grids):
        return
    compile_kernels()


def compile_kernels(*, progress: bool = True) -> None:
    """Compile every kernel of the package by using it on a map of one voxel."""
    _state["checked"] = True
    with tqdm(
        _uses(), desc="compiling evidence kernels, once", unit="part", file=sys.stderr, disable=not progress, leave=True
    ) as bar:
        for name, use in bar:
            bar.set_postfix_str(name)
            use()


def _uses() -> list[tuple[str, Callable[[], object]]]:
    """Small pieces of work that together call every kernel."""
    import numpy as np

    from graphslam.evidence.batch import update_grids as update_many
    from graphslam.evidence.compact import compact
    from graphslam.evidence.formats import to_dense
    from graphslam.evidence.grid import EvidenceGrid

    grid = EvidenceGrid(1.0)
    other = grid.copy()
    point = np.array([[3.0, 0.0, 0.0]])
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1))
    folder = tempfile.TemporaryDirectory()
    uses: list[tuple[str, Callable[[], object]]] = [
        ("scans", lambda: grid.insert_scan(point)),
        ("threads", lambda: update_many([grid, other], poses, point, threads=2)),
        ("merges", lambda: grid.merge(other)),
        ("bricks", lambda: grid.write_bricks(grid.brick_coordinates(), grid.brick_values())),
        ("values", lambda: grid.values_at(point)),
        ("casts", lambda: grid.cast(None, point, 5.0)),
        ("points", lambda: grid.log_odds_at(point)),
        ("boxes", lambda: (grid.box_query(-point, point), grid.bounding_box())),
        ("clouds", grid.occupied_cloud),
        ("sums", lambda: (grid.entropy(), grid.memory())),
        ("dense", lambda: to_dense(grid, dtype=np.float32)),
        ("compaction", lambda: compact([grid, other])),
        ("files", lambda: _through_files(grid, Path(folder.name))),
        ("clean-up", folder.cleanup),
    ]
    return uses


def _through_files(grid: EvidenceGrid, folder: Path) -> None:
    from graphslam.evidence.octomap import read_octomap, write_octomap

    for suffix in (".bt", ".ot"):
        write_octomap(grid, folder / f"one{suffix}")
        read_octomap(folder / f"one{suffix}")
