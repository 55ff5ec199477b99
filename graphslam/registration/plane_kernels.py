"""Numba kernels of points on planes: surface directions, residuals and their blocks. Plain arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class Pairs(NamedTuple):
    """Source points on surfaces of other steps.

    Parameters
    ----------
    source, target : (k,)
        Rows of the points: the source point, and the target point whose neighbourhood is the surface.
    i, j : (k,)
        Their steps.
    """

    source: Index
    target: Index
    i: Index
    j: Index


@nb.njit(cache=True, fastmath={"contract"})
def fit_surfaces(points: Array, neighbours: Index, least: int, out_normal: Array, out_flat: Array) -> None:
    """Normals and eigenvalues of the covariance of the neighbourhoods of points.

    Parameters
    ----------
    points : (q, d)
    neighbours : (k, m)
        Rows of ``points`` near each of k points; -1 where there are none.
    least : int
        Neighbours that a surface needs.
    out_normal : (k, d)
    out_flat : (k, 3)
        Eigenvalues of the covariance, ascending, in 2-D the first one twice; all nan where there are too few.
    """
    d = points.shape[1]
    for k in range(len(neighbours)):
        c = np.zeros(d)
        n = 0
        for a in neighbours[k]:
            if a >= 0:
                n += 1
                for u in range(d):
                    c[u] += points[a, u]
        if n < least:
            out_flat[k] = np.nan
            continue
        c /= n
        C = np.zeros((d, d))
        for a in neighbours[k]:
            if a >= 0:
                for u in range(d):
                    for v in range(u + 1):
                        C[u, v] += (points[a, u] - c[u]) * (points[a, v] - c[v])
        for u in range(d):
            for v in range(u):
                C[v, u] = C[u, v]
        w, V = np.linalg.eigh(C / n)
        out_normal[k] = V[:, 0]
        if d == 3:
            out_flat[k] = w
        else:
            out_flat[k, 0], out_flat[k, 1], out_flat[k, 2] = w[0], w[0], w[1]


@nb.njit(cache=True, fastmath={"contract"})
def plane_residuals(pairs: Pairs, R: Array, t: Array, points: Array, normals: Array, out: Array) -> None:
    """``n_jᵀ (T_j⁻¹ T_i p - q)`` of every pair.

    Parameters
    ----------
    R, t : (n, d, d), (n, d)
        Poses of the steps.
    points, normals : (q, d)
        Each in the frame of its own step.
    out : (k,)
    """
    d = t.shape[1]
    for k in range(len(pairs.source)):
        i, j, p, q = pairs.i[k], pairs.j[k], pairs.source[k], pairs.target[k]
        r = 0.0
        for u in range(d):
            w = t[i, u] - t[j, u]
            for v in range(d):
                w += R[i, u, v] * points[p, v]
            nw = 0.0
            for v in range(d):
                nw += R[j, u, v] * normals[q, v]
            r += nw * w
        for v in range(d):
            r -= normals[q, v] * points[q, v]
        out[k] = r


@nb.njit(cache=True, fastmath={"contract"})
def plane_blocks(
    pairs: Pairs,
    poses: tuple[Array, Array],
    surfaces: tuple[Array, Array],
    information: Array,
    slots: tuple[Index, Index, Index],
    H: Array,
    g: Array,
) -> float:
    """Add the Gauss–Newton blocks of point-to-plane pairs; the weighted sum of squares.

    Parameters
    ----------
    poses : (R, t)
    surfaces : (points, normals)
    information : (k,)
        Of each residual, weights included.
    slots : (first, offset, rank)
        ``first[n]`` is where the diagonal block of step n begins in ``H``, ``offset[k]`` where the block of the two
        steps of pair k does; its rows are those of the step with the lower ``rank``.
    H : flat
        Blocks ``(w, w)``, row-major.
    g : (n, w)
        ``Jᵀ Λ r``.
    """
    R, t = poses
    points, normals = surfaces
    first, offset, rank = slots
    d = t.shape[1]
    w = 6 if d == 3 else 3
    Ji, Jj = np.empty(w), np.empty(w)
    y, ni = np.empty(d), np.empty(d)
    total = 0.0
    for k in range(len(pairs.source)):
        if information[k] <= 0.0:
            continue
        i, j, p, q = pairs.i[k], pairs.j[k], pairs.source[k], pairs.target[k]
        nj, pi = normals[q], points[p]
        r = 0.0
        for u in range(d):
            ni[u] = 0.0
            y[u] = 0.0
        for u in range(d):
            x = t[i, u] - t[j, u]
            nw = 0.0
            for v in range(d):
                x += R[i, u, v] * pi[v]
                nw += R[j, u, v] * nj[v]
            for v in range(d):
                ni[v] += R[i, u, v] * nw
                y[v] += R[j, u, v] * x
        for v in range(d):
            r += nj[v] * (y[v] - points[q, v])
        if d == 3:
            Ji[0] = pi[1] * ni[2] - pi[2] * ni[1]
            Ji[1] = pi[2] * ni[0] - pi[0] * ni[2]
            Ji[2] = pi[0] * ni[1] - pi[1] * ni[0]
            Jj[0] = -(y[1] * nj[2] - y[2] * nj[1])
            Jj[1] = -(y[2] * nj[0] - y[0] * nj[2])
            Jj[2] = -(y[0] * nj[1] - y[1] * nj[0])
            for v in range(3):
                Ji[3 + v] = ni[v]
                Jj[3 + v] = -nj[v]
        else:
            for v in range(2):
                Ji[v] = ni[v]
                Jj[v] = -nj[v]
            Ji[2] = pi[0] * ni[1] - pi[1] * ni[0]
            Jj[2] = -(y[0] * nj[1] - y[1] * nj[0])
        L = information[k]
        total += L * r * r
        a, b, c = first[i], first[j], offset[k]
        low_is_j = rank[j] < rank[i]
        for u in range(w):
            Lu, Lv = L * Ji[u], L * Jj[u]
            g[i, u] += Lu * r
            g[j, u] += Lv * r
            for v in range(w):
                H[a + u * w + v] += Lu * Ji[v]
                H[b + u * w + v] += Lv * Jj[v]
                if low_is_j:
                    H[c + u * w + v] += Lv * Ji[v]
                else:
                    H[c + u * w + v] += Lu * Jj[v]
    return total
