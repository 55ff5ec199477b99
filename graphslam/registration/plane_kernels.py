"""Numba kernels of point-to-plane pairs: surface normals, residuals and Hessian blocks. Plain arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class PlanePairs(NamedTuple):
    """Pairs of source points and surfaces of other steps.

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

    def some(self, rows: slice) -> PlanePairs:
        """A part of the pairs."""
        return PlanePairs(*(x[rows] for x in self))


@callee
def symmetric_eigen(A: Array, w: Array, V: Array) -> None:
    """Eigenvalues ``w`` (ascending) and eigenvectors (columns of ``V``) of a small symmetric matrix.

    Cyclic Jacobi rotations: for 3 x 3 at least three times as fast as LAPACK, and as accurate. ``A`` is overwritten.
    """
    n = len(A)
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, on = 0.0, 0.0
        for i in range(n):
            on += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if off <= 1e-34 * on or off == 0.0:  # an error of w of at most 1e-17 of the largest
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[q, p] == 0.0:
                    continue
                theta = (A[q, q] - A[p, p]) / (2.0 * A[q, p])
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                A[p, p], A[q, q] = A[p, p] - t * A[q, p], A[q, q] + t * A[q, p]
                A[q, p] = A[p, q] = 0.0
                for k in range(n):
                    if k not in (p, q):
                        a, b = A[k, p], A[k, q]
                        A[k, p] = A[p, k] = c * a - s * b
                        A[k, q] = A[q, k] = s * a + c * b
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * a - s * b, s * a + c * b
    for i in range(n):
        w[i] = A[i, i]
    for i in range(1, n):  # insertion sort
        j = i
        while j > 0 and w[j - 1] > w[j]:
            w[j - 1], w[j] = w[j], w[j - 1]
            for k in range(n):
                V[k, j - 1], V[k, j] = V[k, j], V[k, j - 1]
            j -= 1


@callee(fastmath={"contract"})
def _covariance(points: Array, rows: Index, mean: Array, C: Array) -> int:
    """Covariance ``C`` of the points in ``rows`` (-1: none), divided by their number, which is returned."""
    d = points.shape[1]
    n = 0
    mean[:] = 0.0
    C[:] = 0.0
    for a in rows:
        if a >= 0:
            n += 1
            for u in range(d):
                mean[u] += points[a, u]
    if n == 0:
        return 0
    for u in range(d):
        mean[u] /= n
    for a in rows:
        if a >= 0:
            for u in range(d):
                for v in range(u + 1):
                    C[u, v] += (points[a, u] - mean[u]) * (points[a, v] - mean[v])
    for u in range(d):
        for v in range(u + 1):
            C[u, v] /= n
            C[v, u] = C[u, v]
    return n


@njit
def principal_axes(points: Array, neighbours: Index, out_spread: Array, out_axes: Array) -> None:
    """Eigenvalues and eigenvectors of the covariance of neighbourhoods.

    Parameters
    ----------
    points : (q, d)
    neighbours : (k, m)
        Rows of ``points``.
    out_spread : (k, d)
        Variances [m²], ascending.
    out_axes : (k, d, d)
        Their unit vectors, in columns.
    """
    d = points.shape[1]
    mean, C = np.zeros(d), np.zeros((d, d))
    for k in range(len(neighbours)):
        _covariance(points, neighbours[k], mean, C)
        symmetric_eigen(C, out_spread[k], out_axes[k])


@njit(nogil=True, fastmath={"contract"})
def fit_surfaces(
    points: Array, neighbours: Index, least: int, out_normal: Array, out_flat: Array, out_tilt: Array
) -> None:
    """Normals and eigenvalues of the covariance of the neighbourhoods of points, and the noise of the normals.

    Parameters
    ----------
    points : (q, d)
    neighbours : (k, m)
        Rows of ``points`` near each of k points; -1 if there are fewer.
    least : int
        Least number of neighbours of a surface.
    out_normal : (k, d)
    out_flat : (k, 3)
        Eigenvalues of the covariance, ascending, in 2-D the first one twice; all nan with too few neighbours.
    out_tilt : (k, d - 1, d)
        Axes of the surface, scaled with the σ of the normal's tilt towards them [rad]: the slope of a plane through n
        points of variance ``σ²`` has the variance ``σ² / (n l)``, where l is their variance along the axis.
    """
    d = points.shape[1]
    mean, C, w, V = np.zeros(d), np.zeros((d, d)), np.zeros(d), np.zeros((d, d))
    for k in range(len(neighbours)):
        n = _covariance(points, neighbours[k], mean, C)
        if n < least:
            out_flat[k] = np.nan
            out_tilt[k] = 0.0
            continue
        symmetric_eigen(C, w, V)
        for v in range(d):
            out_normal[k, v] = V[v, 0]
        for u in range(1, d):
            sigma = np.sqrt(max(w[0], 0.0) / ((n - d) * max(w[u], 1e-12)))
            for v in range(d):
                out_tilt[k, u - 1, v] = sigma * V[v, u]
        out_flat[k, 0], out_flat[k, 1], out_flat[k, 2] = w[0], w[d - 2], w[d - 1]


@njit(nogil=True, fastmath={"contract"})
def plane_residuals(pairs: PlanePairs, R: Array, t: Array, points: Array, normals: Array, out: Array) -> None:
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


class GroupInformation(NamedTuple):
    """Information of groups of pairs on the motion between their two sides.

    Parameters
    ----------
    group : (k,)
        Group of each pair.
    centre : (m, d)
        Centre of each group, world [m].
    share : (m, w, w)
        Projects the derivative of a residual by a motion of all source points about the centre (world axes, tangent
        order) to the part that the group determines.
    tilts : (q, d - 1, d)
        Of :func:`fit_surfaces`, in the frame of the step: their mean effect is subtracted from the gradient.
    """

    group: Index
    centre: Array
    share: Array
    tilts: npt.NDArray[np.float32]


def no_noise_correction(dim: int) -> GroupInformation:
    """No correction for noise of normals."""
    w = 6 if dim == 3 else 3
    return GroupInformation(
        np.zeros(0, np.int64), np.zeros((0, dim)), np.zeros((0, w, w)), np.zeros((0, dim - 1, dim), np.float32)
    )


@callee(fastmath={"contract"})
def normal_jacobian(x: Array, n: Array, out: Array) -> None:
    """Derivative of ``nᵀ y`` by a motion about the origin of a point that is at ``x``, in the order of a tangent."""
    if len(x) == 3:
        out[0] = x[1] * n[2] - x[2] * n[1]
        out[1] = x[2] * n[0] - x[0] * n[2]
        out[2] = x[0] * n[1] - x[1] * n[0]
        out[3], out[4], out[5] = n[0], n[1], n[2]
    else:
        out[0], out[1], out[2] = n[0], n[1], x[0] * n[1] - x[1] * n[0]


@njit(nogil=True, fastmath={"contract"})
def group_information(
    pairs: PlanePairs,
    poses: tuple[Array, Array],
    surfaces: tuple[Array, Array, npt.NDArray[np.floating]],
    information: Array,
    groups: tuple[Index, Array],
    H: Array,
    F: Array,
) -> None:
    """Add the information of pairs on the motion between the sides of their group, and its part from noisy normals.

    Parameters
    ----------
    poses : (R, t)
    surfaces : (points, normals, tilts)
        ``tilts`` of :func:`fit_surfaces`, in the frame of the step.
    information : (k,)
    groups : (group, centre)
        See :class:`GroupInformation`.
    H, F : (m, w, w)
        ``Σ L J Jᵀ`` and ``Σ L E[δJ δJᵀ]``, about the centre, world.
    """
    R, t = poses
    points, normals, tilts = surfaces
    group, centre = groups
    d = t.shape[1]
    w = 6 if d == 3 else 3
    x, n, J = np.empty(d), np.empty(d), np.empty(w)
    for k in range(len(pairs.source)):
        L = information[k]
        if L <= 0.0:
            continue
        i, j, p, q, m = pairs.i[k], pairs.j[k], pairs.source[k], pairs.target[k], group[k]
        for u in range(d):
            x[u] = t[i, u] - centre[m, u]
            for v in range(d):
                x[u] += R[i, u, v] * points[p, v]
        for a in range(d):
            for u in range(d):
                n[u] = 0.0
                for v in range(d):
                    n[u] += R[j, u, v] * (normals[q, v] if a == 0 else tilts[q, a - 1, v])
            normal_jacobian(x, n, J)
            for u in range(w):
                for v in range(w):
                    if a == 0:
                        H[m, u, v] += L * J[u] * J[v]
                    else:
                        F[m, u, v] += L * J[u] * J[v]


@callee(fastmath={"contract"})
def _moved(K: Array, R: Array, t: Array, centre: Array, sign: float, out: Array) -> None:
    """Convert a derivative by a motion about a centre (world frame) to one by the right tangent of a pose."""
    d = len(t)
    if d == 3:
        a, b, c = t[0] - centre[0], t[1] - centre[1], t[2] - centre[2]
        x = K[0] - (b * K[5] - c * K[4])
        y = K[1] - (c * K[3] - a * K[5])
        z = K[2] - (a * K[4] - b * K[3])
        for v in range(3):
            out[v] = sign * (R[0, v] * x + R[1, v] * y + R[2, v] * z)
            out[3 + v] = sign * (R[0, v] * K[3] + R[1, v] * K[4] + R[2, v] * K[5])
    else:
        for v in range(2):
            out[v] = sign * (R[0, v] * K[0] + R[1, v] * K[1])
        out[2] = sign * (K[2] - ((t[0] - centre[0]) * K[1] - (t[1] - centre[1]) * K[0]))


@callee(fastmath={"contract"})
def _share_of(share: Array, m: int, J: Array, out: Array) -> None:
    """``out = share[m] J``."""
    for u in range(len(J)):
        out[u] = 0.0
        for v in range(len(J)):
            out[u] += share[m, u, v] * J[v]


@njit(nogil=True, fastmath={"contract"})
def plane_blocks(
    pairs: PlanePairs,
    poses: tuple[Array, Array],
    surfaces: tuple[Array, Array],
    information: Array,
    slots: tuple[Index, Index, Index],
    held: GroupInformation,
    H: Array,
    g: Array,
) -> float:
    """Add the Gauss–Newton blocks of point-to-plane pairs; returns the weighted sum of squares.

    Parameters
    ----------
    poses : (R, t)
    surfaces : (points, normals)
    information : (k,)
        Of each residual, including weights.
    slots : (first, offset, rank)
        ``first[n]`` is the offset of the diagonal block of step n in ``H``, ``offset[k]`` that of the block of the two
        steps of pair k; its rows are those of the step with the lower ``rank``.
    held : GroupInformation
        Without groups there is no correction.
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
    Ji, Jj, J, K = np.empty(w), np.empty(w), np.empty(w), np.empty(w)
    gi, gj, pull = np.empty(w), np.empty(w), np.empty(w)
    y, ni, nw, x = np.empty(d), np.empty(d), np.empty(d), np.empty(d)
    total = 0.0
    for k in range(len(pairs.source)):
        if information[k] <= 0.0:
            continue
        i, j, p, q = pairs.i[k], pairs.j[k], pairs.source[k], pairs.target[k]
        nj, pi = normals[q], points[p]
        for u in range(d):
            ni[u], y[u] = 0.0, 0.0
        for u in range(d):
            x[u] = t[i, u] - t[j, u]
            nw[u] = 0.0
            for v in range(d):
                x[u] += R[i, u, v] * pi[v]
                nw[u] += R[j, u, v] * nj[v]
            for v in range(d):
                ni[v] += R[i, u, v] * nw[u]
                y[v] += R[j, u, v] * x[u]
        r = 0.0
        for v in range(d):
            r += nj[v] * (y[v] - points[q, v])
        if len(held.group):
            m = held.group[k]
            for u in range(d):
                x[u] += t[j, u] - held.centre[m, u]
            normal_jacobian(x, nw, J)
            for u in range(w):
                pull[u] = J[u] * r
            for a in range(d - 1):
                e = 0.0
                for u in range(d):
                    e += held.tilts[q, a, u] * (y[u] - points[q, u])
                    nw[u] = 0.0
                    for v in range(d):
                        nw[u] += R[j, u, v] * held.tilts[q, a, v]
                normal_jacobian(x, nw, K)
                for u in range(w):
                    pull[u] -= K[u] * e
            _share_of(held.share, m, J, K)
            _moved(K, R[i], t[i], held.centre[m], 1.0, Ji)
            _moved(K, R[j], t[j], held.centre[m], -1.0, Jj)
            _share_of(held.share, m, pull, K)
            _moved(K, R[i], t[i], held.centre[m], 1.0, gi)
            _moved(K, R[j], t[j], held.centre[m], -1.0, gj)
        else:
            normal_jacobian(pi, ni, Ji)
            normal_jacobian(y, nj, Jj)
            for v in range(w):
                Jj[v] = -Jj[v]
                gi[v] = Ji[v] * r
                gj[v] = Jj[v] * r
        L, a, b, c = information[k], first[i], first[j], offset[k]
        total += L * r * r
        low_is_j = rank[j] < rank[i]
        for u in range(w):
            Lu, Lv = L * Ji[u], L * Jj[u]
            g[i, u] += L * gi[u]
            g[j, u] += L * gj[u]
            for v in range(w):
                H[a + u * w + v] += Lu * Ji[v]
                H[b + u * w + v] += Lv * Jj[v]
                H[c + u * w + v] += Lv * Ji[v] if low_is_j else Lu * Jj[v]
    return total


@njit
def line_alignment(
    source: Array, source_normals: Array, target: Array, target_normals: Array, T: Array, which: Index, flatness: float
) -> tuple[Array, Array, float, int]:
    """Hessian ``(3, 3)``, gradient ``(3,)``, ``½ Σ dᵀ M d`` and number of pairs of planar points at ``T`` ``(3,)``.

    ``which`` ``(n,)`` are rows of target points; a row after the last is no pair. The shape of a point of normal n
    is ``I - (1 - flatness) n nᵀ``; M is the inverse of the sum of both shapes.
    """
    H, b, error, pairs = np.zeros((3, 3)), np.zeros(3), 0.0, 0
    c, s, flat = np.cos(T[2]), np.sin(T[2]), 1.0 - flatness
    for k in range(len(source)):
        q = which[k]
        if q >= len(target):
            continue
        pairs += 1
        x, y = c * source[k, 0] - s * source[k, 1], s * source[k, 0] + c * source[k, 1]
        dx, dy = x + T[0] - target[q, 0], y + T[1] - target[q, 1]
        mx = c * source_normals[k, 0] - s * source_normals[k, 1]
        my = s * source_normals[k, 0] + c * source_normals[k, 1]
        nx, ny = target_normals[q, 0], target_normals[q, 1]
        xx, xy, yy = 2.0 - flat * (nx * nx + mx * mx), -flat * (nx * ny + mx * my), 2.0 - flat * (ny * ny + my * my)
        det = xx * yy - xy * xy
        for i, (u, v) in enumerate(((c, s), (-s, c), (-y, x))):  # columns of d(R Exp(δ) p)/dδ
            mu, mv = (yy * u - xy * v) / det, (xx * v - xy * u) / det
            b[i] += mu * dx + mv * dy
            H[i, 0] += mu * c + mv * s
            H[i, 1] += mv * c - mu * s
            H[i, 2] += mv * x - mu * y
        error += 0.5 * (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / det
    return H, b, error, pairs
