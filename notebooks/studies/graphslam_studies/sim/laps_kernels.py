"""Numba kernels of the laps world: what each pose sees, and which measurements correspond. Plain arrays only."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import njit


@njit(nogil=True, error_model="numpy")
def see(R, p, places, rules, first, noise, out):
    """Measured points of poses in the body frame.

    Parameters
    ----------
    R, p : (n, 3, 3), (n, 3)
    places : (S, K, 3)
        Landmarks that come into view at each place of the route.
    rules : (begin, reach, range_sigma, bearing_sigma)
        Number of the first pose here, poses for which a landmark stays in view, noise.
    first : (n + 1,)
        Where the measurements of each pose begin, from that of the first.
    noise : (M, 3) float32, standard normal
    out : (M, 3) float32
    """
    begin, reach, range_sigma, bearing_sigma = rules
    S, K = places.shape[0], places.shape[1]
    for k in range(len(p)):
        i = begin + k
        m = first[k]
        for s in range(max(0, i - reach + 1), i + 1):
            for j in range(K):
                q = places[s % S, j]
                dx, dy, dz = q[0] - p[k, 0], q[1] - p[k, 1], q[2] - p[k, 2]
                x = R[k, 0, 0] * dx + R[k, 1, 0] * dy + R[k, 2, 0] * dz
                y = R[k, 0, 1] * dx + R[k, 1, 1] * dy + R[k, 2, 1] * dz
                z = R[k, 0, 2] * dx + R[k, 1, 2] * dy + R[k, 2, 2] * dz
                r = np.sqrt(x * x + y * y + z * z)
                across = bearing_sigma * r
                a, b, c = noise[m, 0], noise[m, 1], noise[m, 2]
                along = (range_sigma - across) * (a * x + b * y + c * z) / (r * r)
                out[m, 0] = x + across * a + along * x
                out[m, 1] = y + across * b + along * y
                out[m, 2] = z + across * c + along * z
                m += 1


@njit(nogil=True)
def correspond(rules, shared, met, last, first, a, b):
    """Measurements that correspond: with the pose before, or with the last lap that recognised the landmark.

    Parameters
    ----------
    rules : (begin, end, reach)
        Poses ``begin … end - 1``.
    shared : (S, K) bool
        Landmarks that can be recognised at all.
    met : (laps, S) uint64
        Bit j: landmark j of a place is recognised on that lap.
    last : (S, K) int64
        First measurement of the last pass that was recognised, -1; changed.
    first : (N + 1,)
    a, b : int32
        Out.

    Returns
    -------
    int
        Pairs written.
    """
    begin, end, reach = rules
    S, K = shared.shape
    n = 0
    for i in range(begin, end):
        low = max(0, i - reach + 1)
        before = max(0, i - reach)
        for s in range(low, i + 1):
            for j in range(K):
                m = first[i] + (s - low) * K + j
                if s < i:
                    a[n] = first[i - 1] + (s - before) * K + j
                    b[n] = m
                    n += 1
                elif shared[s % S, j] and (met[s // S, s % S] >> np.uint64(j)) & np.uint64(1):
                    if last[s % S, j] >= 0:
                        a[n] = last[s % S, j]
                        b[n] = m
                        n += 1
                    last[s % S, j] = m
    return n
