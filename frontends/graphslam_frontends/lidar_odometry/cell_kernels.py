"""Gaussian cells of a point map with a cached nearest neighbour (urban GraphSLAM, equations C2).

A level divides space into cubes. A cube has the Gaussian of its points and a grid of 4 × 4 × 4 smaller cubes. Each of
these stores its nearest cell at the first query; later queries are one look-up in a hash table. A cell that becomes
valid, or whose centre moves, updates the stored neighbours around it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit

F8 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int64]
I4 = npt.NDArray[np.int32]
I1 = npt.NDArray[np.int8]

FINE = 4
"""Cached cubes along the edge of a cell."""
LEAST = 5
"""Least number of points of a valid cell."""
FULL = 400
"""Most points of a cell; more are ignored."""
UNKNOWN, NONE = -1, -2
"""State of a cached cube: not queried yet; no cell near it."""
_HALF = 1 << 20
_MASK = (1 << 21) - 1
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


class Cells(NamedTuple):
    """One level, as arrays. Blocks are cubes that have points or were queried."""

    keys: I8
    """Hash table ``(h,)``: packed cube, -1 where free."""
    slots: I4
    """Block of each key."""
    cube: I8
    """Packed cube of each block ``(b,)``."""
    number: I4
    """Number of points of each block."""
    mean: F8
    """Mean of the points ``(b, 3)``."""
    scatter: F8
    """Sums of squares about the mean ``(b, 6)``: xx, xy, xz, yy, yz, zz."""
    updated: I4
    """Number of points when the cell was last updated for matching; 0: not valid yet."""
    centre: F8
    """Mean used for matching ``(b, 3)``."""
    root: F8
    """Square root ``(b, r, 3)`` of the information of a point's distance, which is ``rootᵀ root``; r = 1 if only
    surfaces constrain points, else 3."""
    seen: I8
    """Scan that last added points."""
    made: F8
    """Mean number of the scans that added its points."""
    around: I4
    """Valid cells among the 27 neighbours ``(b, 27)``."""
    n_around: I4
    """Number of these; -1: not looked up."""
    near: I1
    """Nearest cell of each cached cube ``(b, 64)``, as an index into ``around``."""
    used: I8
    """Number of blocks in use ``(1,)``."""


@njit(inline="always")
def _pack(x: float, y: float, z: float, inverse: float) -> Any:
    i = np.int64(np.floor(x * inverse)) + _HALF
    j = np.int64(np.floor(y * inverse)) + _HALF
    k = np.int64(np.floor(z * inverse)) + _HALF
    return (i << 42) | (j << 21) | k


@njit(inline="always")
def _find(c: Cells, key: Any) -> Any:
    mask = len(c.keys) - 1
    h = np.int64((np.uint64(key) * _MULTIPLIER) >> np.uint64(20)) & mask
    while True:
        at = c.keys[h]
        if at == key:
            return np.int64(c.slots[h])
        if at == -1:
            return np.int64(-1)
        h = (h + 1) & mask


@callee
def _put(c: Cells, key: Any) -> Any:
    """Block of a cube, created if it is new; -1 if there is no space."""
    mask = len(c.keys) - 1
    h = np.int64((np.uint64(key) * _MULTIPLIER) >> np.uint64(20)) & mask
    while True:
        at = c.keys[h]
        if at == key:
            return np.int64(c.slots[h])
        if at == -1:
            break
        h = (h + 1) & mask
    b = c.used[0]
    if b >= len(c.cube):
        return np.int64(-1)
    c.used[0] = b + 1
    c.keys[h], c.slots[h], c.cube[b] = key, b, key
    c.number[b], c.updated[b], c.n_around[b], c.seen[b] = 0, 0, -1, -1
    c.mean[b, :], c.made[b] = 0.0, 0.0
    c.scatter[b, :] = 0.0
    c.near[b, :] = UNKNOWN
    return np.int64(b)


@callee
def _enter(c: Cells, b: Any, size: float, new: bool) -> None:
    """A cell became valid or moved: update the cached cubes around it whose nearest cell it is now, or was."""
    key = c.cube[b]
    fine = size / FINE
    x, y, z = c.centre[b, 0], c.centre[b, 1], c.centre[b, 2]
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                cube = key + (np.int64(di) << 42) + (np.int64(dj) << 21) + dk
                at = _find(c, cube)
                if at < 0 or c.n_around[at] < 0:
                    continue
                own = 0
                while own < c.n_around[at] and c.around[at, own] != b:
                    own += 1
                if new:
                    c.around[at, own] = b
                    c.n_around[at] += 1
                x0 = (((cube >> 42) & _MASK) - _HALF) * size + 0.5 * fine
                y0 = (((cube >> 21) & _MASK) - _HALF) * size + 0.5 * fine
                z0 = ((cube & _MASK) - _HALF) * size + 0.5 * fine
                sub = 0
                for i in range(FINE):
                    for j in range(FINE):
                        for k in range(FINE):
                            known = c.near[at, sub]
                            if known == own:
                                c.near[at, sub] = UNKNOWN
                            elif known == NONE:
                                c.near[at, sub] = own
                            elif known >= 0:
                                u, v, w = x0 + i * fine, y0 + j * fine, z0 + k * fine
                                d = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
                                n = c.centre[c.around[at, known]]
                                if d < (n[0] - u) ** 2 + (n[1] - v) ** 2 + (n[2] - w) ** 2:
                                    c.near[at, sub] = own
                            sub += 1


@callee
def _eigen(S: F8, V: F8) -> None:
    """Eigenvalues of a symmetric 3 × 3 matrix onto its diagonal, eigenvectors into columns of V (Jacobi)."""
    V[:, :] = 0.0
    V[0, 0] = V[1, 1] = V[2, 2] = 1.0
    for _ in range(12):
        off = abs(S[0, 1]) + abs(S[0, 2]) + abs(S[1, 2])
        if off <= 1e-14 * (abs(S[0, 0]) + abs(S[1, 1]) + abs(S[2, 2])):
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if S[p, q] == 0.0:
                    continue
                theta = (S[q, q] - S[p, p]) / (2.0 * S[p, q])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                cos = 1.0 / np.sqrt(t * t + 1.0)
                sin = t * cos
                for k in range(3):
                    a, b = S[k, p], S[k, q]
                    S[k, p], S[k, q] = cos * a - sin * b, sin * a + cos * b
                for k in range(3):
                    a, b = S[p, k], S[q, k]
                    S[p, k], S[q, k] = cos * a - sin * b, sin * a + cos * b
                for k in range(3):
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = cos * a - sin * b, sin * a + cos * b


@callee
def _spread(c: Cells, b: Any, flat: float, S: F8, V: F8) -> tuple[int, float, float]:
    """Principal axes of the points of a cell: variances on the diagonal of S, directions in the columns of V.

    Returns
    -------
    k : int
        Index of the smallest.
    surface : float
        0 to 1: how flat the points are; 1 if the smallest variance is well below ``flat`` [m²].
    wide : float
        0 to 1: how far points spread in two directions; 0 for collinear points, such as one line of a scanner.
    """
    n, s = c.number[b], c.scatter[b]
    S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2] = s[0], s[1], s[2], s[3], s[4], s[5]
    S[1, 0], S[2, 0], S[2, 1] = s[1], s[2], s[4]
    for i in range(3):
        for j in range(3):
            S[i, j] /= n
    _eigen(S, V)
    k = 0
    for i in range(1, 3):
        if S[i, i] < S[k, k]:
            k = i
    second = min(S[(k + 1) % 3, (k + 1) % 3], S[(k + 2) % 3, (k + 2) % 3])
    return k, max(1.0 - S[k, k] / flat, 0.0), min(max(second / flat - 0.5, 0.0), 1.0)


@callee
def _tell(c: Cells, b: Any, how: tuple[float, float, bool], around: tuple[Cells, float]) -> None:
    """Update the cell used for matching from its points so far.

    A surface constrains points along its normal only: along the surface the mean depends on where the scans sampled it.
    Collinear points define no surface; if the wider cell around them is one and they lie in it, its normal is used. A
    cell thicker than a surface constrains by its full covariance, unless ``planes``.
    """
    size, least, planes = how
    wide, wide_size = around
    n, root = c.number[b], c.root[b]
    flat = (0.12 * size) ** 2
    S, V = np.empty((3, 3)), np.empty((3, 3))
    k, surface, spread = _spread(c, b, flat, S, V)
    root[:, :] = 0.0
    weight = surface * spread
    across, x, y, z, alone = max(S[k, k], 0.0), V[0, k], V[1, k], V[2, k], True
    if spread < 1.0 and wide_size > size:
        at = _find(wide, _pack(c.mean[b, 0], c.mean[b, 1], c.mean[b, 2], 1.0 / wide_size))
        if at >= 0 and wide.number[at] >= LEAST:
            S2, V2 = np.empty((3, 3)), np.empty((3, 3))
            j, surface2, spread2 = _spread(wide, at, flat, S2, V2)
            off = 0.0
            for i in range(3):
                off += V2[i, j] * (c.mean[b, i] - wide.mean[at, i])
            s, u, v, w = c.scatter[b], V2[0, j], V2[1, j], V2[2, j]
            own = u * u * s[0] + v * v * s[3] + w * w * s[5] + 2.0 * (u * v * s[1] + u * w * s[2] + v * w * s[4])
            own = max(own / n, 0.0)
            share = surface2 * spread2 * max(1.0 - (own + off * off) / flat, 0.0)
            if share > weight:
                weight, across, x, y, z, alone = share, own, u, v, w, False
    if alone and not planes:
        rest = max(1.0 - 2.0 * surface, 0.0)
        for q in range(3):
            deep = np.sqrt((weight + rest if q == k else rest) / (max(S[q, q], 0.0) + least * least))
            for i in range(3):
                root[q, i] = deep * V[i, q]
    else:
        deep = np.sqrt(weight / (across + least * least))
        root[0, 0], root[0, 1], root[0, 2] = deep * x, deep * y, deep * z
    moved = 0.0
    for i in range(3):
        moved = max(moved, abs(c.mean[b, i] - c.centre[b, i]))
    new = c.updated[b] == 0
    c.updated[b] = n
    for i in range(3):
        c.centre[b, i] = c.mean[b, i]
    if new or moved > 0.25 * size / FINE:
        _enter(c, b, size, new)


@njit(nogil=True)
def add_points(c: Cells, points: F8, scan: int, how: tuple[float, float, bool], around: tuple[Cells, float]) -> int:
    """Add points, world frame, to their cells; returns how many found no space.

    Parameters
    ----------
    how : (float, float, bool)
        Edge of a cell [m]; σ added to that of the cell [m]; only surfaces constrain points.
    around : (Cells, float)
        A level of wider cells that already contains the points, and its edge [m]; 0: none.
    """
    lost = 0
    inverse = 1.0 / how[0]
    touched = np.empty(len(points), np.int64)
    m = 0
    for p in range(len(points)):
        b = _put(c, _pack(points[p, 0], points[p, 1], points[p, 2], inverse))
        if b < 0:
            lost += 1
            continue
        if c.seen[b] != scan:
            c.seen[b] = scan
            touched[m] = b
            m += 1
        if c.number[b] >= FULL:
            continue
        c.number[b] += 1
        n = c.number[b]
        c.made[b] += (scan - c.made[b]) / n
        dx, dy, dz = points[p, 0] - c.mean[b, 0], points[p, 1] - c.mean[b, 1], points[p, 2] - c.mean[b, 2]
        c.mean[b, 0] += dx / n
        c.mean[b, 1] += dy / n
        c.mean[b, 2] += dz / n
        ex, ey, ez = points[p, 0] - c.mean[b, 0], points[p, 1] - c.mean[b, 1], points[p, 2] - c.mean[b, 2]
        s = c.scatter[b]
        s[0] += dx * ex
        s[1] += dx * ey
        s[2] += dx * ez
        s[3] += dy * ey
        s[4] += dy * ez
        s[5] += dz * ez
    for k in range(m):
        b = touched[k]
        n = c.number[b]
        if n >= LEAST and n >= c.updated[b] + max(1, c.updated[b] // 4):
            _tell(c, b, how, around)
    return lost


@njit(nogil=True)
def enter_keys(keys: I8, slots: I4, cube: I8) -> None:
    """Enter blocks into an empty hash table."""
    for b in range(len(cube)):
        h = np.int64((np.uint64(cube[b]) * _MULTIPLIER) >> np.uint64(20)) & (len(keys) - 1)
        while keys[h] != -1:
            h = (h + 1) & (len(keys) - 1)
        keys[h], slots[h] = cube[b], b


@callee
def _fill(c: Cells, b: Any, key: Any, sub: Any, size: float) -> Any:
    """Find and store the cell nearest to the centre of a cached cube."""
    if c.n_around[b] < 0:
        n = 0
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    at = _find(c, key + (np.int64(di) << 42) + (np.int64(dj) << 21) + dk)
                    if at >= 0 and c.updated[at] > 0:
                        c.around[b, n] = at
                        n += 1
        c.n_around[b] = n
    fine = size / FINE
    x = (((key >> 42) & _MASK) - _HALF) * size + (sub // (FINE * FINE) + 0.5) * fine
    y = (((key >> 21) & _MASK) - _HALF) * size + ((sub // FINE) % FINE + 0.5) * fine
    z = ((key & _MASK) - _HALF) * size + (sub % FINE + 0.5) * fine
    best, nearest, c.near[b, sub] = np.int64(NONE), np.inf, NONE
    for k in range(c.n_around[b]):
        at = c.around[b, k]
        d = (c.centre[at, 0] - x) ** 2 + (c.centre[at, 1] - y) ** 2 + (c.centre[at, 2] - z) ** 2
        if d < nearest:
            nearest, best, c.near[b, sub] = d, np.int64(at), k
    return best


@njit(inline="always")
def _nearest(c: Cells, x: float, y: float, z: float, size: float) -> Any:
    """Cell nearest to the centre of the cached cube of a point; negative: none."""
    inverse = 1.0 / size
    key = _pack(x, y, z, inverse)
    b = _find(c, key)
    if b < 0:
        b = _put(c, key)
        if b < 0:
            return np.int64(NONE)
    fine = FINE * inverse
    i = np.int64(np.floor(x * fine)) & (FINE - 1)
    j = np.int64(np.floor(y * fine)) & (FINE - 1)
    k = np.int64(np.floor(z * fine)) & (FINE - 1)
    sub = (i * FINE + j) * FINE + k
    at = c.near[b, sub]
    if at == UNKNOWN:
        return _fill(c, b, key, sub, size)
    return np.int64(c.around[b, at]) if at >= 0 else np.int64(NONE)


@njit(nogil=True)
def nearest_cells(c: Cells, points: F8, size: float, out: I8) -> None:
    """The cell of each point; negative: none."""
    for p in range(len(points)):
        out[p] = _nearest(c, points[p, 0], points[p, 1], points[p, 2], size)


@njit(nogil=True)
def score_rotations(c: Cells, points: F8, R: F8, t: F8, size: float, sigma: float, out: F8) -> None:
    """Add to ``out`` the sum of ``exp(-d² / 2σ²)`` over points, for each rotation ``(m, 3, 3)`` about a position ``t``.

    Point by point: successive rotations move one point into cubes that are near each other, also in memory.
    """
    k = -0.5 / (sigma * sigma)
    for p in range(len(points)):
        a, b, e = points[p, 0], points[p, 1], points[p, 2]
        for r in range(len(R)):
            M = R[r]
            x = M[0, 0] * a + M[0, 1] * b + M[0, 2] * e + t[0]
            y = M[1, 0] * a + M[1, 1] * b + M[1, 2] * e + t[1]
            z = M[2, 0] * a + M[2, 1] * b + M[2, 2] * e + t[2]
            at = _nearest(c, x, y, z, size)
            if at >= 0:
                d = (c.centre[at, 0] - x) ** 2 + (c.centre[at, 1] - y) ** 2 + (c.centre[at, 2] - z) ** 2
                out[r] += np.exp(k * d)


@callee
def _normal_equations(
    c: Cells,
    points: F8,
    pose: tuple[F8, F8],
    size: float,
    scale: float,
    out: tuple[F8, F8, F8],
    notes: tuple[I8, I8],
) -> None:
    """Gauss–Newton normal equations of points on cells, with Geman–McClure weights.

    Parameters
    ----------
    points : (n, 3)
        Body frame.
    pose : (3, 3), (3,)
        Rotation and position of the body.
    scale : float
        Mahalanobis distance at which the weight is 1/4.
    out : (6, 6), (6,), (13,)
        H and g, right tangent, rotation first, ``H δ = -g``; then the sum of weights; number of points with an
        informative cell; weighted sum of squared Mahalanobis distances; the sum of weights times traces of information,
        of these times the points (3), and times their squares (6: xx, xy, xz, yy, yz, zz).
    notes : (n,), (n,)
        The last cached cube of each point, and its nearest cell.
    """
    (R, t), (H, g, sums), (asked, found) = pose, out, notes
    fine = FINE / size
    H[:, :] = 0.0
    g[:] = 0.0
    sums[:] = 0.0
    inverse = 1.0 / (scale * scale)
    rows = c.root.shape[1]
    r = np.empty(3)
    J = np.empty(6)
    for p in range(len(points)):
        a, b, e = points[p, 0], points[p, 1], points[p, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * e + t[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * e + t[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * e + t[2]
        cube = _pack(x, y, z, fine)
        if cube != asked[p]:
            asked[p], found[p] = cube, _nearest(c, x, y, z, size)
        at = found[p]
        if at < 0:
            continue
        x -= c.centre[at, 0]
        y -= c.centre[at, 1]
        z -= c.centre[at, 2]
        W = c.root[at]
        m, trace = 0.0, 0.0
        for k in range(rows):
            r[k] = W[k, 0] * x + W[k, 1] * y + W[k, 2] * z
            m += r[k] * r[k]
            trace += W[k, 0] * W[k, 0] + W[k, 1] * W[k, 1] + W[k, 2] * W[k, 2]
        if trace <= 0.0:
            continue
        w = 1.0 / (1.0 + m * inverse)
        w *= w
        sums[0] += w
        sums[1] += 1.0
        sums[2] += w * m
        trace *= w
        sums[3] += trace
        sums[4] += trace * a
        sums[5] += trace * b
        sums[6] += trace * e
        sums[7] += trace * a * a
        sums[8] += trace * a * b
        sums[9] += trace * a * e
        sums[10] += trace * b * b
        sums[11] += trace * b * e
        sums[12] += trace * e * e
        for k in range(rows):
            # the row in the body frame; the derivative of its residual is [p × u, u]
            ux = R[0, 0] * W[k, 0] + R[1, 0] * W[k, 1] + R[2, 0] * W[k, 2]
            uy = R[0, 1] * W[k, 0] + R[1, 1] * W[k, 1] + R[2, 1] * W[k, 2]
            uz = R[0, 2] * W[k, 0] + R[1, 2] * W[k, 1] + R[2, 2] * W[k, 2]
            J[0], J[1], J[2] = b * uz - e * uy, e * ux - a * uz, a * uy - b * ux
            J[3], J[4], J[5] = ux, uy, uz
            for i in range(6):
                v = w * J[i]
                g[i] += v * r[k]
                for j in range(i, 6):
                    H[i, j] += v * J[j]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]


@callee
def _rotation(w: F8, R: F8, V: F8) -> None:
    """Rotation matrix of a rotation vector, and its left Jacobian."""
    x = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    if x < 1e-4:
        a, b, d = 1.0 - x * x / 6.0, 0.5 - x * x / 24.0, 1.0 / 6.0 - x * x / 120.0
    else:
        a, b, d = np.sin(x) / x, (1.0 - np.cos(x)) / (x * x), (x - np.sin(x)) / (x * x * x)
    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -w[2], w[1], -w[0]
    K[1, 0], K[2, 0], K[2, 1] = w[2], -w[1], w[0]
    for i in range(3):
        for j in range(3):
            square = K[i, 0] * K[0, j] + K[i, 1] * K[1, j] + K[i, 2] * K[2, j]
            one = 1.0 if i == j else 0.0
            R[i, j] = one + a * K[i, j] + b * square
            V[i, j] = one + b * K[i, j] + d * square


@callee
def _log(R: F8, t: F8, out: F8) -> None:
    """Logarithm (6,) of a motion that rotates by less than π."""
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    k = 1.0 + angle * angle / 6.0 if angle < 1e-4 else angle / sine
    w = out[:3]
    w[0], w[1], w[2] = k * x, k * y, k * z
    # inverse of the left Jacobian: t - w × t / 2 + q w × (w × t)
    q = 1.0 / 12.0 if angle < 1e-3 else (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / (angle * angle)
    a = w[1] * t[2] - w[2] * t[1], w[2] * t[0] - w[0] * t[2], w[0] * t[1] - w[1] * t[0]
    out[3] = t[0] - 0.5 * a[0] + q * (w[1] * a[2] - w[2] * a[1])
    out[4] = t[1] - 0.5 * a[1] + q * (w[2] * a[0] - w[0] * a[2])
    out[5] = t[2] - 0.5 * a[2] + q * (w[0] * a[1] - w[1] * a[0])


@callee
def _solve(A: F8, x: F8) -> None:
    """Solve in place of x with a positive definite matrix (6, 6), which is overwritten: L D Lᵀ, without a library."""
    for j in range(6):
        for i in range(j + 1, 6):
            k = A[i, j] / A[j, j]
            for q in range(j + 1, i + 1):
                A[i, q] -= k * A[q, j]
            x[i] -= k * x[j]
        for i in range(j + 1, 6):
            A[i, j] /= A[j, j]
    for i in range(5, -1, -1):
        x[i] /= A[i, i]
        for j in range(i + 1, 6):
            x[i] -= A[j, i] * x[j]


@njit(nogil=True)
def descend_pose(
    c: Cells,
    points: F8,
    pose: tuple[F8, F8],
    start: tuple[F8, F8, F8],
    size: float,
    scale: float,
    stop: tuple[float, float, int],
    out: tuple[F8, F8, F8],
) -> int:
    """Gauss–Newton steps of a pose until convergence; returns their number.

    Parameters
    ----------
    pose : (3, 3), (3,)
        Updated in place.
    start : (3, 3), (3,), (6, 6)
        Prior pose and its information, right tangent.
    stop : (float, float, int)
        Convergence threshold of a step [rad], [m]; most steps.
    out : (6, 6), (6,), (13,)
        As of `_normal_equations`, before the last step.

    Returns
    -------
    steps : int
        Negative, ``-steps - 1``: no space for another step.
    """
    (R, t), (H, g, _) = pose, out
    start_R, start_t, prior = start
    notes = np.full(len(points), -1, np.int64), np.empty(len(points), np.int64)
    turn, left = np.empty((3, 3)), np.empty((3, 3))
    off, d, A = np.empty(6), np.empty(6), np.empty((6, 6))
    dR, dt = np.empty((3, 3)), np.empty(3)
    for step in range(stop[2]):
        if c.used[0] + len(points) > len(c.cube):
            return -step - 1
        _normal_equations(c, points, pose, size, scale, out, notes)
        for i in range(3):
            dt[i] = 0.0
            for j in range(3):
                dt[i] += start_R[j, i] * (t[j] - start_t[j])
                dR[i, j] = start_R[0, i] * R[0, j] + start_R[1, i] * R[1, j] + start_R[2, i] * R[2, j]
        _log(dR, dt, off)
        for i in range(6):
            d[i] = -g[i]
            for j in range(6):
                A[i, j] = H[i, j] + prior[i, j]
                d[i] -= prior[i, j] * off[j]
        _solve(A, d)
        # longer steps are unreliable and are cut
        for part, least in ((3, 0.5 * size), (0, 0.2)):
            length = np.sqrt(d[part] ** 2 + d[part + 1] ** 2 + d[part + 2] ** 2)
            if length > least:
                for i in range(6):
                    d[i] *= least / length
        _rotation(d[:3], turn, left)
        for i in range(3):
            dt[i] = left[i, 0] * d[3] + left[i, 1] * d[4] + left[i, 2] * d[5]
        for i in range(3):
            t[i] += R[i, 0] * dt[0] + R[i, 1] * dt[1] + R[i, 2] * dt[2]
            for j in range(3):
                dR[i, j] = R[i, 0] * turn[0, j] + R[i, 1] * turn[1, j] + R[i, 2] * turn[2, j]
        for i in range(3):
            for j in range(3):
                R[i, j] = dR[i, j]
        turned = np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
        if turned < stop[0] and np.sqrt(d[3] ** 2 + d[4] ** 2 + d[5] ** 2) < stop[1]:
            return step + 1
    return stop[2]


@njit(nogil=True)
def deskew_points(points: F8, ages: F8, twist: F8, dt: float, most: float, out: F8) -> None:
    """Points in the frame of the body at the stamp, for a uniform motion ``Exp(twist)`` in the ``dt`` [s] before it.

    Ages [s] are limited to ``most`` multiples of ``dt``.
    """
    w, v = twist[:3], twist[3:]
    turn = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    across = np.array([w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2], w[0] * v[1] - w[1] * v[0]])
    along = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    for p in range(len(points)):
        s = -min(max(ages[p] / dt, -most), most)
        x = s * turn
        # Exp(s twist): sine, 1 - cosine and x - sine, divided by powers of the rate
        if abs(x) < 1e-3:
            a, b = s * (1.0 - x * x / 6.0), s * s * (0.5 - x * x / 24.0)
            d = s * s * s * (1.0 / 6.0 - x * x / 120.0)
        else:
            sine, half = np.sin(x), np.sin(0.5 * x)
            a, b, d = sine / turn, 2.0 * half * half / (turn * turn), (x - sine) / (turn * turn * turn)
        i, j, k = points[p]
        dot = w[0] * i + w[1] * j + w[2] * k
        for q in range(3):
            m, n = (q + 1) % 3, (q + 2) % 3
            cross = w[m] * points[p, n] - w[n] * points[p, m]
            # w × (w × p) = w (w · p) - p w²
            turned = points[p, q] + a * cross + b * (w[q] * dot - points[p, q] * turn * turn)
            out[p, q] = turned + s * v[q] + b * across[q] + d * (w[q] * along - v[q] * turn * turn)


@njit(nogil=True)
def information_by_slot(
    c: Cells, points: F8, pose: tuple[F8, F8], scale: float, cells: tuple[I8, I8, I8], out: tuple[F8, F8, F8]
) -> None:
    """Gauss–Newton Hessian by the scans that made the cells, and the covariance of the gradient.

    Parameters
    ----------
    cells : (n,), (n,), (n,)
        Cell of each point, negative: none; rows of the points ordered by it; slot of that cell.
    out : (s, 6, 6), (6, 6), (c, 6)
        H by slot, right tangent; covariance M of the gradient for errors common to all points of a cell, with the
        cell's covariance; gradients G of c parts of space, cubes of 8 cells along an edge (by hash, some share a part).
    """
    (R, t), (H, M, G) = pose, out
    H[:, :, :] = 0.0
    M[:, :] = 0.0
    G[:, :] = 0.0
    at, order, slots = cells
    n = len(points)
    inverse = 1.0 / (scale * scale)
    rows = c.root.shape[1]
    r = np.empty(3)
    J, S, U = np.empty((3, 6)), np.empty((3, 6)), np.empty((3, 3))
    k = 0
    while k < n:
        cell = at[order[k]]
        if cell < 0:
            k += 1
            continue
        slot = slots[order[k]]
        W = c.root[cell]
        for q in range(rows):
            for i in range(3):
                U[q, i] = W[q, 0] * R[0, i] + W[q, 1] * R[1, i] + W[q, 2] * R[2, i]
        S[:, :] = 0.0
        # blocks of 8 × 8 × 8 cells
        block = (
            ((c.cube[cell] >> 45) << 42) | (((c.cube[cell] >> 24) & (_MASK >> 3)) << 21) | ((c.cube[cell] & _MASK) >> 3)
        )
        part = np.int64((np.uint64(block) * _MULTIPLIER) >> np.uint64(20)) % len(G)
        while k < n and at[order[k]] == cell:
            p = order[k]
            k += 1
            a, b, e = points[p, 0], points[p, 1], points[p, 2]
            x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * e + t[0] - c.centre[cell, 0]
            y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * e + t[1] - c.centre[cell, 1]
            z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * e + t[2] - c.centre[cell, 2]
            m = 0.0
            for q in range(rows):
                r[q] = W[q, 0] * x + W[q, 1] * y + W[q, 2] * z
                m += r[q] * r[q]
            w = 1.0 / (1.0 + m * inverse)
            w *= w
            for q in range(rows):
                ux, uy, uz = U[q, 0], U[q, 1], U[q, 2]
                J[q, 0], J[q, 1], J[q, 2] = b * uz - e * uy, e * ux - a * uz, a * uy - b * ux
                J[q, 3], J[q, 4], J[q, 5] = ux, uy, uz
                for i in range(6):
                    v = w * J[q, i]
                    S[q, i] += v
                    G[part, i] += v * r[q]
                    for j in range(6):
                        H[slot, i, j] += v * J[q, j]
        for q in range(rows):
            for i in range(6):
                for j in range(6):
                    M[i, j] += S[q, i] * S[q, j]


@njit(nogil=True)
def thin_kernel(points: F8, size: float, near: float, far: float, out: I8) -> int:
    """Rows, in order, of the first point in each cube, for squared ranges in (near, far); returns their number."""
    bits = 4
    while (1 << bits) < 2 * len(points):
        bits += 1
    mask = (1 << bits) - 1
    table = np.full(1 << bits, -1, np.int64)
    inverse, n = 1.0 / size, 0
    for p in range(len(points)):
        r2 = points[p, 0] ** 2 + points[p, 1] ** 2 + points[p, 2] ** 2
        if not near < r2 < far:
            continue
        key = _pack(points[p, 0], points[p, 1], points[p, 2], inverse)
        h = np.int64((np.uint64(key) * _MULTIPLIER) >> np.uint64(20)) & mask
        while table[h] != -1 and table[h] != key:
            h = (h + 1) & mask
        if table[h] == -1:
            table[h] = key
            out[n] = p
            n += 1
    return n
