"""Compiled sensitivities of a smoothed submap to constant errors common to all its residuals."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import njit
from graphslam_frontends.landmarks.measurement_kernels import observe_landmark, wrap_angle_kernel
from graphslam_frontends.landmarks.smoothing_kernels import _at_optimum, _odometry_residual, bound_bearing_slopes


@njit(error_model="numpy")
def bias_sensitivities(poses, landmarks, evidence, along, seen):
    """Change of the optimum with constants common to all residuals, and the score of these constants.

    Parameters
    ----------
    along : (T, 3, c)
        Change of the odometry residual ``u⁻¹ ∘ (x_{k-1}⁻¹ ∘ x_k)`` with each constant, at fixed poses.
    seen : (q, 2, c)
        Change of measured minus predicted range and bearing, at fixed poses and landmarks.

    Returns
    -------
    moved : (T, 3, c)
        Of the poses, right tangents.
    shifted : (2L, c)
        Of the landmarks.
    score, information : (c,), (c, c)
        Of the constants, with poses and landmarks free.
    """
    T, n, c = len(poses), 2 * len(landmarks), along.shape[2]
    u, W, ob_pose, ob_lm, ob, weight, sensor = evidence
    Ainv, B, C, joint = _at_optimum(poses, landmarks, evidence)
    g, gl = np.zeros((T, 3, c)), np.zeros((n, c))  # minus the change of the gradient with the constants
    score, information = np.zeros(c), np.zeros((c, c))
    e, h, base = np.empty(6), np.empty(12), np.zeros(3)
    Jb, Ad = np.zeros((3, 3)), np.zeros((3, 3))
    Jb[2, 2], Ad[2, 2] = 1.0, 1.0
    for k in range(T):
        _odometry_residual(base if k == 0 else poses[k - 1], poses[k], u[k], e)
        co, si = math.cos(e[2]), math.sin(e[2])
        Jb[0, 0], Jb[0, 1], Jb[1, 0], Jb[1, 1] = co, -si, si, co
        D = np.ascontiguousarray(along[k])
        WD = W[k] @ D
        r = e[:3].copy()
        score -= WD.T @ r
        information += D.T @ WD
        g[k] -= Jb.T @ WD
        if k > 0:
            co, si = math.cos(e[5]), math.sin(e[5])
            ix, iy = -co * e[3] - si * e[4], si * e[3] - co * e[4]
            Ad[0, 0], Ad[0, 1], Ad[0, 2], Ad[1, 0], Ad[1, 1], Ad[1, 2] = co, si, iy, -si, co, -ix
            Ja = -Jb @ Ad
            g[k - 1] -= Ja.T @ WD
    for o in range(len(ob)):
        if weight[o] == 0.0:
            continue
        k, j = ob_pose[o], ob_lm[o]
        observe_landmark(poses[k, 0], poses[k, 1], poses[k, 2], sensor, landmarks[j, 0], landmarks[j, 1], h)
        n0, n1 = ob[o, 0] - h[0], wrap_angle_kernel(ob[o, 1] - h[1])
        bound_bearing_slopes(h, ob[o, 2])
        w0, w1 = weight[o] / ob[o, 2], weight[o] / ob[o, 3]
        for a in range(c):
            # measured minus predicted decreases by h' δ and changes by ``seen``
            d0, d1 = w0 * seen[o, 0, a], w1 * seen[o, 1, a]
            score[a] -= d0 * n0 + d1 * n1
            for b in range(c):
                information[a, b] += d0 * seen[o, 0, b] + d1 * seen[o, 1, b]
            for q in range(3):
                g[k, q, a] += h[2 + q] * d0 + h[5 + q] * d1
            for q in range(2):
                gl[2 * j + q, a] += h[8 + q] * d0 + h[10 + q] * d1
    own, own_l = g.copy(), gl.copy()
    for k in range(T - 1):
        gg = Ainv[k] @ g[k]
        g[k + 1] -= B[k].T @ gg
        gl -= C[k].T @ gg
    rhs = np.empty((3 + n, c))
    rhs[:3], rhs[3:] = g[T - 1], gl
    x = joint @ rhs
    moved = np.empty((T, 3, c))
    moved[T - 1] = x[:3]
    shifted = x[3:].copy()
    for k in range(T - 2, -1, -1):
        moved[k] = Ainv[k] @ (g[k] - B[k] @ moved[k + 1] - C[k] @ shifted)
    for k in range(T):
        information -= np.ascontiguousarray(own[k]).T @ moved[k]
    information -= own_l.T @ shifted
    return moved, shifted, score, 0.5 * (information + information.T)
