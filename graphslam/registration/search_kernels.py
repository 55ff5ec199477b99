"""Compiled parts of the correlative search: the likelihood field and the scores of every start of a lattice.

Spatial arrays are indexed ``[z, y, x]``; in 2-D there is one layer. Scores are integers, so that they do not depend on
the order of summation.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import callee, njit


@njit(nogil=True)
def splat(cells, offsets, values, field):
    """Set the field to the maximum of itself and ``values`` around each occupied cell; values decrease with distance.

    Parameters
    ----------
    cells : (m, 3) int64
        Occupied cells x, y, z; ``offsets`` around them are inside the field.
    offsets : (k, 3) int64
    values : (k,) uint8
    field : (nz, ny, nx) uint8
        Written.
    """
    for i in range(cells.shape[0]):
        for k in range(offsets.shape[0]):
            x, y, z = cells[i, 0] + offsets[k, 0], cells[i, 1] + offsets[k, 1], cells[i, 2] + offsets[k, 2]
            field[z, y, x] = max(field[z, y, x], values[k])


@njit(nogil=True)
def score_block(cells, counts, steps, phases, scores):
    """Sum the field at all points, for every heading and translation of a lattice.

    Rows along x are added as a whole: the field is stored as one array per phase of the lattice, so neighbouring starts
    read neighbouring bytes.

    Parameters
    ----------
    cells : (headings, n, 3) int64
        Cells x, y, z of the points at the first translation of the lattice; can be outside the field.
    counts : (3,) int64
        Translations along x, y, z.
    steps : (3,) int64
        Cells of the field between translations.
    phases : (steps z, steps y, steps x, nz, ny, nx) uint8
        ``phases[c, b, a, k, j, i]`` is the field at cell ``x = a + i * steps[0]``, and so on.
    scores : (headings, counts z, counts y, counts x) uint32
        Added to; 0 outside the field.
    """
    sizes = phases.shape
    block = np.empty((counts[2], counts[1], counts[0]), np.uint16)
    for a in range(cells.shape[0]):
        for first in range(0, cells.shape[1], 256):  # 256 * 255 < 2**16
            block[:] = 0
            for p in range(first, min(first + 256, cells.shape[1])):
                x, y, z = cells[a, p, 0], cells[a, p, 1], cells[a, p, 2]
                i0, j0, k0 = x // steps[0], y // steps[1], z // steps[2]  # floor, also below zero
                part = phases[z - k0 * steps[2], y - j0 * steps[1], x - i0 * steps[0]]
                low, high = max(0, -i0), min(counts[0], sizes[5] - i0)
                if low >= high:
                    continue
                for k in range(max(0, -k0), min(counts[2], sizes[3] - k0)):
                    for j in range(max(0, -j0), min(counts[1], sizes[4] - j0)):
                        row = part[k0 + k, j0 + j, i0 + low : i0 + high]
                        out = block[k, j, low:high]
                        for i in range(row.shape[0]):
                            out[i] += np.uint16(row[i])
            for k in range(counts[2]):
                for j in range(counts[1]):
                    for i in range(counts[0]):
                        scores[a, k, j, i] += block[k, j, i]


@njit(nogil=True)
def local_maxima(weights):
    """Local maxima in array order; of equal neighbours the first counts.

    Parameters
    ----------
    weights : (na, nz, ny, nx)
        Up to 80 neighbours each, one step away along any axes. ``-inf`` is never a maximum.

    Returns
    -------
    (k, 4) int64
    """
    na, nz, ny, nx = weights.shape
    found = np.empty((64, 4), np.int64)
    n = 0
    for a in range(na):
        for k in range(nz):
            for j in range(ny):
                for i in range(nx):
                    w = weights[a, k, j, i]
                    # quick test: most elements are below a nearest neighbour
                    if w == -np.inf or (i > 0 and weights[a, k, j, i - 1] >= w):
                        continue
                    if i + 1 < nx and weights[a, k, j, i + 1] > w:
                        continue
                    if is_maximum(weights, a, k, j, i):
                        if n == found.shape[0]:
                            more = np.empty((2 * n, 4), np.int64)
                            more[:n] = found
                            found = more
                        found[n, 0], found[n, 1], found[n, 2], found[n, 3] = a, k, j, i
                        n += 1
    return found[:n]


@callee
def is_maximum(weights, a, k, j, i):
    """Whether no neighbour of element ``[a, k, j, i]`` is larger, or equal and earlier in the array."""
    na, nz, ny, nx = weights.shape
    w = weights[a, k, j, i]
    before = True
    for b in range(max(0, a - 1), min(na, a + 2)):
        for c in range(max(0, k - 1), min(nz, k + 2)):
            for d in range(max(0, j - 1), min(ny, j + 2)):
                for e in range(max(0, i - 1), min(nx, i + 2)):
                    if b == a and c == k and d == j and e == i:
                        before = False
                        continue
                    other = weights[b, c, d, e]
                    if other > w or (before and other == w):
                        return False
    return True
