"""Which directions of a body the surfaces hold that its points lie on."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from graphslam.core import se3
from graphslam.core.geometry import Array

CLEARLY = 4.0
"""How many times what noise of the normals would say of a direction surfaces must say of it."""


def full_rank_information(points: Array, information: Array) -> Array:
    """Information ``(w, w)`` of points ``(k, d)``, frame of the body, that would hold it along every axis."""
    d = points.shape[1]
    first, second = information @ points, (points.T * information) @ points
    total = float(information.sum())
    if d == 2:
        out = np.diag([total, total, float(np.trace(second))])
        out[2, :2] = out[:2, 2] = -first[1], first[0]
        return out
    out = np.zeros((6, 6))
    out[:3, :3] = np.trace(second) * np.eye(3) - second
    out[:3, 3:] = se3.skew(first)
    out[3:, :3] = out[:3, 3:].T
    out[3:, 3:] = total * np.eye(3)
    return out


def direction_strengths(information: Array, every: Array, sigma: float) -> tuple[Array, Array]:
    """By how many times surfaces hold a body better than noise of their normals would pretend to, and where to.

    Normals are found among points that are themselves noisy. Those of a straight wall are therefore turned a little to
    and fro, each by some σ, and seem to hold a body along the wall too; what is not well above that is no
    information.

    Parameters
    ----------
    information : (w, w)
        ``Jᵀ Λ J`` of points on their surfaces.
    every : (w, w)
        Of :func:`full_rank_information`: what the same points would say with their normals turned anyhow.
    sigma : float
        Of a normal [rad].

    Returns
    -------
    values : (w,)
        Ascending.
    V : (w, w)
        Directions as columns.
    """
    values, V = scipy.linalg.eigh(information, sigma**2 * (every - information) + 1e-9 * every)
    return values, V


def observable_directions(information: Array, every: Array, sigma: float, unheld: Array) -> Array:
    """Rows ``(m, w)`` that take ``Jᵀ Λ r`` to m ≤ w numbers of unit noise, of the directions that surfaces hold.

    Parameters
    ----------
    information, every, sigma
        Of one scan, as in :func:`direction_strengths`.
    unheld : (w, k)
        Directions that are given up first, whatever this scan says of them: they are solved for and forgotten. One scan
        alone has them a little askew, and would say across what it must not say along.
    """
    w, u = len(information), unheld.shape[1]
    given_up = np.eye(w)
    if u:
        B = information @ unheld
        given_up -= B @ np.linalg.solve(unheld.T @ B, unheld.T)
    left = given_up @ information
    values, V = direction_strengths(0.5 * (left + left.T), every, sigma)
    held = values > CLEARLY
    held[:u] = False
    return np.asarray((V[:, held] / np.sqrt(values[held])).T @ given_up)
