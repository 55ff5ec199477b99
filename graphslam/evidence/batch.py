"""Insertion of one scan into many grids, each with its own pose, as a particle filter needs it.

The result does not depend on the number of threads: each grid is written by one thread, and its values do not depend
on the other grids.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, GridError
from graphslam.core.geometry import Array
from graphslam.core.interrupt import defer_interrupts
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.mark_kernels import (
    BRICKS,
    CUT,
    NEED_SLOTS,
    NOT_FINITE,
    OUTSIDE,
    RAYS,
    TALLY,
    ZERO_LENGTH,
    mark_grids,
)
from graphslam.evidence.pool import GridPool
from graphslam.evidence.scan import UpdateReport, check_number, pose_rows, scan_rows
from graphslam.evidence.tree_kernels import write_bricks
from graphslam.evidence.update_kernels import PENDING, apply_grids, finalise_writes, release_sources, resolve_writes

BATCH = 64
"""Grids that are marked at a time; limits the scratch memory of filters with many particles."""
SERIAL_BATCH = 4
"""The same for one thread: the marks of so few grids are still in the cache when they are applied."""

Scan = tuple[Array, Array, npt.NDArray[np.uint8], float]


def update_grids(
    grids: Sequence[GridTree],
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
        With the same pool, voxel size and beam model; none twice. Locked grids are not changed, only counted.
    poses : (P, 7), (P, 4, 4), or (P, 3) in 2-D
        ``T_grid_scan`` for each grid.
    points, origin, max_range, returns
        As in `EvidenceGrid.insert_scan`.
    threads : int
        Values and report are the same for any number.

    Returns
    -------
    UpdateReport
        Counts summed over the grids.
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
        raise GridError("a grid is repeated in one update", wanted="each grid once")
    scan = scan_rows(points, origin, returns, max_range, first.dim, first.voxel_size)
    T = pose_rows(poses, first.dim)
    check_number("poses", T, len(grids))
    locked = sum(g.locked for g in grids)
    if locked:
        free = [k for k, g in enumerate(grids) if not g.locked]
        if not free:
            return UpdateReport(locked=locked)
        grids, T = [grids[k] for k in free], T[free]
    with first.pool.lock, defer_interrupts():
        tally = insert_scan(grids, T, scan, threads)
    return update_report(tally, locked)


def update_report(tally: npt.NDArray[np.int64], locked: int = 0) -> UpdateReport:
    """Convert the tally of a kernel to a report."""
    t = tally.tolist()
    return UpdateReport(t[RAYS], t[CUT], t[NOT_FINITE], t[ZERO_LENGTH], t[OUTSIDE], locked, t[BRICKS])


def insert_scan(grids: Sequence[GridTree], poses: Array, scan: Scan, threads: int) -> npt.NDArray[np.int64]:
    """Insert a checked scan. Hold the pool's lock, and defer Ctrl-C if there are several grids. ``poses (P, 12)``."""
    pool = grids[0].pool
    tally = np.zeros(TALLY, np.int64)
    roots = make_unique(grids, pool)
    n = len(roots)
    work, size = (_insert_serial, SERIAL_BATCH) if threads == 1 else (_insert_threads, BATCH)
    if n == 1:
        _insert_serial(grids[0], roots, poses, scan, False, threads, tally)
        return tally
    shared = pool.scratch(0)
    shared.forget_made()
    try:
        for begin in range(0, n, size):
            work(grids[0], roots[begin : begin + size], poses[begin : begin + size], scan, True, threads, tally)
    finally:  # only at the end: sharing of bricks must not depend on the batch size
        release_sources(shared.left, pool.tree.brick_ref, pool.tree.brick_free, pool.tree.counters)
    return tally


def make_unique(grids: Sequence[GridTree], pool: GridPool) -> npt.NDArray[np.int64]:
    """Make every grid the only owner of its root; roots ``(P,)``. Hold the pool's lock."""
    pool.collect()
    boxes = [g._box for g in grids]
    owned = pool.own(boxes)
    if owned is not boxes:
        for g, box in zip(grids, owned):
            g._box = box
        del boxes
        pool.collect()  # roots without another owner: their bricks may be written in place
    return np.array([box.root for box in owned], np.int64)


def write_packed(grid: GridTree, keys: npt.NDArray[np.int64], values: npt.NDArray[np.int16]) -> None:
    """Replace bricks, given packed offset coordinates ``(n,)`` and values ``(n, 512)``; nothing is checked."""
    pool = grid.pool
    with pool.lock, defer_interrupts():
        make_unique((grid,), pool)  # first, because it may allocate a node
        pool.reserve(len(keys) * (pool.levels - 1), len(keys))
        write_bricks(grid.root, keys, values, grid.model.threshold_step, pool.tree)


def _insert_serial(
    grid: GridTree,
    roots: npt.NDArray[np.int64],
    poses: Array,
    scan: Scan,
    share: bool,
    threads: int,
    tally: npt.NDArray[np.int64],
) -> None:
    """As :func:`_insert_threads`, in this thread only; its overhead matters for planar scans."""
    pool = grid.pool
    s = pool.scratch(0)
    n, levels = len(roots), pool.levels
    ends = np.empty(n, np.int64)
    count = np.zeros(TALLY, np.int64)
    scale = 1.0 / grid.voxel_size
    slots = 0

    def finish() -> None:
        t = pool.tree
        apply_grids(
            0, n, roots, ends, levels, grid.model.steps, s.slot_key, s.marks, s.marks64, s.work, t.children,
            t.node_occupied, t.bricks, t.brick_lines,
        )  # fmt: skip
        finalise_writes(
            0, n, roots, ends, levels, s.slot_key, s.work, t.children, t.node_occupied, t.brick_lines, s.left,
            t.counters,
        )  # fmt: skip
        if not share:
            release_sources(s.left, pool.tree.brick_ref, pool.tree.brick_free, pool.tree.counters)

    try:
        while not mark_grids(
            0, n, poses, *scan, scale, pool.half, ends, s.window, s.slot_key, s.slot_next, s.marks, count
        ):
            s.resize(int(count[NEED_SLOTS]))  # the marks are discarded; start again
            count[:] = 0
        slots = int(ends[-1])
        # every marked brick may need a new brick and new nodes on its path, except the root
        pool.reserve(slots * (levels - 1), slots)
        s.reserve_left(slots)
        t = pool.tree
        resolve_writes(
            0, n, roots, ends, levels, s.slot_key, s.marks64, s.work, share, s.table, s.made, s.made_marks,
            t.children, t.node_ref, t.node_occupied, t.brick_ref, t.node_free, t.brick_free,
            t.counters,
        )  # fmt: skip
        finish()
    except BaseException:  # Ctrl-C may occur between any two calls
        if pool.tree.counters[PENDING]:
            finish()
        elif not share:
            release_sources(s.left, pool.tree.brick_ref, pool.tree.brick_free, pool.tree.counters)
        s.reset()
        raise
    tally += count
    tally[BRICKS] += slots


def _insert_threads(
    grid: GridTree,
    roots: npt.NDArray[np.int64],
    poses: Array,
    scan: Scan,
    share: bool,
    threads: int,
    tally: npt.NDArray[np.int64],
) -> None:
    """Mark in parallel, resolve in one thread (it allocates), apply in parallel; the caller defers Ctrl-C."""
    pool = grid.pool
    threads = min(threads, len(roots))
    scale = 1.0 / grid.voxel_size
    n = len(roots)
    ends = np.zeros(n, np.int64)
    cuts = [i * n // threads for i in range(threads + 1)]
    shared, scratches = pool.scratch(0), [pool.scratch(i) for i in range(threads)]
    counts = [np.zeros(TALLY, np.int64) for _ in range(threads)]

    def mark(i: int) -> None:
        s = scratches[i]
        while not mark_grids(
            cuts[i], cuts[i + 1], poses, *scan, scale, pool.half, ends, s.window, s.slot_key, s.slot_next, s.marks,
            counts[i],
        ):  # fmt: skip
            s.resize(int(counts[i][NEED_SLOTS]))  # the marks are discarded; start again
            counts[i][:] = 0

    def apply(i: int) -> None:
        s, t = scratches[i], pool.tree
        apply_grids(
            cuts[i], cuts[i + 1], roots, ends, pool.levels, grid.model.steps, s.slot_key, s.marks, s.marks64, s.work,
            t.children, t.node_occupied, t.bricks, t.brick_lines,
        )  # fmt: skip

    try:
        _in_threads(mark, threads)
        slots = [int(ends[cuts[i + 1] - 1]) for i in range(threads)]
        # every marked brick may need a new brick and new nodes on its path, except the root
        pool.reserve(sum(slots) * (pool.levels - 1), sum(slots))
        shared.reserve_left(sum(slots))
    except BaseException:
        for s in scratches:
            s.reset()
        raise
    t = pool.tree
    for i, s in enumerate(scratches):
        resolve_writes(
            cuts[i], cuts[i + 1], roots, ends, pool.levels, s.slot_key, s.marks64, s.work, share, shared.table,
            shared.made, shared.made_marks, t.children, t.node_ref, t.node_occupied, t.brick_ref,
            t.node_free, t.brick_free, t.counters,
        )  # fmt: skip
    _in_threads(apply, threads)
    for i, s in enumerate(scratches):
        finalise_writes(
            cuts[i], cuts[i + 1], roots, ends, pool.levels, s.slot_key, s.work, t.children, t.node_occupied,
            t.brick_lines, shared.left, t.counters,
        )  # fmt: skip
    for count in counts:
        tally += count
    tally[BRICKS] += sum(slots)


_threads: dict[int, ThreadPoolExecutor] = {}


def _in_threads(work: Any, n: int) -> None:
    """Run ``work(0)`` in this thread and ``work(1) … work(n-1)`` in others; wait for all; raise the first error."""
    if n not in _threads:
        _threads[n] = ThreadPoolExecutor(n - 1, thread_name_prefix="evidence")
    others = [_threads[n].submit(work, i) for i in range(1, n)]
    try:
        work(0)
    finally:
        for other in others:
            other.exception()
    for other in others:
        other.result()
