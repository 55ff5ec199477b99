"""Gaussian cells of a point map with a cached nearest neighbour (urban GraphSLAM, equations C2).

A level divides space into cubes. A cube holds the Gaussian of the points in it, and a grid of 4 × 4 × 4 smaller cubes,
in each of which the nearest cell is noted when it is first asked for. Asking again is one probe of a hash table. A cell
that begins to count, or whose centre moves, is compared with what is noted around it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

F8 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int64]
I4 = npt.NDArray[np.int32]

FINE = 4
"""Cached cubes along an edge of a cell."""
LEAST = 5
"""Points from which on a cell counts."""
FULL = 400
"""Points after which a cell learns no more."""
UNKNOWN, NONE = -1, -2
"""Of a cached cube: not asked for yet; no cell near it."""
_HALF = 1 << 20
_MASK = (1 << 21) - 1
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


class Cells(NamedTuple):
    """One level, as arrays. Blocks are cubes that hold points, or were asked for."""

    keys: I8
    """Hash table ``(h,)``: packed cube, -1 where free."""
    slots: I4
    """… and its block."""
    cube: I8
    """Packed cube of each block ``(b,)``."""
    number: I4
    """Points in it."""
    mean: F8
    """Of the points so far ``(b, 3)``."""
    scatter: F8
    """Sums of squares about it ``(b, 6)``: xx, xy, xz, yy, yz, zz."""
    told: I4
    """Number of points in what is matched to; 0: the cell does not count yet."""
    centre: F8
    """What is matched to ``(b, 3)``."""
    information: F8
    """Inverse covariance of a point's distance to it ``(b, 6)``."""
    seen: I8
    """Scan that last put points into it."""
    made: F8
    """Mean number of the scans whose points it holds."""
    around: I4
    """Cells that count among the 27 ``(b, 27)``."""
    n_around: I4
    """… and how many; -1: not looked up."""
    near: I4
    """The nearest cell of each cached cube ``(b, 64)``."""
    used: I8
    """``(1,)``: blocks in use."""


@nb.njit(cache=True, inline="always")
def _pack(x: float, y: float, z: float, inverse: float) -> Any:
    i = np.int64(np.floor(x * inverse)) + _HALF
    j = np.int64(np.floor(y * inverse)) + _HALF
    k = np.int64(np.floor(z * inverse)) + _HALF
    return (i << 42) | (j << 21) | k


@nb.njit(cache=True, inline="always")
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


@nb.njit(cache=True)
def _put(c: Cells, key: Any) -> Any:
    """The block of a cube, made if it is new; -1 where there is no room."""
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
    c.number[b], c.told[b], c.n_around[b], c.seen[b] = 0, 0, -1, -1
    c.mean[b, :], c.made[b] = 0.0, 0.0
    c.scatter[b, :] = 0.0
    c.near[b, :] = UNKNOWN
    return np.int64(b)


@nb.njit(cache=True)
def _enter(c: Cells, b: Any, size: float, new: bool) -> None:
    """A cell begins to count, or moved: cached cubes around it whose nearest it is now, or was, learn of it."""
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
                if new:
                    c.around[at, c.n_around[at]] = b
                    c.n_around[at] += 1
                x0 = (((cube >> 42) & _MASK) - _HALF) * size + 0.5 * fine
                y0 = (((cube >> 21) & _MASK) - _HALF) * size + 0.5 * fine
                z0 = ((cube & _MASK) - _HALF) * size + 0.5 * fine
                sub = 0
                for i in range(FINE):
                    for j in range(FINE):
                        for k in range(FINE):
                            known = c.near[at, sub]
                            if known == b:
                                c.near[at, sub] = UNKNOWN
                            elif known == NONE:
                                c.near[at, sub] = b
                            elif known >= 0:
                                u, v, w = x0 + i * fine, y0 + j * fine, z0 + k * fine
                                d = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
                                n = c.centre[known]
                                if d < (n[0] - u) ** 2 + (n[1] - v) ** 2 + (n[2] - w) ** 2:
                                    c.near[at, sub] = b
                            sub += 1


@nb.njit(cache=True)
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


@nb.njit(cache=True)
def _tell(c: Cells, b: Any, size: float, least: float, planes: bool) -> None:
    """Take the points so far for the cell that is matched to."""
    n = c.number[b]
    S = np.empty((3, 3))
    s = c.scatter[b]
    S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2] = s[0], s[1], s[2], s[3], s[4], s[5]
    S[1, 0], S[2, 0], S[2, 1] = s[1], s[2], s[4]
    V = np.empty((3, 3))
    _eigen(S, V)
    A = np.zeros((3, 3))
    if planes:
        # Only across a surface do points hold: along it a cell's centre is where the scans happened to fall. Points in
        # a row, as one line of a scanner leaves them, tell of no surface.
        k = 0
        for i in range(1, 3):
            if S[i, i] < S[k, k]:
                k = i
        across = max(S[k, k] / n, 0.0)
        second = min(S[(k + 1) % 3, (k + 1) % 3], S[(k + 2) % 3, (k + 2) % 3]) / n
        flat = (0.12 * size) ** 2
        weight = max(1.0 - across / flat, 0.0) * min(max(second / flat - 0.5, 0.0), 1.0) / (across + least * least)
        for i in range(3):
            for j in range(3):
                A[i, j] = weight * V[i, k] * V[j, k]
    else:
        for k in range(3):
            weight = 1.0 / (max(S[k, k] / n, 0.0) + least * least)
            for i in range(3):
                for j in range(3):
                    A[i, j] += weight * V[i, k] * V[j, k]
    I = c.information[b]
    I[0], I[1], I[2], I[3], I[4], I[5] = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    moved = 0.0
    for i in range(3):
        moved = max(moved, abs(c.mean[b, i] - c.centre[b, i]))
    new = c.told[b] == 0
    c.told[b] = n
    c.centre[b, :] = c.mean[b]
    if new or moved > 0.25 * size / FINE:
        _enter(c, b, size, new)


@nb.njit(cache=True, nogil=True)
def add_points(c: Cells, points: F8, scan: int, size: float, least: float, planes: bool) -> int:
    """Put points of the world into their cells; how many found no room."""
    lost = 0
    inverse = 1.0 / size
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
        if n >= LEAST and n >= c.told[b] + max(1, c.told[b] // 4):
            _tell(c, b, size, least, planes)
    return lost


@nb.njit(cache=True, nogil=True)
def keep_since(c: Cells, out: Cells, scan: int) -> None:
    """Copy the cells that were seen since a scan into an empty level."""
    for b in range(c.used[0]):
        if c.seen[b] < scan or c.number[b] == 0:
            continue
        k = _put(out, c.cube[b])
        out.number[k], out.told[k], out.seen[k], out.made[k] = c.number[b], c.told[b], c.seen[b], c.made[b]
        out.mean[k], out.scatter[k], out.centre[k], out.information[k] = (
            c.mean[b],
            c.scatter[b],
            c.centre[b],
            c.information[b],
        )


@nb.njit(cache=True)
def _fill(c: Cells, b: Any, key: Any, sub: Any, size: float) -> Any:
    """Note the cell nearest to the middle of a cached cube."""
    if c.n_around[b] < 0:
        n = 0
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    at = _find(c, key + (np.int64(di) << 42) + (np.int64(dj) << 21) + dk)
                    if at >= 0 and c.told[at] > 0:
                        c.around[b, n] = at
                        n += 1
        c.n_around[b] = n
    fine = size / FINE
    x = (((key >> 42) & _MASK) - _HALF) * size + (sub // (FINE * FINE) + 0.5) * fine
    y = (((key >> 21) & _MASK) - _HALF) * size + ((sub // FINE) % FINE + 0.5) * fine
    z = ((key & _MASK) - _HALF) * size + (sub % FINE + 0.5) * fine
    best, nearest = np.int64(NONE), np.inf
    for k in range(c.n_around[b]):
        at = c.around[b, k]
        d = (c.centre[at, 0] - x) ** 2 + (c.centre[at, 1] - y) ** 2 + (c.centre[at, 2] - z) ** 2
        if d < nearest:
            nearest, best = d, np.int64(at)
    c.near[b, sub] = best
    return best


@nb.njit(cache=True, inline="always")
def _nearest(c: Cells, x: float, y: float, z: float, size: float) -> Any:
    """The cell nearest to a point, but for less than an edge of a cached cube times √3; negative: none."""
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
    at = np.int64(c.near[b, sub])
    if at == UNKNOWN:
        at = _fill(c, b, key, sub, size)
    return at


@nb.njit(cache=True, nogil=True)
def nearest_cells(c: Cells, points: F8, size: float, out: I8) -> None:
    """The cell of each point; negative: none."""
    for p in range(len(points)):
        out[p] = _nearest(c, points[p, 0], points[p, 1], points[p, 2], size)


@nb.njit(cache=True, nogil=True)
def score_rotations(c: Cells, points: F8, R: F8, t: F8, size: float, sigma: float, out: F8) -> None:
    """Mean of ``exp(-d² / 2σ²)`` over points, at each rotation ``(m, 3, 3)`` about a place ``t``."""
    k = -0.5 / (sigma * sigma)
    for r in range(len(R)):
        total = 0.0
        M = R[r]
        for p in range(len(points)):
            x = M[0, 0] * points[p, 0] + M[0, 1] * points[p, 1] + M[0, 2] * points[p, 2] + t[0]
            y = M[1, 0] * points[p, 0] + M[1, 1] * points[p, 1] + M[1, 2] * points[p, 2] + t[1]
            z = M[2, 0] * points[p, 0] + M[2, 1] * points[p, 1] + M[2, 2] * points[p, 2] + t[2]
            at = _nearest(c, x, y, z, size)
            if at >= 0:
                d = (c.centre[at, 0] - x) ** 2 + (c.centre[at, 1] - y) ** 2 + (c.centre[at, 2] - z) ** 2
                total += np.exp(k * d)
        out[r] = total / max(len(points), 1)


@nb.njit(cache=True, nogil=True)
def normal_equations(
    c: Cells, points: F8, pose: tuple[F8, F8], size: float, scale: float, H: F8, g: F8, told: F8
) -> None:
    """Gauss–Newton's normal equations of points on cells, weights by Geman and McClure.

    Parameters
    ----------
    points : (n, 3)
        Frame of the body.
    pose : (3, 3), (3,)
        Rotation and position of the body.
    scale : float
        Mahalanobis distance at which a point's pull is greatest but for a factor.
    H, g : (6, 6), (6,)
        Out: right tangent, rotation first; ``H δ = -g``.
    told : (13,)
        Out: sum of weights; points with a cell that says something; weighted sum of squared Mahalanobis distances;
        then the sum of weights times traces of information, of these times the points (3), and times their squares
        (6: xx, xy, xz, yy, yz, zz).
    """
    R, t = pose
    H[:, :] = 0.0
    g[:] = 0.0
    told[:] = 0.0
    inverse = 1.0 / (scale * scale)
    A = np.empty((3, 3))
    B = np.empty((3, 3))
    J = np.empty((3, 6))
    Q = np.empty((3, 6))
    for p in range(len(points)):
        a, b, e = points[p, 0], points[p, 1], points[p, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * e + t[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * e + t[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * e + t[2]
        at = _nearest(c, x, y, z, size)
        if at < 0:
            continue
        rx, ry, rz = x - c.centre[at, 0], y - c.centre[at, 1], z - c.centre[at, 2]
        I = c.information[at]
        vx = I[0] * rx + I[1] * ry + I[2] * rz
        vy = I[1] * rx + I[3] * ry + I[4] * rz
        vz = I[2] * rx + I[4] * ry + I[5] * rz
        m = rx * vx + ry * vy + rz * vz
        w = 1.0 / (1.0 + m * inverse)
        w *= w
        trace = I[0] + I[3] + I[5]
        if trace <= 0.0:
            continue
        told[0] += w
        told[1] += 1.0
        told[2] += w * m
        trace *= w
        told[3] += trace
        told[4] += trace * a
        told[5] += trace * b
        told[6] += trace * e
        told[7] += trace * a * a
        told[8] += trace * a * b
        told[9] += trace * a * e
        told[10] += trace * b * b
        told[11] += trace * b * e
        told[12] += trace * e * e
        # world information in the body's axes
        A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2] = I[0], I[1], I[2], I[3], I[4], I[5]
        A[1, 0], A[2, 0], A[2, 1] = I[1], I[2], I[4]
        for i in range(3):
            for j in range(3):
                B[i, j] = A[i, 0] * R[0, j] + A[i, 1] * R[1, j] + A[i, 2] * R[2, j]
        # J = [-[p]x, I]; Q = Rᵀ A R J
        J[0, 0], J[0, 1], J[0, 2] = 0.0, e, -b
        J[1, 0], J[1, 1], J[1, 2] = -e, 0.0, a
        J[2, 0], J[2, 1], J[2, 2] = b, -a, 0.0
        for i in range(3):
            n0 = R[0, i] * B[0, 0] + R[1, i] * B[1, 0] + R[2, i] * B[2, 0]
            n1 = R[0, i] * B[0, 1] + R[1, i] * B[1, 1] + R[2, i] * B[2, 1]
            n2 = R[0, i] * B[0, 2] + R[1, i] * B[1, 2] + R[2, i] * B[2, 2]
            for j in range(3):
                Q[i, j] = w * (n0 * J[0, j] + n1 * J[1, j] + n2 * J[2, j])
            Q[i, 3], Q[i, 4], Q[i, 5] = w * n0, w * n1, w * n2
        ux = w * (R[0, 0] * vx + R[1, 0] * vy + R[2, 0] * vz)
        uy = w * (R[0, 1] * vx + R[1, 1] * vy + R[2, 1] * vz)
        uz = w * (R[0, 2] * vx + R[1, 2] * vy + R[2, 2] * vz)
        g[0] += b * uz - e * uy
        g[1] += e * ux - a * uz
        g[2] += a * uy - b * ux
        g[3] += ux
        g[4] += uy
        g[5] += uz
        for i in range(3):
            for j in range(6):
                H[i, j] += J[0, i] * Q[0, j] + J[1, i] * Q[1, j] + J[2, i] * Q[2, j]
        for i in range(3):
            for j in range(6):
                H[3 + i, j] += Q[i, j]


@nb.njit(cache=True, nogil=True)
def information_by_slot(
    c: Cells, points: F8, pose: tuple[F8, F8], size: float, scale: float, ends: F8, out: tuple[F8, F8, F8]
) -> None:
    """Gauss–Newton's Hessian by the scans that made the cells, and the spread of its gradient.

    Parameters
    ----------
    ends : (s,)
        Rising; a cell belongs to the first slot whose end is not before the mean of the scans that made it.
    out : (s, 6, 6), (6, 6), (c, 6)
        H by slot, right tangent; covariance M of the gradient where points of one cell err together and each by what
        the cell says; gradients G of c parts of space, cubes of eight cells along an edge (some share a part).
    """
    (R, t), (H, M, G) = pose, out
    H[:, :, :] = 0.0
    M[:, :] = 0.0
    G[:, :] = 0.0
    n = len(points)
    at = np.empty(n, np.int64)
    order = np.empty(n, np.int64)
    for p in range(n):
        a, b, e = points[p, 0], points[p, 1], points[p, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * e + t[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * e + t[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * e + t[2]
        at[p] = _nearest(c, x, y, z, size)
    order[:] = np.argsort(at)
    inverse = 1.0 / (scale * scale)
    A = np.empty((3, 3))
    J = np.zeros((3, 6))
    J[0, 3] = J[1, 4] = J[2, 5] = 1.0
    S = np.zeros((3, 6))
    u = np.zeros(3)
    k = 0
    while k < n:
        cell = at[order[k]]
        if cell < 0:
            k += 1
            continue
        slot = min(np.searchsorted(ends, c.made[cell]), len(ends) - 1)
        I = c.information[cell]
        A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2] = I[0], I[1], I[2], I[3], I[4], I[5]
        A[1, 0], A[2, 0], A[2, 1] = I[1], I[2], I[4]
        B = R.T @ A @ R
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
            rx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * e + t[0] - c.centre[cell, 0]
            ry = R[1, 0] * a + R[1, 1] * b + R[1, 2] * e + t[1] - c.centre[cell, 1]
            rz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * e + t[2] - c.centre[cell, 2]
            m = rx * rx * I[0] + ry * ry * I[3] + rz * rz * I[5]
            m += 2.0 * (rx * ry * I[1] + rx * rz * I[2] + ry * rz * I[4])
            w = 1.0 / (1.0 + m * inverse)
            w *= w
            J[0, 1], J[0, 2], J[1, 2] = e, -b, a
            J[1, 0], J[2, 0], J[2, 1] = -e, b, -a
            H[slot] += w * (J.T @ (B @ J))
            u[0] = w * (I[0] * rx + I[1] * ry + I[2] * rz)
            u[1] = w * (I[1] * rx + I[3] * ry + I[4] * rz)
            u[2] = w * (I[2] * rx + I[4] * ry + I[5] * rz)
            G[part] += J.T @ (R.T @ u)
            S += w * J
        M += S.T @ (B @ S)


@nb.njit(cache=True, nogil=True)
def thin(points: F8, size: float, near: float, far: float, out: I8) -> int:
    """Rows of the first point of each cube, of those with squared ranges between; how many. They keep their order."""
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
