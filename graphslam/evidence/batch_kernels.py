"""Compiled insertion of one scan into many grids by several threads: mark, resolve, apply, drop.

Each thread marks and applies its own run of grids; only resolving the paths, which allocates, is done by one. A brick
that was copied from keeps its parents until every thread has applied: the last owner among the grids of a batch would
otherwise write in place while another thread still copies from it. Arrays as in :mod:`update_kernels`; besides them
``ends (P,) int64`` (end of each grid's slots) and ``work (S, 4) int32`` [parent node, child, source, target].
"""

from __future__ import annotations

import numba

from graphslam.evidence.update_kernels import apply_slots, mark_scan, resolve_slots


@numba.njit(cache=True, nogil=True)
def mark_grids(
    begin,
    end,
    poses,
    points,
    origins,
    returns,
    max_range,
    scale,
    half,
    ends,
    window,
    slot_key,
    slot_next,
    marks,
    tally,
):
    """Mark the scan in grids ``begin … end-1``; returns the first that found no slots (or ``end``)."""
    first = 0
    for g in range(begin, end):
        counted = tally[:6].copy()
        n = mark_scan(
            poses[g],
            points,
            origins,
            returns,
            max_range,
            scale,
            half,
            first,
            window,
            slot_key,
            slot_next,
            marks,
            tally,
        )
        if n < 0:
            tally[:6] = counted
            return g
        ends[g] = n
        first = n
    return end


@numba.njit(cache=True, nogil=True)
def resolve_grids(
    begin,
    end,
    roots,
    ends,
    levels,
    slot_key,
    work,
    children,
    node_ref,
    node_occupied,
    brick_ref,
    node_free,
    brick_free,
    counters,
):
    """Own the paths to all slots of grids ``begin … end-1`` of one thread's scratch. Room was reserved."""
    first = 0
    for g in range(begin, end):
        resolve_slots(
            first,
            ends[g],
            roots[g],
            levels,
            slot_key,
            work,
            children,
            node_ref,
            node_occupied,
            brick_ref,
            node_free,
            brick_free,
            counters,
        )
        first = ends[g]


@numba.njit(cache=True, nogil=True)
def apply_grids(
    begin,
    end,
    roots,
    ends,
    levels,
    steps,
    slot_key,
    marks,
    marks64,
    work,
    children,
    node_occupied,
    bricks,
    brick_lines,
):
    """Apply the marks of grids ``begin … end-1``; touches nothing another thread does."""
    first = 0
    for g in range(begin, end):
        apply_slots(
            first,
            ends[g],
            roots[g],
            levels,
            steps,
            slot_key,
            marks,
            marks64,
            work,
            children,
            node_occupied,
            bricks,
            brick_lines,
        )
        first = ends[g]
