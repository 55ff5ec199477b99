"""Numba kernels of the forward pass: poses in order, each aligned with older landmarks."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import callee, njit
from graphslam.skeleton.chain_kernels import _cholesky, _log, _solve, write_se3_exp


@njit(nogil=True)
def forward_pass_kernel(detections, chain_poses, span, rules, start_seen, D, b, out):
    """Process the poses in order: each is aligned with older landmarks, then its observations are added.

    Parameters
    ----------
    chain_poses : Poses
        Their increments predict the poses.
    span : (begin, end)
        Poses; earlier ones are finished.
    rules : (ago, turn, way, gate)
        A landmark is old if it was first observed more than ``ago`` poses earlier; prior information of a pose around
        its prediction [1/rad², 1/m²]; limit of χ²(3) for an observation.
    start_seen : (L,) int32
        Pose of the first observation of each landmark, initially -1; changed.
    D, b : (L, 6), (L, 3)
        Sums of weights and of weighted positions, initially zero; changed.
    out : Poses
        The first pose is that of the chain.

    Returns
    -------
    tied, refused : int
        Number of poses aligned with old landmarks; number of rejected observations of old landmarks.
    """
    ago, turn, shift, gate = rules
    rotation, position, points = chain_poses.rotation, chain_poses.position, detections.points
    A = np.empty((6, 6))
    x = np.empty(6)
    w = np.empty(3)
    E = np.empty((3, 3))
    T = np.empty((3, 3))
    Rp = np.empty((3, 3))
    pp = np.empty(3)
    most = 0
    for i in range(span[0], span[1]):
        most = max(most, detections.first[i + 1] - detections.first[i])
    seen = np.empty((most, 8))
    misfit = np.empty(most)
    which = np.empty(most, np.int64)
    believed = np.ones(most, np.bool_)
    aligned = refused = 0
    for i in range(span[0], span[1]):
        R, p = out.rotation[i], out.position[i]
        if i == 0:
            R[:] = rotation[0]
            p[:] = position[0]
        else:
            a, c = rotation[i - 1], rotation[i]
            Q, q0 = out.rotation[i - 1], out.position[i - 1]
            for r in range(3):
                for k in range(3):
                    T[r, k] = Q[r, 0] * a[k, 0] + Q[r, 1] * a[k, 1] + Q[r, 2] * a[k, 2]
            for r in range(3):
                p[r] = q0[r]
                for k in range(3):
                    R[r, k] = T[r, 0] * c[0, k] + T[r, 1] * c[1, k] + T[r, 2] * c[2, k]
                    p[r] += T[r, k] * (position[i, k] - position[i - 1, k])
        lo, hi = detections.first[i] - detections.base, detections.first[i + 1] - detections.base
        believed[: hi - lo] = True
        n = 0
        for m in range(lo, hi):
            j = detections.landmark[m]
            if start_seen[j] < 0 or i - start_seen[j] <= ago:
                continue
            # the running mean D⁻¹ b
            d0, d1, d2, d3, d4, d5 = D[j, 0], D[j, 1], D[j, 2], D[j, 3], D[j, 4], D[j, 5]
            xx, xy, xz = d3 * d5 - d4 * d4, d2 * d4 - d1 * d5, d1 * d4 - d2 * d3
            yy, yz, zz = d0 * d5 - d2 * d2, d2 * d1 - d0 * d4, d0 * d3 - d1 * d1
            over = 1.0 / (d0 * xx + d1 * xy + d2 * xz)
            seen[n, 0] = (xx * b[j, 0] + xy * b[j, 1] + xz * b[j, 2]) * over
            seen[n, 1] = (xy * b[j, 0] + yy * b[j, 1] + yz * b[j, 2]) * over
            seen[n, 2] = (xz * b[j, 0] + yz * b[j, 1] + zz * b[j, 2]) * over
            z0, z1, z2 = np.float64(points[m, 0]), np.float64(points[m, 1]), np.float64(points[m, 2])
            seen[n, 3], seen[n, 4], seen[n, 5] = z0, z1, z2
            r2 = z0 * z0 + z1 * z1 + z2 * z2
            seen[n, 6] = detections.across / r2
            seen[n, 7] = (detections.along - seen[n, 6]) / r2
            which[n] = m - lo
            n += 1
        if n >= 3:
            aligned += 1
            Rp[:] = R
            pp[:] = p
            limit = np.inf
            for step in range(3):
                A[:] = 0.0
                x[:] = 0.0
                for k in range(3):  # prior: rotation and translation from the prediction
                    A[k, k] = turn
                    A[3 + k, 3 + k] = shift
                    x[3 + k] = -shift * (p[k] - pp[k])
                for r in range(3):
                    for k in range(3):
                        E[r, k] = R[r, 0] * Rp[k, 0] + R[r, 1] * Rp[k, 1] + R[r, 2] * Rp[k, 2]
                _log(E, w)
                for k in range(3):
                    x[k] = -turn * w[k]
                for e in range(n):
                    z0, z1, z2, al, be = seen[e, 3], seen[e, 4], seen[e, 5], seen[e, 6], seen[e, 7]
                    sx = R[0, 0] * z0 + R[0, 1] * z1 + R[0, 2] * z2
                    sy = R[1, 0] * z0 + R[1, 1] * z1 + R[1, 2] * z2
                    sz = R[2, 0] * z0 + R[2, 1] * z1 + R[2, 2] * z2
                    qx, qy, qz = seen[e, 0] - p[0], seen[e, 1] - p[1], seen[e, 2] - p[2]
                    ex, ey, ez = qx - sx, qy - sy, qz - sz
                    d = sx * ex + sy * ey + sz * ez
                    misfit[e] = al * (ex * ex + ey * ey + ez * ez) + be * d * d
                if step > 0:
                    limit = max(gate, 9.0 * np.median(misfit[:n]))
                for e in range(n):
                    if misfit[e] > limit:
                        continue
                    z0, z1, z2, al, be = seen[e, 3], seen[e, 4], seen[e, 5], seen[e, 6], seen[e, 7]
                    sx = R[0, 0] * z0 + R[0, 1] * z1 + R[0, 2] * z2
                    sy = R[1, 0] * z0 + R[1, 1] * z1 + R[1, 2] * z2
                    sz = R[2, 0] * z0 + R[2, 1] * z1 + R[2, 2] * z2
                    qx, qy, qz = seen[e, 0] - p[0], seen[e, 1] - p[1], seen[e, 2] - p[2]
                    ex, ey, ez = qx - sx, qy - sy, qz - sz
                    d = be * (sx * ex + sy * ey + sz * ez)
                    fx, fy, fz = al * ex + d * sx, al * ey + d * sy, al * ez + d * sz
                    x[0] -= fy * qz - fz * qy
                    x[1] -= fz * qx - fx * qz
                    x[2] -= fx * qy - fy * qx
                    x[3] += fx
                    x[4] += fy
                    x[5] += fz
                    _add_weight(A, qx, qy, qz, sx, sy, sz, (al, be))
                _cholesky(A)
                _solve(A, x)
                for k in range(3):
                    w[k] = x[k]
                    p[k] += x[3 + k]
                write_se3_exp(w, E)
                for r in range(3):
                    for k in range(3):
                        T[r, k] = E[r, 0] * R[0, k] + E[r, 1] * R[1, k] + E[r, 2] * R[2, k]
                R[:] = T
            for e in range(n):
                z0, z1, z2, al, be = seen[e, 3], seen[e, 4], seen[e, 5], seen[e, 6], seen[e, 7]
                sx = R[0, 0] * z0 + R[0, 1] * z1 + R[0, 2] * z2
                sy = R[1, 0] * z0 + R[1, 1] * z1 + R[1, 2] * z2
                sz = R[2, 0] * z0 + R[2, 1] * z1 + R[2, 2] * z2
                ex, ey, ez = seen[e, 0] - p[0] - sx, seen[e, 1] - p[1] - sy, seen[e, 2] - p[2] - sz
                d = sx * ex + sy * ey + sz * ez
                if al * (ex * ex + ey * ey + ez * ez) + be * d * d > gate:
                    believed[which[e]] = False
                    refused += 1
        for m in range(lo, hi):
            if not believed[m - lo]:
                continue
            j = detections.landmark[m]
            z0, z1, z2 = np.float64(points[m, 0]), np.float64(points[m, 1]), np.float64(points[m, 2])
            r2 = z0 * z0 + z1 * z1 + z2 * z2
            al = detections.across / r2
            be = (detections.along - al) / r2
            sx = R[0, 0] * z0 + R[0, 1] * z1 + R[0, 2] * z2
            sy = R[1, 0] * z0 + R[1, 1] * z1 + R[1, 2] * z2
            sz = R[2, 0] * z0 + R[2, 1] * z1 + R[2, 2] * z2
            D[j, 0] += al + be * sx * sx
            D[j, 1] += be * sx * sy
            D[j, 2] += be * sx * sz
            D[j, 3] += al + be * sy * sy
            D[j, 4] += be * sy * sz
            D[j, 5] += al + be * sz * sz
            ax, ay, az = p[0] + sx, p[1] + sy, p[2] + sz
            d = be * (sx * ax + sy * ay + sz * az)
            b[j, 0] += al * ax + d * sx
            b[j, 1] += al * ay + d * sy
            b[j, 2] += al * az + d * sz
            if start_seen[j] < 0:
                start_seen[j] = i
    return aligned, refused


@callee
def _add_weight(A, qx, qy, qz, sx, sy, sz, weight):
    """Add ``Jᵀ W J``, J = [[q]× , -I], to a block (6, 6)."""
    al, be = weight
    # W = α I + β s sᵀ; columns of Jᵀ: rotation part a = s × q … (q × w)·s = w·(s × q)
    cx, cy, cz = sy * qz - sz * qy, sz * qx - sx * qz, sx * qy - sy * qx
    q2 = qx * qx + qy * qy + qz * qz
    A[0, 0] += al * (q2 - qx * qx) + be * cx * cx
    A[1, 1] += al * (q2 - qy * qy) + be * cy * cy
    A[2, 2] += al * (q2 - qz * qz) + be * cz * cz
    A[1, 0] += -al * qx * qy + be * cx * cy
    A[2, 0] += -al * qx * qz + be * cx * cz
    A[2, 1] += -al * qy * qz + be * cy * cz
    # lower left: u rows, w columns: -(W [q])
    A[3, 0] -= be * sx * cx
    A[3, 1] -= -al * qz + be * sx * cy
    A[3, 2] -= al * qy + be * sx * cz
    A[4, 0] -= al * qz + be * sy * cx
    A[4, 1] -= be * sy * cy
    A[4, 2] -= -al * qx + be * sy * cz
    A[5, 0] -= -al * qy + be * sz * cx
    A[5, 1] -= al * qx + be * sz * cy
    A[5, 2] -= be * sz * cz
    A[3, 3] += al + be * sx * sx
    A[4, 4] += al + be * sy * sy
    A[5, 5] += al + be * sz * sz
    A[4, 3] += be * sy * sx
    A[5, 3] += be * sz * sx
    A[5, 4] += be * sz * sy
