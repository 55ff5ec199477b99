"""One scan into many grids, each at a pose of its own: the write path of a particle filter, and the only one there is.

The same seed gives the same maps whatever the number of threads: each grid is written by one thread, and what it holds
does not depend on the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, GridError
from graphslam.core.geometry import Array
from graphslam.core.interrupt import deferred_interrupts
from graphslam.evidence.batch_kernels import apply_grids, mark_grids, resolve_grids
from graphslam.evidence.pool import GridPool
from graphslam.evidence.scan import UpdateReport, check_number, pose_rows, scan_rows
from graphslam.evidence.update_kernels import (
    BRICKS,
    CUT,
    NEED_BRICKS,
    NEED_NODES,
    NEED_SLOTS,
    NOT_FINITE,
    OUTSIDE,
    RAYS,
    ZERO_LENGTH,
    drop_sources,
)
from graphslam.evidence.update_kernels import update_grids as update_kernel

if TYPE_CHECKING:
    from graphslam.evidence.grid import EvidenceGrid

BATCH = 64
"""Grids whose marks are kept at a time: bounds the scratch memory of filters with many particles."""

Scan = tuple[Array, Array, npt.NDArray[np.uint8], float]


def update_grids(
    grids: Sequence[EvidenceGrid],
    poses: Any,
    points: Any,
    *,
    origin: Any = None,
    max_range: float | None = None,
    returns: Any = None,
    threads: int = 1,
) -> UpdateReport:
    """Insert one scan into many grids of one pool.

    Parameters
    ----------
    grids : sequence of EvidenceGrid
        Of one pool, voxel size and beam model; none twice. Locked ones are left alone and counted.
    poses : (P, 7), (P, 4, 4), or (P, 3) in 2-D
        ``T_grid_scan`` of each.
    points, origin, max_range, returns
        As in `EvidenceGrid.insert_scan`.
    threads : int
        Result and report are the same for any number.

    Returns
    -------
    UpdateReport
        Counts summed over the grids.

    Raises
    ------
    GridError, GeometryError
        Grids that do not belong together, or shapes and poses that are impossible; nothing was written.
    MemoryError
        Each grid holds either the whole scan or nothing of it.
    """
    if threads < 1:
        raise ConfigError(f"{threads} threads; wanted at least 1")
    if len(grids) == 0:
        return UpdateReport()
    first = grids[0]
    for k, g in enumerate(grids):
        if g.pool is not first.pool or g.voxel_size != first.voxel_size or g.dim != first.dim:
            raise GridError(
                f"grid {k} does not belong to the others", wanted="one pool, voxel size and dimension", got=repr(g)
            )
        if g.model is not first.model and g.model != first.model:
            raise GridError(f"grid {k} has another beam model than the first", got=g.model, wanted=first.model)
    if len({id(g) for g in grids}) != len(grids):
        raise GridError("a grid stands twice in one update", wanted="each grid once")
    scan = scan_rows(points, origin, returns, max_range, first.dim, first.voxel_size)
    T = pose_rows(poses, first.dim)
    check_number("poses", T, len(grids))
    locked = sum(g.locked for g in grids)
    if locked:
        free = [k for k, g in enumerate(grids) if not g.locked]
        if not free:
            return UpdateReport(locked=locked)
        grids, T = [grids[k] for k in free], T[free]
    with first.pool.lock, deferred_interrupts():
        tally = insert(grids, T, scan, threads)
    return report_of(tally, locked)


def report_of(tally: npt.NDArray[np.int64], locked: int = 0) -> UpdateReport:
    """A kernel's tally in words."""
    t = tally.tolist()
    return UpdateReport(t[RAYS], t[CUT], t[NOT_FINITE], t[ZERO_LENGTH], t[OUTSIDE], locked, t[BRICKS])


def insert(grids: Sequence[EvidenceGrid], poses: Array, scan: Scan, threads: int) -> npt.NDArray[np.int64]:
    """Write a checked scan; hold the pool's lock. ``poses (P, 12)``."""
    pool = grids[0].pool
    roots = own_grids(grids, pool)
    tally = np.zeros(9, np.int64)
    if threads > 1 and len(grids) > 1:
        for begin in range(0, len(grids), BATCH):
            end = min(begin + BATCH, len(grids))
            _insert_threads(grids[0], roots[begin:end], poses[begin:end], scan, min(threads, end - begin), tally)
        return tally
    _insert_serial(grids[0], roots, poses, scan, tally)
    return tally


def own_grids(grids: Sequence[EvidenceGrid], pool: GridPool) -> npt.NDArray[np.int64]:
    """Make every grid the only owner of its root; roots ``(P,)``. Hold the pool's lock."""
    pool.collect()
    boxes = [g._box for g in grids]
    owned = pool.own(boxes)
    if owned is not boxes:
        for g, box in zip(grids, owned):
            g._box = box
        del boxes
        pool.collect()  # roots nobody else holds: their bricks may be written in place
    return np.array([box.root for box in owned], np.int64)


def _insert_serial(
    grid: EvidenceGrid, roots: npt.NDArray[np.int64], poses: Array, scan: Scan, tally: npt.NDArray[np.int64]
) -> None:
    pool, scratch = grid.pool, grid.pool.scratch(0)
    points, origins, returns, limit = scan
    done = 0
    while True:
        done = update_kernel(
            done,
            roots,
            poses,
            points,
            origins,
            returns,
            limit,
            1.0 / grid.voxel_size,
            pool.half,
            pool.levels,
            grid.model.steps,
            pool.children,
            pool.node_ref,
            pool.node_occupied,
            pool.bricks,
            pool.brick_ref,
            pool.brick_lines,
            pool.node_free,
            pool.brick_free,
            pool.counters,
            scratch.window,
            scratch.slot_key,
            scratch.slot_next,
            scratch.marks,
            scratch.marks64,
            scratch.work,
            tally,
        )
        if done == len(roots):
            return
        if tally[NEED_SLOTS]:
            scratch.resize(int(tally[NEED_SLOTS]))
        else:
            pool.reserve(int(tally[NEED_NODES]), int(tally[NEED_BRICKS]))
        tally[NEED_SLOTS : NEED_BRICKS + 1] = 0


def _insert_threads(
    grid: EvidenceGrid,
    roots: npt.NDArray[np.int64],
    poses: Array,
    scan: Scan,
    threads: int,
    tally: npt.NDArray[np.int64],
) -> None:
    pool = grid.pool
    scale = 1.0 / grid.voxel_size
    cuts = np.linspace(0, len(roots), threads + 1).astype(np.int64).tolist()
    parts = [(pool.scratch(i), cuts[i], cuts[i + 1], np.zeros(9, np.int64)) for i in range(threads)]
    ends = np.zeros(len(roots), np.int64)

    def mark(i: int) -> None:
        scratch, begin, end, count = parts[i]
        while True:
            arrays = scratch.window, scratch.slot_key, scratch.slot_next, scratch.marks
            reached = mark_grids(begin, end, poses, *scan, scale, pool.half, ends, *arrays, count)
            if reached == end:
                return
            scratch.resize(int(count[NEED_SLOTS]))  # and once more from the start: the marks were thrown away
            count[:] = 0

    def apply(i: int) -> None:
        scratch, begin, end, _ = parts[i]
        apply_grids(
            begin,
            end,
            roots,
            ends,
            pool.levels,
            grid.model.steps,
            scratch.slot_key,
            scratch.marks,
            scratch.marks64,
            scratch.work,
            pool.children,
            pool.node_occupied,
            pool.bricks,
            pool.brick_lines,
        )

    try:
        _in_threads(mark, threads)
        slots = [int(ends[end - 1]) for _, _, end, _ in parts]
        pool.reserve(sum(slots) * (pool.levels - 1), sum(slots))
    except BaseException:
        for scratch, *_ in parts:
            scratch.resize(len(scratch))  # marks of a scan that will not be applied
        raise
    for scratch, begin, end, _ in parts:
        resolve_grids(
            begin,
            end,
            roots,
            ends,
            pool.levels,
            scratch.slot_key,
            scratch.work,
            pool.children,
            pool.node_ref,
            pool.node_occupied,
            pool.brick_ref,
            pool.node_free,
            pool.brick_free,
            pool.counters,
        )
    _in_threads(apply, threads)
    for (scratch, *_), n in zip(parts, slots):
        drop_sources(n, scratch.work, pool.brick_ref, pool.brick_free, pool.counters)
    for _, _, _, count in parts:
        tally += count
    tally[BRICKS] += sum(slots)


_threads: dict[int, ThreadPoolExecutor] = {}


def _in_threads(work: Any, n: int) -> None:
    """Call ``work(0) … work(n-1)``, the first of them here; wait for all; the first error is raised."""
    if n not in _threads:
        _threads[n] = ThreadPoolExecutor(n - 1 or 1, thread_name_prefix="evidence")
    others = [_threads[n].submit(work, i) for i in range(1, n)]
    try:
        work(0)
    finally:
        for other in others:
            other.exception()
    for other in others:
        other.result()
