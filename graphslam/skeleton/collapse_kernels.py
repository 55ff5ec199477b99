"""Numba kernels: sets of measurements that correspond (union-find). Plain arrays only."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import njit


@njit(nogil=True)
def _root(parent, i):
    """First member of the set of ``i``; every other node on the way is hung one step higher (path halving)."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(nogil=True)
def join_pairs(parent, a, b):
    """Join the sets of ``a[k]`` and ``b[k]``; the smaller index becomes the root, so no parent is above its child.

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
    """Replace every parent by the number of its set; sets are numbered by their first members. Returns their count.

    A parent is not above its child, so its place holds the number already when the child is reached.
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
    """Number labels anew by their first appearance; ``table`` is -1 for each old label. Returns how many there are."""
    n = 0
    for i in range(len(label)):
        if table[label[i]] < 0:
            table[label[i]] = n
            n += 1
        label[i] = table[label[i]]
    return n
