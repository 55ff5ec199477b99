"""NEES of a map up to a rigid motion, which is fitted between map and ground truth.

A map is estimated in the frame of its first base. External ground truth measures the pose of that base with an error,
and a small heading error moves all distant points. *Up to a rigid motion* only the shape of the map is tested: ``min_T
e(T)ᵀ P⁻¹ e(T)`` over the rigid motions ``T`` of the truth, with three fewer degrees of freedom.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as sla

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array, ArrayLike, align_se2, se2_compose, se2_inverse, se2_transform
from graphslam.evaluate.consistency import vector_pose_error


def gauge_directions(poses: ArrayLike, points: ArrayLike) -> Array:
    """Derivative of the vector ``[poses (x, y, θ) …, points (x, y) …]`` with respect to a rigid motion of the map.

    Parameters
    ----------
    poses : (m, 3)
    points : (n, 2)

    Returns
    -------
    (3m + 2n, 3)
        Columns: along x [m], along y [m], turned about the origin [rad].
    """
    x, l = np.asarray(poses, dtype=np.float64).reshape(-1, 3), np.asarray(points, dtype=np.float64).reshape(-1, 2)
    m = len(x)
    G = np.zeros((3 * m + 2 * len(l), 3))
    for first, width, p in ((0, 3, x), (3 * m, 2, l)):
        rows = first + width * np.arange(len(p))
        G[rows, 0] = G[rows + 1, 1] = 1.0
        G[rows, 2], G[rows + 1, 2] = -p[:, 1], p[:, 0]
    G[2 : 3 * m : 3, 2] = 1.0
    return G


def aligned_nees(
    poses: ArrayLike, points: ArrayLike, truth: tuple[ArrayLike, ArrayLike], covariance: ArrayLike
) -> float:
    """Least NEES over all rigid motions of the ground truth; ``3m + 2n - 3`` degrees of freedom.

    Gauss-Newton on the motion, started at the least-squares alignment of true with estimated positions.

    Parameters
    ----------
    poses, points : (m, 3), (n, 2)
        Estimated.
    truth : ((m, 3), (n, 2))
        In any frame.
    covariance : (3m + 2n, 3m + 2n)
        Of poses, then points.
    """
    x, l = np.asarray(poses, dtype=np.float64).reshape(-1, 3), np.asarray(points, dtype=np.float64).reshape(-1, 2)
    u, v = (np.asarray(t, dtype=np.float64).reshape(-1, w) for t, w in zip(truth, (3, 2)))
    size = x.size + l.size
    if (x.shape, l.shape) != (u.shape, v.shape) or size <= 3:
        raise DataError(
            "estimate and truth do not fit", got=(u.shape, v.shape), wanted=f"{(x.shape, l.shape)}, above 3"
        )
    L = np.linalg.cholesky(check_covariance(covariance, dim=size))
    at, true = np.vstack([x[:, :2], l]), np.vstack([u[:, :2], v])
    T = align_se2(true, at) if len(at) > 1 else se2_compose(x[0], se2_inverse(u[0]))

    def whitened(T: Array) -> tuple[Array, Array, Array]:
        moved, there = se2_compose(T, u), se2_transform(T, v)
        e = np.concatenate([vector_pose_error(x, moved).ravel(), (there - l).ravel()])
        return sla.solve_triangular(L, e, lower=True), moved, there

    y, moved, there = whitened(T)
    for _ in range(50):
        Q, R = np.linalg.qr(sla.solve_triangular(L, gauge_directions(moved, there), lower=True))
        scale = np.abs(np.diag(R))
        if scale.min() < 1e-9 * scale.max():
            raise CovarianceError("a rigid motion is not determined", got=f"{size} scalars", wanted="two points apart")
        step = -sla.solve_triangular(R, Q.T @ y)
        for _ in range(30):  # halve the step until the sum decreases
            tried = whitened(se2_compose(step, T))
            if tried[0] @ tried[0] <= y @ y:
                break
            step = 0.5 * step
        gained = y @ y - tried[0] @ tried[0]
        if not gained > 1e-12 * max(float(y @ y), 1.0):
            break
        T, (y, moved, there) = se2_compose(step, T), tried
    return float(y @ y)


def inner_covariance(covariance: ArrayLike, directions: ArrayLike) -> Array:
    """Covariance of a map's shape, without rigid motions (inner constraints).

    In the frame of the first base the variance of distant points contains that of the base's heading. Here the gauge is
    that the map as a whole neither translates nor rotates: ``S P Sᵀ`` with the projection ``S = 1 - G (GᵀG)⁻¹ Gᵀ``
    (Meissl, 1962). Its rank is n - 3 at most.

    Parameters
    ----------
    covariance : (n, n)
    directions : (n, 3)
        :func:`gauge_directions`, with the origin at the centre of the map, for a well-conditioned projection.
    """
    P, G = np.asarray(covariance, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    if G.shape != (len(P), 3):
        raise DataError("covariance and directions do not fit", got=(P.shape, G.shape), wanted="(n, n) and (n, 3)")
    Q, _ = np.linalg.qr(G)
    left = P - Q @ (Q.T @ P)
    out = left - (left @ Q) @ Q.T
    return np.asarray(0.5 * (out + out.T))
