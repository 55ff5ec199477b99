"""Numba kernels of odometry and tilt factors, and block-tridiagonal algebra.

Poses are perturbed in the world frame, ``R ← Exp(w) R``, ``p ← p + u``; vectors are ``(N, 6)``: w, then u. A chain of
blocks is ``diagonal (N, 6, 6)`` and ``upper (N - 1, 6, 6)``, the blocks (i, i + 1). Plain arrays only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit

Array = npt.NDArray[np.float64]


class ChainArrays(NamedTuple):
    """Odometry and tilt of all poses."""

    rotation: Array
    """(N - 1, 3, 3): rotation from each pose to the next, in the body frame …"""
    translation: Array
    """(N - 1, 3): … and translation [m]."""
    information: Array
    """(1, 6, 6) or (N - 1, 6, 6): information of rotation vector, then translation."""
    up: Array
    """(N, 3): measured upward direction in the body frame."""
    up_information: Array
    """(1,) or (N,): its information [1/rad²]; zero if not measured."""


@callee
def _log(R, r):
    """Rotation vector of a rotation matrix, below half a turn."""
    c = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    q = x * x + y * y + z * z
    if q < 2e-3 and c > 0.0:  # asin(s) / s; truncation error below 1e-15
        k = 1.0 + q * (1.0 / 6.0 + q * (3.0 / 40.0 + q * (15.0 / 336.0 + q * 105.0 / 3456.0)))
    else:
        s = np.sqrt(q)
        k = np.arctan2(s, c) / max(s, 1e-300)
    r[0], r[1], r[2] = k * x, k * y, k * z


@callee
def write_se3_exp(w, R):
    """Write ``Exp(w)`` to ``R (3, 3)``."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < 1e-8:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = np.sqrt(t2)
        a, b = np.sin(t) / t, 2.0 * np.sin(0.5 * t) ** 2 / t2
    x, y, z = w[0], w[1], w[2]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@njit(nogil=True)
def move_chain(rotation, position, step, scale, rotation_out, position_out):
    """Move every pose by ``scale * step`` (N, 6); rotations are orthonormalised to second order."""
    E = np.empty((3, 3))
    w = np.empty(3)
    A = np.empty((3, 3))
    for i in range(len(position)):
        for k in range(3):
            w[k] = scale * step[i, k]
            position_out[i, k] = position[i, k] + scale * step[i, 3 + k]
        write_se3_exp(w, E)
        for r in range(3):
            for c in range(3):
                A[r, c] = E[r, 0] * rotation[i, 0, c] + E[r, 1] * rotation[i, 1, c] + E[r, 2] * rotation[i, 2, c]
        # A ← A (3 I - Aᵀ A) / 2, one Newton step to the nearest rotation
        for r in range(3):
            for c in range(3):
                s = 0.0
                for k in range(3):
                    s += A[r, k] * (A[0, k] * A[0, c] + A[1, k] * A[1, c] + A[2, k] * A[2, c])
                rotation_out[i, r, c] = 1.5 * A[r, c] - 0.5 * s


@njit(nogil=True)
def compose_odometry(rotation, translation, R, p):
    """Fill ``R (N, 3, 3)`` and ``p (N, 3)`` from their first pose by the chain's increments."""
    for i in range(len(translation)):
        for r in range(3):
            p[i + 1, r] = p[i, r]
            for c in range(3):
                p[i + 1, r] += R[i, r, c] * translation[i, c]
                R[i + 1, r, c] = (
                    R[i, r, 0] * rotation[i, 0, c] + R[i, r, 1] * rotation[i, 1, c] + R[i, r, 2] * rotation[i, 2, c]
                )


@callee
def odometry_residual(chain, poses, k, r, J):
    """Residual (6,) of odometry k and the left half (6, 6) of its Jacobian with respect to pose k + 1.

    For pose k it is the negative, plus ``Rᵀ (p' - p) ×`` for the rotation of pose k; see :func:`linearise_chain`.
    """
    Ra, Rb = poses.rotation[k], poses.rotation[k + 1]
    A = np.empty((3, 3))
    E = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            A[i, j] = Ra[0, i] * Rb[0, j] + Ra[1, i] * Rb[1, j] + Ra[2, i] * Rb[2, j]
    Z = chain.rotation[k]
    for i in range(3):
        for j in range(3):
            E[i, j] = Z[0, i] * A[0, j] + Z[1, i] * A[1, j] + Z[2, i] * A[2, j]
    _log(E, r)
    dx = poses.position[k + 1, 0] - poses.position[k, 0]
    dy = poses.position[k + 1, 1] - poses.position[k, 1]
    dz = poses.position[k + 1, 2] - poses.position[k, 2]
    for i in range(3):
        r[3 + i] = Ra[0, i] * dx + Ra[1, i] * dy + Ra[2, i] * dz - chain.translation[k, i]
    # inverse right Jacobian of the rotation residual: I + [r]/2 + c [r]²
    t2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    t = np.sqrt(t2)
    c = 1.0 / 12.0 + t2 / 720.0 if t < 1e-2 else 1.0 / t2 - 0.5 * np.cos(0.5 * t) / (t * np.sin(0.5 * t))
    x, y, z = r[0], r[1], r[2]
    A[0, 0], A[0, 1], A[0, 2] = 1.0 - c * (y * y + z * z), c * x * y - 0.5 * z, c * x * z + 0.5 * y
    A[1, 0], A[1, 1], A[1, 2] = c * x * y + 0.5 * z, 1.0 - c * (x * x + z * z), c * y * z - 0.5 * x
    A[2, 0], A[2, 1], A[2, 2] = c * x * z - 0.5 * y, c * y * z + 0.5 * x, 1.0 - c * (x * x + y * y)
    for i in range(3):
        for j in range(3):
            J[i, j] = A[i, 0] * Rb[j, 0] + A[i, 1] * Rb[j, 1] + A[i, 2] * Rb[j, 2]
            J[i, 3 + j] = 0.0
            J[3 + i, j] = 0.0
            J[3 + i, 3 + j] = Ra[j, i]
    return dx, dy, dz


@callee
def _sandwich(X, P, Y, M, row, column):
    """Write ``Xᵀ P Y`` of three (3, 3) to a corner of ``M``."""
    for i in range(3):
        a = X[0, i] * P[0, 0] + X[1, i] * P[1, 0] + X[2, i] * P[2, 0]
        b = X[0, i] * P[0, 1] + X[1, i] * P[1, 1] + X[2, i] * P[2, 1]
        c = X[0, i] * P[0, 2] + X[1, i] * P[1, 2] + X[2, i] * P[2, 2]
        for j in range(3):
            M[row + i, column + j] = a * Y[0, j] + b * Y[1, j] + c * Y[2, j]


@njit(nogil=True)
def linearise_chain(chain, poses, span, blocks, diagonal, upper, g):
    """Add half the gradient of odometry and tilt to ``g (N, 6)``, optionally their blocks. Returns Σ rᵀ Ω r.

    For the poses ``begin … end - 1`` of the span: their tilt, and the odometry starting at them.

    Odometry: with J the derivative by the later pose, that by the earlier one is ``-J T``, T = [[I, 0], [-[d]×, I]], d
    the translation between both. So with ``M = Jᵀ Ω J`` the blocks are ``Tᵀ M T``, ``-Tᵀ M`` and ``M``. Tilt:
    ``Rᵀ e_z - m`` of two unit vectors, isotropic; in the world frame its derivative with respect to w is ``e_z × w``.
    """
    N = len(poses.position)
    J, M, A = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    r, f, h = np.empty(6), np.empty(6), np.empty(6)
    total = 0.0
    for k in range(span[0], min(span[1], N - 1)):
        x, y, z = odometry_residual(chain, poses, k, r, J)
        O = chain.information[k if len(chain.information) > 1 else 0]
        for i in range(6):
            f[i] = O[i, 0] * r[0] + O[i, 1] * r[1] + O[i, 2] * r[2] + O[i, 3] * r[3] + O[i, 4] * r[4] + O[i, 5] * r[5]
            total += r[i] * f[i]
        for i in range(3):
            h[i] = J[0, i] * f[0] + J[1, i] * f[1] + J[2, i] * f[2]
            h[3 + i] = J[3, 3 + i] * f[3] + J[4, 3 + i] * f[4] + J[5, 3 + i] * f[5]
        for i in range(6):
            g[k + 1, i] += h[i]
        g[k, 0] -= h[0] + y * h[5] - z * h[4]
        g[k, 1] -= h[1] + z * h[3] - x * h[5]
        g[k, 2] -= h[2] + x * h[4] - y * h[3]
        g[k, 3] -= h[3]
        g[k, 4] -= h[4]
        g[k, 5] -= h[5]
        if not blocks:
            continue
        turn, shift = J[:3, :3], J[3:, 3:]
        _sandwich(turn, O[:3, :3], turn, M, 0, 0)
        _sandwich(turn, O[:3, 3:], shift, M, 0, 3)
        _sandwich(shift, O[3:, 3:], shift, M, 3, 3)
        for i in range(3):
            for j in range(3):
                M[3 + i, j] = M[j, 3 + i]
        for j in range(6):  # A = Tᵀ M
            A[0, j] = M[0, j] - z * M[4, j] + y * M[5, j]
            A[1, j] = M[1, j] + z * M[3, j] - x * M[5, j]
            A[2, j] = M[2, j] - y * M[3, j] + x * M[4, j]
            A[3, j], A[4, j], A[5, j] = M[3, j], M[4, j], M[5, j]
        D, E, U = diagonal[k], diagonal[k + 1], upper[k]
        for i in range(6):
            D[i, 0] += A[i, 0] - z * A[i, 4] + y * A[i, 5]
            D[i, 1] += A[i, 1] + z * A[i, 3] - x * A[i, 5]
            D[i, 2] += A[i, 2] - y * A[i, 3] + x * A[i, 4]
            for j in range(3):
                D[i, 3 + j] += A[i, 3 + j]
            for j in range(6):
                E[i, j] += M[i, j]
                U[i, j] -= A[i, j]
    for i in range(span[0], span[1]):
        a = chain.up_information[i if len(chain.up_information) > 1 else 0]
        R, m3 = poses.rotation[i], chain.up[i]
        x = R[0, 0] * m3[0] + R[0, 1] * m3[1] + R[0, 2] * m3[2]
        y = R[1, 0] * m3[0] + R[1, 1] * m3[1] + R[1, 2] * m3[2]
        z = R[2, 0] * m3[0] + R[2, 1] * m3[1] + R[2, 2] * m3[2]
        total += a * (x * x + y * y + (1.0 - z) * (1.0 - z))
        g[i, 0] -= a * y  # e_z × R m
        g[i, 1] += a * x
        if blocks:
            diagonal[i, 0, 0] += a
            diagonal[i, 1, 1] += a
    return total


@njit(nogil=True)
def chain_product(diagonal, upper, v, begin, end, out):
    """Write the product of a chain of blocks with ``v (N, 6)`` to the rows ``begin … end - 1`` of ``out``."""
    N = len(diagonal)
    for i in range(begin, end):
        for r in range(6):
            s = 0.0
            for c in range(6):
                s += diagonal[i, r, c] * v[i, c]
            out[i, r] = s
        if i + 1 < N:
            for r in range(6):
                s = 0.0
                for c in range(6):
                    s += upper[i, r, c] * v[i + 1, c]
                out[i, r] += s
        if i > 0:
            for c in range(6):
                for r in range(6):
                    out[i, r] += upper[i - 1, c, r] * v[i - 1, c]


@callee
def _cholesky(A):
    """Lower Cholesky factor in place of a block (6, 6); False if it is not positive definite."""
    for j in range(6):
        s = A[j, j]
        for k in range(j):
            s -= A[j, k] * A[j, k]
        if not s > 0.0:
            return False
        A[j, j] = np.sqrt(s)
        over = 1.0 / A[j, j]
        for i in range(j + 1, 6):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s * over
    return True


@callee
def _solve(L, x):
    for i in range(6):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@njit(nogil=True)
def solve_chain(diagonal, upper, x):
    """Solve a chain of blocks in place of ``x (N, 6)`` by elimination; ``diagonal`` and ``upper`` are overwritten.

    Returns the first pose whose block is not positive definite, or -1.
    """
    N = len(x)
    column = np.empty(6)
    for i in range(N):
        if not _cholesky(diagonal[i]):
            return i
        _solve(diagonal[i], x[i])
        if i + 1 == N:
            break
        U = upper[i].copy()
        for c in range(6):
            for r in range(6):
                column[r] = U[r, c]
            _solve(diagonal[i], column)
            for r in range(6):
                upper[i, r, c] = column[r]
        for r in range(6):
            for c in range(6):
                s = 0.0
                for k in range(6):
                    s += U[k, r] * upper[i, k, c]
                diagonal[i + 1, r, c] -= s
            for k in range(6):
                x[i + 1, r] -= U[k, r] * x[i, k]
    for i in range(N - 2, -1, -1):
        for r in range(6):
            for k in range(6):
                x[i, r] -= upper[i, r, k] * x[i + 1, k]
    return -1


@njit(nogil=True)
def invert_blocks(blocks, begin, end):
    """Replace blocks (6, 6) by their inverses; returns the first that is not positive definite, or -1."""
    L = np.empty((6, 6))
    x = np.empty(6)
    for i in range(begin, end):
        L[:] = blocks[i]
        if not _cholesky(L):
            return i
        for c in range(6):
            x[:] = 0.0
            x[c] = 1.0
            _solve(L, x)
            for r in range(6):
                blocks[i, r, c] = x[r]
    return -1


@njit(nogil=True)
def multiply_blocks(blocks, v, begin, end, out):
    """Write ``blocks[i] v[i]`` to the rows ``begin … end - 1`` of ``out (N, 6)``."""
    for i in range(begin, end):
        for r in range(6):
            s = 0.0
            for c in range(6):
                s += blocks[i, r, c] * v[i, c]
            out[i, r] = s
