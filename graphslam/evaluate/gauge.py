"""NEES of a map whose frame does not matter: the rigid motion between map and truth is fitted, not trusted.

A map is known in the frame of its first base. Truth from outside knows that base only as well as it measures it, and a
small error of its heading moves everything that is far away. Judged *up to a rigid motion*, a map answers for its
shape alone: ``min_δ (e + G δ)ᵀ P⁻¹ (e + G δ)`` over the three numbers δ of a small motion of the truth, with as many
degrees of freedom less.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as sla

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array, ArrayLike


def gauge_directions(poses: ArrayLike, points: ArrayLike) -> Array:
    """How the vector ``[poses (x, y, θ) …, points (x, y) …]`` changes when everything is moved rigidly.

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


def aligned_nees(error: ArrayLike, covariance: ArrayLike, directions: ArrayLike) -> float:
    """Least NEES over all small rigid motions of the truth; ``n - 3`` degrees of freedom. First order in the motion.

    Parameters
    ----------
    error : (n,)
    covariance : (n, n)
    directions : (n, 3)
        :func:`gauge_directions`.
    """
    e, G = np.asarray(error, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    if e.ndim != 1 or G.shape != (len(e), 3) or len(e) <= 3:
        raise DataError("error and directions do not fit", got=(e.shape, G.shape), wanted="(n,) and (n, 3) with n > 3")
    L = np.linalg.cholesky(check_covariance(covariance, dim=len(e)))
    y = sla.solve_triangular(L, e, lower=True)
    Q, R = np.linalg.qr(sla.solve_triangular(L, G, lower=True))
    size = np.abs(np.diag(R))
    if size.min() < 1e-9 * size.max():
        raise CovarianceError("a rigid motion is not determined", got=f"{len(e)} scalars", wanted="two points apart")
    return float(y @ y - np.sum((Q.T @ y) ** 2))


def inner_covariance(covariance: ArrayLike, directions: ArrayLike) -> Array:
    """Covariance of a map's shape: what is left when the best rigid motion of it is taken out (inner constraints).

    The frame of the first base makes everything far from it look uncertain by the base's own heading. This is the
    covariance in the frame in which the map as a whole neither moves nor turns: ``S P Sᵀ`` with the projection
    ``S = 1 - G (GᵀG)⁻¹ Gᵀ`` (Meissl, 1962). It is singular by three.

    Parameters
    ----------
    covariance : (n, n)
    directions : (n, 3)
        :func:`gauge_directions`, counted from the middle of the map for a well-conditioned projection.
    """
    P, G = np.asarray(covariance, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    if G.shape != (len(P), 3):
        raise DataError("covariance and directions do not fit", got=(P.shape, G.shape), wanted="(n, n) and (n, 3)")
    Q, _ = np.linalg.qr(G)
    left = P - Q @ (Q.T @ P)
    out = left - (left @ Q) @ Q.T
    return np.asarray(0.5 * (out + out.T))
