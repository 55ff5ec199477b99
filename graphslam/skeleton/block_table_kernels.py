"""Numba kernels of a growing hash table for the blocks of a sparse matrix."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit


class BlockTable(NamedTuple):
    """Blocks (row, column), row ≤ column, with open addressing; made by :func:`make_block_table`."""

    key: npt.NDArray[np.int64]
    """(2^b,): row · keyframes + column, -1 if free."""
    place: npt.NDArray[np.int32]
    """(2^b,)"""
    block: npt.NDArray[np.float64]
    """(capacity, 6, 6)"""
    filled: npt.NDArray[np.int64]
    """(1,): number of blocks."""


@njit(nogil=True)
def make_block_table(capacity):
    """An empty table for ``capacity`` blocks."""
    size = 16
    while size < 2 * capacity:
        size *= 2
    return BlockTable(
        np.full(size, -1, np.int64),
        np.zeros(size, np.int32),
        np.zeros((capacity, 6, 6)),
        np.zeros(1, np.int64),
    )


@callee
def _find(table, key):
    """Index of a block; a missing one is added."""
    mask = len(table.key) - 1
    at = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask
    while table.key[at] != key:
        if table.key[at] < 0:
            table.key[at] = key
            table.place[at] = table.filled[0]
            table.filled[0] += 1
            break
        at = (at + 1) & mask
    return table.place[at]


@callee
def _grown(table):
    """The table with twice the capacity."""
    n = table.filled[0]
    big = make_block_table(2 * len(table.block))
    big.block[:n] = table.block[:n]
    keys = np.empty(n, np.int64)
    for at in range(len(table.key)):
        if table.key[at] >= 0:
            keys[table.place[at]] = table.key[at]
    for i in range(n):
        _find(big, keys[i])
    return big


@njit(nogil=True)
def add_block_table(table, other):
    """Add the blocks of another table; returns the table, as it may have grown."""
    keys = sorted_block_keys(other)
    for i in range(len(keys)):
        if table.filled[0] == len(table.block):
            table = _grown(table)
        table.block[_find(table, keys[i])] += other.block[i]
    return table


@njit(nogil=True)
def sorted_block_keys(table):
    """Keys in the order of the blocks."""
    keys = np.empty(table.filled[0], np.int64)
    for at in range(len(table.key)):
        if table.key[at] >= 0:
            keys[table.place[at]] = table.key[at]
    return keys
