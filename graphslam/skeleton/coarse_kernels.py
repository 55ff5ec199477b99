"""Numba kernels of the keyframe network: only every k-th pose is a variable, with interpolated rigid motion between.

Between the keyframes K and K + 1 a pose moves by ``u_i = Σ h (u_K + w_K × (p_i - p_K))``, ``w_i = Σ h w_K``, with
weights h linear in the pose number. The derivative of a measurement is then ``h ((l - p_K) × w_K - u_K)``, so only
``Σ h W`` is needed per landmark and keyframe. Pose N - 1 belongs to the last interval. Plain arrays only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit
from graphslam.skeleton.block_table_kernels import _find, _grown
from graphslam.skeleton.landmark_kernels import _nine, _seen

Array = npt.NDArray[np.float64]
_TOGETHER = 6
"""2^6 consecutive landmarks are of one part: two threads do not write to one cache line."""


class PendingLandmarks(NamedTuple):
    """Landmarks with later observations; made by :func:`make_pending`."""

    slot: npt.NDArray[np.int32]
    """(L,): slot in the current interval; zero between two intervals."""
    head: npt.NDArray[np.int32]
    """(L,): latest entry of each, -1."""
    frame: npt.NDArray[np.int32]
    """(room,): keyframe of each entry …"""
    after: npt.NDArray[np.int32]
    """(room,): … the one before it, or the next free one …"""
    kept: Array
    """(room, 6): … and its Σ h W."""
    ends: npt.NDArray[np.int64]
    """(2,): number of used entries; first free one, -1 if none."""


@njit(nogil=True)
def make_pending(landmarks):
    """An empty set of pending landmarks."""
    ends = np.zeros(2, np.int64)
    ends[1] = -1
    return PendingLandmarks(
        np.zeros(landmarks, np.int32),
        np.full(landmarks, -1, np.int32),
        np.empty(16, np.int32),
        np.empty(16, np.int32),
        np.empty((16, 6)),
        ends,
    )


@callee(error_model="numpy")
def _sum_interval(detections, poses, interval, some, slot, ids, sums):
    """Sums over the poses of one interval, one row per observed landmark; ``slot`` is initially zero.

    A row: Σ h₀ W, Σ h₁ W, Σ h₀ h₀ W, Σ h₀ h₁ W, Σ h₁ h₁ W (six values each), number of observations.

    Parameters
    ----------
    interval : (a, b, end)
        Keyframes at poses a and b; poses ``a … end - 1``.
    some : (part, parts)
        Only landmarks of this part; a power of two parts.

    Returns
    -------
    int
        Number of rows.
    """
    a, b, end = interval
    part, parts = some
    n = 0
    for i in range(a, end):
        h1 = (i - a) / (b - a)
        h0 = 1.0 - h1
        h00, h01, h11 = h0 * h0, h0 * h1, h1 * h1
        R = _nine(poses.rotation, i)
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            j = detections.landmark[m]
            if (j >> _TOGETHER) & (parts - 1) != part:
                continue
            nx, ny, nz, al, be = _seen(R, detections, m)[3:]
            e = slot[j]
            if e == 0:
                ids[n] = j
                sums[n] = 0.0
                n += 1
                slot[j] = n
                e = n
            row = sums[e - 1]
            bx, by = be * nx, be * ny
            xx, xy, xz, yy, yz, zz = al + bx * nx, bx * ny, bx * nz, al + by * ny, by * nz, al + be * nz * nz
            row[0] += h0 * xx
            row[1] += h0 * xy
            row[2] += h0 * xz
            row[3] += h0 * yy
            row[4] += h0 * yz
            row[5] += h0 * zz
            row[6] += h1 * xx
            row[7] += h1 * xy
            row[8] += h1 * xz
            row[9] += h1 * yy
            row[10] += h1 * yz
            row[11] += h1 * zz
            row[12] += h00 * xx
            row[13] += h00 * xy
            row[14] += h00 * xz
            row[15] += h00 * yy
            row[16] += h00 * yz
            row[17] += h00 * zz
            row[18] += h01 * xx
            row[19] += h01 * xy
            row[20] += h01 * xz
            row[21] += h01 * yy
            row[22] += h01 * yz
            row[23] += h01 * zz
            row[24] += h11 * xx
            row[25] += h11 * xy
            row[26] += h11 * xz
            row[27] += h11 * yy
            row[28] += h11 * yz
            row[29] += h11 * zz
            row[30] += 1.0
    return n


@njit(nogil=True, inline="always")
def _interval(c, k, N):
    """Poses of interval c: its keyframes and the end of its poses."""
    a = c * k
    b = min(a + k, N - 1)
    return a, b, N if b == N - 1 else b


@callee
def _most(first, k, N, begin, end):
    """Largest number of measurements of an interval in ``begin … end - 1``."""
    most = 1
    for c in range(begin, end):
        a, _, e = _interval(c, k, N)
        most = max(most, first[e] - first[a])
    return most


@callee
def _weighted(S, qx, qy, qz, X):
    """``X = S G`` (3, 6), G = [[q]×, -I], of a symmetric S (six values)."""
    for r in range(3):
        if r == 0:
            a, b, c = S[0], S[1], S[2]
        elif r == 1:
            a, b, c = S[1], S[3], S[4]
        else:
            a, b, c = S[2], S[4], S[5]
        X[r, 0] = b * qz - c * qy
        X[r, 1] = c * qx - a * qz
        X[r, 2] = a * qy - b * qx
        X[r, 3], X[r, 4], X[r, 5] = -a, -b, -c


@callee
def _add_lever(qx, qy, qz, X, sign, B):
    """``B += sign · Gᵀ X``, G = [[q]×, -I]."""
    for c in range(6):
        x, y, z = sign * X[0, c], sign * X[1, c], sign * X[2, c]
        B[0, c] += qz * y - qy * z
        B[1, c] += qx * z - qz * x
        B[2, c] += qy * x - qx * y
        B[3, c] -= x
        B[4, c] -= y
        B[5, c] -= z


@njit(nogil=True)
def keyframe_diagonal(detections, poses, landmarks, k, begin, end, out):
    """Add the measurements' diagonal blocks of ``Pᵀ S P`` of the keyframes ``begin … end - 1`` to ``out (K, 6, 6)``.

    Parameters
    ----------
    landmarks : (l (L, 3), D⁻¹ (L, 6))
    k : int
        Number of poses between keyframes.
    """
    l, Di = landmarks
    N, K = len(poses.position), len(out)
    first = max(0, begin - 1)
    most = _most(detections.first, k, N, first, min(end, K - 1))
    slot0, slot1 = np.zeros(len(l), np.int32), np.zeros(len(l), np.int32)
    ids0, ids1 = np.empty(most, np.int32), np.empty(most, np.int32)
    sums0, sums1 = np.empty((most, 31)), np.empty((most, 31))
    X, Y = np.empty((3, 6)), np.empty((3, 6))
    S, SS = np.empty(6), np.empty(6)
    n0 = 0
    for c in range(first, end):
        n1 = 0
        if c < K - 1:
            n1 = _sum_interval(detections, poses, _interval(c, k, N), (0, 1), slot1, ids1, sums1)
        if c >= begin:
            at = min(c * k, N - 1)
            px, py, pz = poses.position[at, 0], poses.position[at, 1], poses.position[at, 2]
            for which in range(n0 + n1):
                if which < n0:
                    j = ids0[which]
                    other = slot1[j]
                    for d in range(6):
                        S[d] = sums0[which, 6 + d]
                        SS[d] = sums0[which, 24 + d]
                    if other > 0:
                        for d in range(6):
                            S[d] += sums1[other - 1, d]
                            SS[d] += sums1[other - 1, 12 + d]
                else:
                    j = ids1[which - n0]
                    if slot0[j] > 0:
                        continue
                    for d in range(6):
                        S[d] = sums1[which - n0, d]
                        SS[d] = sums1[which - n0, 12 + d]
                qx, qy, qz = l[j, 0] - px, l[j, 1] - py, l[j, 2] - pz
                # Σ h² W - S D⁻¹ S
                for col in range(3):
                    if col == 0:
                        x, y, z = S[0], S[1], S[2]
                    elif col == 1:
                        x, y, z = S[1], S[3], S[4]
                    else:
                        x, y, z = S[2], S[4], S[5]
                    X[0, col] = Di[j, 0] * x + Di[j, 1] * y + Di[j, 2] * z
                    X[1, col] = Di[j, 1] * x + Di[j, 3] * y + Di[j, 4] * z
                    X[2, col] = Di[j, 2] * x + Di[j, 4] * y + Di[j, 5] * z
                SS[0] -= S[0] * X[0, 0] + S[1] * X[1, 0] + S[2] * X[2, 0]
                SS[1] -= S[0] * X[0, 1] + S[1] * X[1, 1] + S[2] * X[2, 1]
                SS[2] -= S[0] * X[0, 2] + S[1] * X[1, 2] + S[2] * X[2, 2]
                SS[3] -= S[1] * X[0, 1] + S[3] * X[1, 1] + S[4] * X[2, 1]
                SS[4] -= S[1] * X[0, 2] + S[3] * X[1, 2] + S[4] * X[2, 2]
                SS[5] -= S[2] * X[0, 2] + S[4] * X[1, 2] + S[5] * X[2, 2]
                _weighted(SS, qx, qy, qz, Y)
                _add_lever(qx, qy, qz, Y, 1.0, out[c])
        for e in range(n0):
            slot0[ids0[e]] = 0
        slot0, slot1 = slot1, slot0
        ids0, ids1 = ids1, ids0
        sums0, sums1 = sums1, sums0
        n0 = n1


@callee
def _subtract_pairs(chain, landmark, waiting, position, size, room, table):
    """Subtract ``S D⁻¹ S`` of a landmark for all pairs of its keyframes (entries ``chain``)."""
    l, Di = landmark
    frame, kept = waiting
    k, K = size
    X, Y = room
    for i in range(len(chain)):
        q = position[min(frame[chain[i]] * k, len(position) - 1)]
        _weighted(kept[chain[i]], l[0] - q[0], l[1] - q[1], l[2] - q[2], X[i])
        for d in range(6):
            x, y, z = X[i, 0, d], X[i, 1, d], X[i, 2, d]
            Y[i, 0, d] = Di[0] * x + Di[1] * y + Di[2] * z
            Y[i, 1, d] = Di[1] * x + Di[3] * y + Di[4] * z
            Y[i, 2, d] = Di[2] * x + Di[4] * y + Di[5] * z
    for i in range(len(chain)):  # later keyframes come first
        for i2 in range(i, len(chain)):
            key = np.int64(frame[chain[i2]]) * K + frame[chain[i]]
            _subtract(X[i2], Y[i], table.block[_find(table, key)])


@njit(nogil=True)
def keyframe_network(detections, poses, landmarks, k, span, count, waiting, table):
    """Add the blocks of ``Pᵀ S P`` from measurements of some landmarks to ``table``, interval by interval.

    Returns the pending landmarks and the table, as both may have grown.

    The sums of a landmark per keyframe are stored until its last observation; then the pairs of its keyframes are
    added, and its memory is freed.

    Parameters
    ----------
    landmarks : (l (L, 3), D⁻¹ (L, 6))
    span : (begin, end, part, parts)
        Intervals between keyframes; to be called for all of them in order. Only landmarks of this part; a power of two
        parts.
    count : (L,) int32
        Remaining observations of each landmark; changed.
    """
    l, Di = landmarks
    N = len(poses.position)
    K = (N - 2) // k + 2
    most = _most(detections.first, k, N, span[0], span[1])
    slot, head, frame, after, kept, ends = waiting
    ids, sums = np.empty(most, np.int32), np.empty((most, 31))
    room, used, free = len(frame), ends[0], ends[1]
    longest = 64
    X, Y = np.empty((longest, 3, 6)), np.empty((longest, 3, 6))
    chain = np.empty(longest, np.int32)
    B00, B01, B11 = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    T = np.empty((3, 6))
    for c in range(span[0], span[1]):
        n = _sum_interval(detections, poses, _interval(c, k, N), span[2:], slot, ids, sums)
        if used + 2 * n > room:  # all may be new
            room = 2 * (used + 2 * n)
            frame, after, kept = _longer(frame, after, kept, room)
        a, b, _ = _interval(c, k, N)
        p0, p1 = poses.position[a], poses.position[b]
        B00[:] = 0.0
        B01[:] = 0.0
        B11[:] = 0.0
        for e in range(n):
            j = ids[e]
            slot[j] = 0
            row = sums[e]
            qx, qy, qz = l[j, 0] - p0[0], l[j, 1] - p0[1], l[j, 2] - p0[2]
            rx, ry, rz = l[j, 0] - p1[0], l[j, 1] - p1[1], l[j, 2] - p1[2]
            _weighted(row[12:18], qx, qy, qz, T)
            _add_lever(qx, qy, qz, T, 1.0, B00)
            _weighted(row[18:24], rx, ry, rz, T)
            _add_lever(qx, qy, qz, T, 1.0, B01)
            _weighted(row[24:30], rx, ry, rz, T)
            _add_lever(rx, ry, rz, T, 1.0, B11)
            for side in range(2):
                at = head[j]
                if at < 0 or frame[at] != c + side:
                    if free >= 0:
                        new = free
                        free = after[free]
                    else:
                        new = used
                        used += 1
                    frame[new] = c + side
                    after[new] = at
                    for d in range(6):
                        kept[new, d] = row[6 * side + d]
                    head[j] = new
                else:
                    for d in range(6):
                        kept[at, d] += row[6 * side + d]
            count[j] -= np.int32(row[30])
            if count[j] > 0:
                continue
            # last observation: add all pairs of its keyframes
            f = 0
            at = head[j]
            while at >= 0:
                if f == longest:
                    longest *= 2
                    X, Y, chain = np.empty((longest, 3, 6)), np.empty((longest, 3, 6)), _doubled(chain)
                chain[f] = at
                f += 1
                at = after[at]
            while table.filled[0] + f * (f + 1) // 2 > len(table.block):
                table = _grown(table)
            _subtract_pairs(chain[:f], (l[j], Di[j]), (frame, kept), poses.position, (k, K), (X, Y), table)
            for i in range(f):
                after[chain[i]] = free
                free = chain[i]
            head[j] = -1
        while table.filled[0] + 3 > len(table.block):
            table = _grown(table)
        table.block[_find(table, np.int64(c) * K + c)] += B00
        table.block[_find(table, np.int64(c) * K + c + 1)] += B01
        table.block[_find(table, np.int64(c + 1) * K + c + 1)] += B11
    ends[0], ends[1] = used, free
    return PendingLandmarks(slot, head, frame, after, kept, ends), table


@callee
def _subtract(X, Y, B):
    """``B -= Xᵀ Y`` of two (3, 6)."""
    for r in range(6):
        x, y, z = X[0, r], X[1, r], X[2, r]
        for c in range(6):
            B[r, c] -= x * Y[0, c] + y * Y[1, c] + z * Y[2, c]


@callee
def _longer(frame, after, kept, room):
    n = len(frame)
    f, a, s = np.empty(room, np.int32), np.empty(room, np.int32), np.empty((room, 6))
    f[:n], a[:n], s[:n] = frame, after, kept
    return f, a, s


@callee
def _doubled(values):
    out = np.empty(2 * len(values), np.int32)
    out[: len(values)] = values
    return out


@callee
def _offset(position, a, i):
    return position[i, 0] - position[a, 0], position[i, 1] - position[a, 1], position[i, 2] - position[a, 2]


@callee
def _carried(A, left, right, h, M, T):
    """``T = h · Cₗᵀ A Cᵣ`` with C = [[I, 0], [-[d]×, I]] for the offsets ``left`` and ``right`` from a keyframe."""
    x, y, z = right
    for r in range(6):  # A Cᵣ: the rotation columns get -A_u [d]
        a, b, c = A[r, 3], A[r, 4], A[r, 5]
        M[r, 0] = h * (A[r, 0] - (b * z - c * y))
        M[r, 1] = h * (A[r, 1] - (c * x - a * z))
        M[r, 2] = h * (A[r, 2] - (a * y - b * x))
        M[r, 3], M[r, 4], M[r, 5] = h * a, h * b, h * c
    x, y, z = left
    for c2 in range(6):  # Cₗᵀ M: the rotation rows get [d] M_u
        a, b, c = M[3, c2], M[4, c2], M[5, c2]
        T[0, c2] = M[0, c2] - z * b + y * c
        T[1, c2] = M[1, c2] + z * a - x * c
        T[2, c2] = M[2, c2] - y * a + x * b
        T[3, c2], T[4, c2], T[5, c2] = a, b, c


@njit(nogil=True)
def keyframe_chain(position, diagonal, upper, k, out_diagonal, out_upper):
    """Add ``Pᵀ A P`` of a chain of blocks to ``out_diagonal (K, 6, 6)`` and ``out_upper (K - 1, 6, 6)``."""
    N, K = len(position), len(out_diagonal)
    M, T = np.empty((6, 6)), np.empty((6, 6))
    for c in range(K - 1):
        a, b, end = _interval(c, k, N)
        for i in range(a, end):
            h1 = (i - a) / (b - a)
            h0 = 1.0 - h1
            d0, d1 = _offset(position, a, i), _offset(position, b, i)
            _carried(diagonal[i], d0, d0, h0 * h0, M, T)
            out_diagonal[c] += T
            _carried(diagonal[i], d1, d1, h1 * h1, M, T)
            out_diagonal[c + 1] += T
            _carried(diagonal[i], d0, d1, h0 * h1, M, T)
            out_upper[c] += T
            if i + 1 >= N:
                continue
            g1 = (i + 1 - a) / (b - a)
            g0 = 1.0 - g1
            e0, e1 = _offset(position, a, i + 1), _offset(position, b, i + 1)
            _carried(upper[i], d0, e0, h0 * g0, M, T)
            _both(T, out_diagonal[c])
            _carried(upper[i], d1, e1, h1 * g1, M, T)
            _both(T, out_diagonal[c + 1])
            _carried(upper[i], d0, e1, h0 * g1, M, T)
            out_upper[c] += T
            _carried(upper[i], d1, e0, h1 * g0, M, T)
            for r in range(6):
                for s in range(6):
                    out_upper[c, r, s] += T[s, r]


@callee
def _both(T, B):
    for r in range(6):
        for c in range(6):
            B[r, c] += T[r, c] + T[c, r]


@njit(nogil=True)
def restrict_residual(position, k, r, out):
    """Write ``Pᵀ r`` to ``out (K, 6)``."""
    p, N, K = position, len(position), len(out)
    out[:] = 0.0
    for c in range(K - 1):
        a, b, end = _interval(c, k, N)
        for i in range(a, end):
            h = (i - a) / (b - a)
            for side in range(2):
                q = a if side == 0 else b
                g = 1.0 - h if side == 0 else h
                x, y, z = p[i, 0] - p[q, 0], p[i, 1] - p[q, 1], p[i, 2] - p[q, 2]
                o = out[c + side]
                o[0] += g * (r[i, 0] + y * r[i, 5] - z * r[i, 4])
                o[1] += g * (r[i, 1] + z * r[i, 3] - x * r[i, 5])
                o[2] += g * (r[i, 2] + x * r[i, 4] - y * r[i, 3])
                o[3] += g * r[i, 3]
                o[4] += g * r[i, 4]
                o[5] += g * r[i, 5]


@njit(nogil=True)
def prolong_step(position, k, x, out):
    """Add ``P x`` of ``x (K, 6)`` to ``out (N, 6)``."""
    p, N, K = position, len(position), len(x)
    for c in range(K - 1):
        a, b, end = _interval(c, k, N)
        for i in range(a, end):
            h = (i - a) / (b - a)
            for side in range(2):
                q = a if side == 0 else b
                g = 1.0 - h if side == 0 else h
                dx, dy, dz = p[i, 0] - p[q, 0], p[i, 1] - p[q, 1], p[i, 2] - p[q, 2]
                v = x[c + side]
                out[i, 0] += g * v[0]
                out[i, 1] += g * v[1]
                out[i, 2] += g * v[2]
                out[i, 3] += g * (v[3] + v[1] * dz - v[2] * dy)
                out[i, 4] += g * (v[4] + v[2] * dx - v[0] * dz)
                out[i, 5] += g * (v[5] + v[0] * dy - v[1] * dx)
