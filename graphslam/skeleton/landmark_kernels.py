"""Numba kernels of the measurements: landmarks, gradient, diagonal blocks and product of the Schur complement.

The residual of a measurement z (in the body frame) of landmark l from pose (R, p) is ``e = l - p - R z``. Poses are
perturbed in the world frame about their position, ``R ← Exp(w) R``, ``p ← p + u``, so with the lever ``q = l - p`` the
residual changes by ``q × w - u + dl``. The lever is always the predicted one: with the measured ``s = R z`` a rotation
of the whole map would change the objective, and Gauss-Newton would converge linearly. ``s`` is used only in the weight
``W = α I + β n nᵀ`` with n = s, α = 1/(σ_bearing |z|)², α + β |z|² = 1/σ_range². Points of surfaces have a normal in
the body frame instead: n is that normal in the world, α = 0 and β = 1/σ_along². Such a landmark is anywhere on its
surface; it is put at the mean of its points there, by α = 1/σ_across² in the sums for its position only. Vectors of
poses are ``(N, 6)``: w, then u.

Every kernel works on the poses ``begin … end - 1``; sums over landmarks are added to arrays of the caller. Plain arrays
only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import njit

Array = npt.NDArray[np.float64]


class Detections(NamedTuple):
    """Measurements in pose order."""

    points: npt.NDArray[np.float32]
    """(M, 3) in the body frame [m]."""
    landmark: npt.NDArray[np.int32]
    """(M,)"""
    first: npt.NDArray[np.int64]
    """(N + 1,): first measurement of each pose."""
    along: float
    """1 / σ_range² [1/m²]; with normals along the normal."""
    across: float
    """1 / σ_bearing² [1/rad²]; with normals of the position on the surface [1/m²]."""
    base: int
    """Number of measurements before the first row of ``points``; not zero if only a tile is in memory."""
    normals: npt.NDArray[np.float32]
    """(M, 3) unit vectors in the body frame, or none: the rays."""


class Poses(NamedTuple):
    """Poses of the body in the world."""

    rotation: Array
    """(N, 3, 3)"""
    position: Array
    """(N, 3) [m]"""


@njit(nogil=True, inline="always", error_model="numpy")
def _turned(R, v, m):
    """``R v_m``."""
    x, y, z = np.float64(v[m, 0]), np.float64(v[m, 1]), np.float64(v[m, 2])
    return R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z


@njit(nogil=True, inline="always", error_model="numpy")
def _seen(R, detections, m):
    """``s = R z``, and direction and parameters of its weight: W = α I + β n nᵀ."""
    x, y, z = _turned(R, detections.points, m)
    if len(detections.normals):
        nx, ny, nz = _turned(R, detections.normals, m)
        return x, y, z, nx, ny, nz, 0.0, detections.along
    r2 = x * x + y * y + z * z
    alpha = detections.across / r2
    return x, y, z, x, y, z, alpha, (detections.along - alpha) / r2


@njit(nogil=True, inline="always")
def _nine(R, i):
    return (R[i, 0, 0], R[i, 0, 1], R[i, 0, 2], R[i, 1, 0], R[i, 1, 1], R[i, 1, 2], R[i, 2, 0], R[i, 2, 1], R[i, 2, 2])


@njit(nogil=True)
def count_observations(landmark, out):
    """Add the number of observations to ``out (L,)``."""
    for m in range(len(landmark)):
        out[landmark[m]] += 1


@njit(nogil=True, error_model="numpy")
def sum_landmarks(detections, poses, begin, end, D, b):
    """Add ``Σ W`` (xx, xy, xz, yy, yz, zz) to ``D (L, 6)`` and ``Σ W (p + s)`` to ``b (L, 3)``."""
    there = detections.across if len(detections.normals) else 0.0
    for i in range(begin, end):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            sx, sy, sz, nx, ny, nz, al, be = _seen(R, detections, m)
            j = detections.landmark[m]
            al += there
            D[j, 0] += al + be * nx * nx
            D[j, 1] += be * nx * ny
            D[j, 2] += be * nx * nz
            D[j, 3] += al + be * ny * ny
            D[j, 4] += be * ny * nz
            D[j, 5] += al + be * nz * nz
            ax, ay, az = px + sx, py + sy, pz + sz
            d = be * (nx * ax + ny * ay + nz * az)
            b[j, 0] += al * ax + d * nx
            b[j, 1] += al * ay + d * ny
            b[j, 2] += al * az + d * nz


@njit(nogil=True, error_model="numpy")
def solve_landmarks(D, b, begin, end):
    """Replace ``D`` by its inverse and ``b`` by ``l = D⁻¹ b``, for landmarks ``begin … end - 1``."""
    for j in range(begin, end):
        a, c, d, e, f, g = D[j, 0], D[j, 1], D[j, 2], D[j, 3], D[j, 4], D[j, 5]
        xx, xy, xz = e * g - f * f, d * f - c * g, c * f - d * e
        yy, yz, zz = a * g - d * d, c * d - a * f, a * e - c * c
        over = 1.0 / (a * xx + c * xy + d * xz)
        D[j, 0], D[j, 1], D[j, 2] = xx * over, xy * over, xz * over
        D[j, 3], D[j, 4], D[j, 5] = yy * over, yz * over, zz * over
        x, y, z = b[j, 0], b[j, 1], b[j, 2]
        b[j, 0] = D[j, 0] * x + D[j, 1] * y + D[j, 2] * z
        b[j, 1] = D[j, 1] * x + D[j, 3] * y + D[j, 4] * z
        b[j, 2] = D[j, 2] * x + D[j, 4] * y + D[j, 5] * z


@njit(nogil=True, error_model="numpy")
def pose_gradients(detections, poses, l, begin, end, g, objective):
    """Write half the objective's gradient of each pose to ``g (N, 6)`` and ``Σ eᵀ W e`` to ``objective (N,)``."""
    for i in range(begin, end):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        J = wx = wy = wz = ux = uy = uz = 0.0
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            sx, sy, sz, nx, ny, nz, al, be = _seen(R, detections, m)
            j = detections.landmark[m]
            qx, qy, qz = l[j, 0] - px, l[j, 1] - py, l[j, 2] - pz
            ex, ey, ez = qx - sx, qy - sy, qz - sz
            d = be * (nx * ex + ny * ey + nz * ez)
            fx, fy, fz = al * ex + d * nx, al * ey + d * ny, al * ez + d * nz
            J += ex * fx + ey * fy + ez * fz
            ux -= fx
            uy -= fy
            uz -= fz
            wx += fy * qz - fz * qy
            wy += fz * qx - fx * qz
            wz += fx * qy - fy * qx
        g[i, 0], g[i, 1], g[i, 2], g[i, 3], g[i, 4], g[i, 5] = wx, wy, wz, ux, uy, uz
        objective[i] = J


@njit(nogil=True, error_model="numpy")
def landmark_chi2_kernel(detections, poses, l, begin, end, out, count):
    """Add ``eᵀ W e`` of each measurement to its landmark in ``out (L,)``, and one to ``count (L,)``."""
    for i in range(begin, end):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            sx, sy, sz, nx, ny, nz, al, be = _seen(R, detections, m)
            j = detections.landmark[m]
            ex, ey, ez = l[j, 0] - px - sx, l[j, 1] - py - sy, l[j, 2] - pz - sz
            d = nx * ex + ny * ey + nz * ez
            out[j] += al * (ex * ex + ey * ey + ez * ez) + be * d * d
            count[j] += 1


@njit(nogil=True, error_model="numpy")
def schur_diagonal(detections, poses, landmarks, begin, end, blocks):
    """Add the measurements' diagonal blocks of the Schur complement to ``blocks (N, 6, 6)``.

    Exact if a pose observes each landmark once; otherwise the block is too small by their common part.

    Parameters
    ----------
    landmarks : (l (L, 3), D⁻¹ (L, 6))
    """
    l, Di = landmarks
    C = np.empty((3, 3))
    B = np.empty((3, 3))
    for i in range(begin, end):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            nx, ny, nz, al, be = _seen(R, detections, m)[3:]
            j = detections.landmark[m]
            # C = W - W D⁻¹ W, with W a = α a + β n (n·a); t = D⁻¹ n
            a, c, d, e, f, g = Di[j, 0], Di[j, 1], Di[j, 2], Di[j, 3], Di[j, 4], Di[j, 5]
            tx, ty, tz = a * nx + c * ny + d * nz, c * nx + e * ny + f * nz, d * nx + f * ny + g * nz
            k = be - be * be * (nx * tx + ny * ty + nz * tz)
            h = al * be
            al2 = al * al
            xx = al + k * nx * nx - 2.0 * h * nx * tx - al2 * a
            xy = k * nx * ny - h * (nx * ty + ny * tx) - al2 * c
            xz = k * nx * nz - h * (nx * tz + nz * tx) - al2 * d
            yy = al + k * ny * ny - 2.0 * h * ny * ty - al2 * e
            yz = k * ny * nz - h * (ny * tz + nz * ty) - al2 * f
            zz = al + k * nz * nz - 2.0 * h * nz * tz - al2 * g
            qx, qy, qz = l[j, 0] - px, l[j, 1] - py, l[j, 2] - pz
            C[0, 0], C[0, 1], C[0, 2] = xx, xy, xz
            C[1, 0], C[1, 1], C[1, 2] = xy, yy, yz
            C[2, 0], C[2, 1], C[2, 2] = xz, yz, zz
            # B = [q]ᵀ C = -[q] C; blocks: ww = B [q], wu = -B, uu = C
            for r in range(3):
                B[0, r] = qz * C[1, r] - qy * C[2, r]
                B[1, r] = qx * C[2, r] - qz * C[0, r]
                B[2, r] = qy * C[0, r] - qx * C[1, r]
            for r in range(3):
                blocks[i, r, 0] += B[r, 1] * qz - B[r, 2] * qy
                blocks[i, r, 1] += B[r, 2] * qx - B[r, 0] * qz
                blocks[i, r, 2] += B[r, 0] * qy - B[r, 1] * qx
                for k2 in range(3):
                    blocks[i, r, 3 + k2] -= B[r, k2]
                    blocks[i, 3 + k2, r] -= B[r, k2]
                    blocks[i, 3 + r, 3 + k2] += C[r, k2]


@njit(nogil=True, error_model="numpy")
def gather_landmarks(detections, poses, l, v, begin, end, t):
    """First pass of the product: add ``Σ W (q × w - u)`` to ``t (L, 3)``."""
    for i in range(begin, end):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        wx, wy, wz, ux, uy, uz = v[i, 0], v[i, 1], v[i, 2], v[i, 3], v[i, 4], v[i, 5]
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            nx, ny, nz, al, be = _seen(R, detections, m)[3:]
            j = detections.landmark[m]
            qx, qy, qz = l[j, 0] - px, l[j, 1] - py, l[j, 2] - pz
            ax = qy * wz - qz * wy - ux
            ay = qz * wx - qx * wz - uy
            az = qx * wy - qy * wx - uz
            d = be * (nx * ax + ny * ay + nz * az)
            t[j, 0] += al * ax + d * nx
            t[j, 1] += al * ay + d * ny
            t[j, 2] += al * az + d * nz


@njit(nogil=True)
def solve_landmark_sums(Di, t, begin, end):
    """``t ← D⁻¹ t`` for landmarks ``begin … end - 1``."""
    for j in range(begin, end):
        x, y, z = t[j, 0], t[j, 1], t[j, 2]
        t[j, 0] = Di[j, 0] * x + Di[j, 1] * y + Di[j, 2] * z
        t[j, 1] = Di[j, 1] * x + Di[j, 3] * y + Di[j, 4] * z
        t[j, 2] = Di[j, 2] * x + Di[j, 4] * y + Di[j, 5] * z


@njit(nogil=True, error_model="numpy")
def scatter_to_poses(detections, poses, landmarks, v, begin, end, out):
    """Second pass: add ``f × q`` and ``-f``, f = W (q × w - u - t), to ``out (N, 6)``.

    Parameters
    ----------
    landmarks : (l (L, 3), t (L, 3))
    """
    l, t = landmarks
    for i in range(begin, end):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        wx, wy, wz, ux, uy, uz = v[i, 0], v[i, 1], v[i, 2], v[i, 3], v[i, 4], v[i, 5]
        yx = yy = yz = zx = zy = zz = 0.0
        for m in range(detections.first[i] - detections.base, detections.first[i + 1] - detections.base):
            nx, ny, nz, al, be = _seen(R, detections, m)[3:]
            j = detections.landmark[m]
            qx, qy, qz = l[j, 0] - px, l[j, 1] - py, l[j, 2] - pz
            ax = qy * wz - qz * wy - ux - t[j, 0]
            ay = qz * wx - qx * wz - uy - t[j, 1]
            az = qx * wy - qy * wx - uz - t[j, 2]
            d = be * (nx * ax + ny * ay + nz * az)
            fx, fy, fz = al * ax + d * nx, al * ay + d * ny, al * az + d * nz
            zx -= fx
            zy -= fy
            zz -= fz
            yx += fy * qz - fz * qy
            yy += fz * qx - fx * qz
            yz += fx * qy - fy * qx
        out[i, 0] += yx
        out[i, 1] += yy
        out[i, 2] += yz
        out[i, 3] += zx
        out[i, 4] += zy
        out[i, 5] += zz
