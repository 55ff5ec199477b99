"""Directions of a body pose that points on surfaces constrain."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from graphslam.core import se3
from graphslam.core.geometry import Array

CLEARLY = 4.0
"""Least ratio of the information of surfaces to the spurious information from noise of the normals."""


def full_rank_information(points: Array, information: Array) -> Array:
    """Information ``(w, w)`` if each point ``(k, d)``, body frame, were constrained along every axis."""
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
    """Information of surfaces along each direction, relative to the spurious information from noise of their normals.

    Normals are estimated from noisy points. Those of a straight wall are rotated at random by some σ, so that they seem
    to constrain the direction along the wall, too. Information that is not well above this is spurious.

    Parameters
    ----------
    information : (w, w)
        ``Jᵀ Λ J`` of points on their surfaces.
    every : (w, w)
        Of :func:`full_rank_information`: of the same points, if each were constrained along every axis.
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


def observable_directions(information: Array, every: Array, sigma: float, unobservable: Array) -> Array:
    """Matrix ``(m, w)`` from ``Jᵀ Λ r`` to m ≤ w values of unit noise, for the directions that surfaces constrain.

    Parameters
    ----------
    information, every, sigma
        Of one scan, as in :func:`direction_strengths`.
    unobservable : (w, k)
        Directions to marginalise first: one scan estimates them slightly rotated, and would leak their error into
        others.
    """
    w, u = len(information), unobservable.shape[1]
    given_up = np.eye(w)
    if u:
        B = information @ unobservable
        given_up -= B @ np.linalg.solve(unobservable.T @ B, unobservable.T)
    left = given_up @ information
    values, V = direction_strengths(0.5 * (left + left.T), every, sigma)
    held = values > CLEARLY
    held[:u] = False
    return np.asarray((V[:, held] / np.sqrt(values[held])).T @ given_up)
