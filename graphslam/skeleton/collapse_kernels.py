"""Numba kernels: sets of measurements that correspond (union-find). Plain arrays only."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import callee, njit


@callee
def _root(parent, i):
    """First member of the set of ``i``, with path halving."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(nogil=True)
def join_pairs(parent, a, b):
    """Join the sets of ``a[k]`` and ``b[k]``; the smaller index becomes the root (parent index ≤ child index).

    Returns
    -------
    int
        Pairs that joined two different sets.
    """
    joined = 0
    for k in range(len(a)):
        i, j = _root(parent, np.int64(a[k])), _root(parent, np.int64(b[k]))
        if i < j:
            parent[j] = i
            joined += 1
        elif j < i:
            parent[i] = j
            joined += 1
    return joined


@njit(nogil=True)
def number_sets(parent):
    """Replace every parent by the number of its set; sets are numbered by their first members. Returns the count.

    A parent's index is at most its child's, so it already has its number when the child is processed.
    """
    n = 0
    for i in range(len(parent)):
        if parent[i] == i:
            parent[i] = n
            n += 1
        else:
            parent[i] = parent[parent[i]]
    return n


@njit(nogil=True)
def renumber(label, table):
    """Renumber labels by first appearance; ``table`` is -1 for each old label. Returns their number."""
    n = 0
    for i in range(len(label)):
        if table[label[i]] < 0:
            table[label[i]] = n
            n += 1
        label[i] = table[label[i]]
    return n
