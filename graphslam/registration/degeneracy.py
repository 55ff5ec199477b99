"""Directions that a match does not determine: along a corridor, around a round room.

A matcher that pairs each point with its nearest neighbour finds *some* place along a corridor and is then as content as
anywhere. The Hessian tells: its least eigenvalue is small (Zhang, Kaess and Singh 2016, "On degeneracy of
optimization-based state estimation problems"), once what pairs and noisy normals feign is taken off it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.registration.target import flat_shapes


@dataclass(frozen=True, slots=True)
class Degeneracy:
    """Of the translational part of a Hessian.

    Parameters
    ----------
    ratio : float
        Least eigenvalue over the greatest, 0 … 1; 0 where nothing was matched.
    eigenvalues : (dim,)
        Rising.
    directions : (dim, dim)
        Column k belongs to eigenvalue k: a unit vector in the source frame.
    """

    ratio: float
    eigenvalues: Array
    directions: Array

    @property
    def weakest(self) -> Array:
        """Direction ``(dim,)`` that is held least, in the source frame."""
        return self.directions[:, 0]


def translation_of(dim: int) -> slice:
    """Where the translation stands in a tangent vector: behind the rotation in 3-D, before it in 2-D."""
    return slice(0, 2) if dim == 2 else slice(3, 6)


def translational_degeneracy(hessian: Array, dim: int) -> Degeneracy:
    """Eigenvalues of the translational block of a Hessian in the right tangent ``(d, d)``."""
    block = hessian[translation_of(dim), translation_of(dim)]
    values, vectors = np.linalg.eigh(0.5 * (block + block.T))
    ratio = float(max(values[0], 0.0) / values[-1]) if values[-1] > 0 else 0.0
    return Degeneracy(ratio, values, vectors)


def noise_induced_information(
    source: Array, rotation: Array, normals: tuple[Array, Array], noise: tuple[Array, Array]
) -> Array:
    """The part of a Hessian that holds nothing, though it looks as if it did.

    Two things feign. A pair of flat shapes, of variance 1 along each, holds even their common plane, with weight ½; but
    the points of a surface are not the same ones when it is scanned again. And normals are noisy: in a corridor they
    are tilted along it at random, which adds up to what looks like a weak hold. With the pair's normal m ± δ and its
    weight w, the Hessian has ``w (m mᵀ + cov δ)`` on average where it ought to have ``w m mᵀ``.

    Parameters
    ----------
    source : (m, dim)
        Points that have a pair, source frame.
    rotation : (dim, dim)
        Source to target.
    normals : two of (m, dim)
        Of the paired source points in the source frame, of their partners in the target frame.
    noise : two of (m, dim, dim)
        Covariances of these; see :meth:`graphslam.registration.target.Target.normals`.

    Returns
    -------
    (d, d)
        ``Σ Jᵀ (½ I + w cov δ) J``, J as for the Hessian: ``R [-[p]×, I]`` (right tangent, rotation first) or, in two
        dimensions, ``R [I, p⊥]``.
    """
    dim = source.shape[1]
    partners = normals[1] @ rotation  # in the source frame, as everything below
    M = np.linalg.inv(flat_shapes(normals[0]) + flat_shapes(partners))
    w = np.trace(M, axis1=1, axis2=2) - 0.5 * (dim - 1)
    cov = 0.25 * (noise[0] + rotation.T @ noise[1] @ rotation)  # the pair's normal is the mean of two
    S = 0.5 * np.eye(dim) + w[:, None, None] * cov
    if dim == 2:
        J = np.zeros((len(source), 2, 3))
        J[:, :, :2] = np.eye(2)
        J[:, 0, 2], J[:, 1, 2] = -source[:, 1], source[:, 0]
    else:
        J = np.zeros((len(source), 3, 6))
        J[:, :, :3] = -se3.skew(source)
        J[:, :, 3:] = np.eye(3)
    return np.einsum("mki,mkj->ij", J, S @ J)


def calibrated_covariance(
    information: Array,
    *,
    dim: int,
    scale: float,
    sigma: tuple[float, float],
    unknown: tuple[float, float],
    threshold: float,
) -> Array:
    """Covariance of a match from its Hessian.

    Parameters
    ----------
    information : (d, d)
        Hessian in the right tangent, without what is feigned.
    scale : float
        Of the inverse: pairs are neither independent, nor is their noise the one assumed.
    sigma : (float, float)
        σ of translation [m] and rotation [rad] that no number of pairs gets below: what the two clouds have in common
        that is wrong.
    unknown : (float, float)
        σ of translation and rotation before the match: no direction is known less well than that.
    threshold : float
        Directions of translation with less than this share of the greatest eigenvalue were not measured, and are as
        unknown as before.

    Returns
    -------
    (d, d)
        Positive definite.
    """
    d = len(information)
    move = translation_of(dim)

    def per_axis(pair: tuple[float, float]) -> Array:
        v = np.full(d, pair[1] ** 2)
        v[move] = pair[0] ** 2
        return v

    values, vectors = np.linalg.eigh(0.5 * (information + information.T) / scale)
    # what was feigned is an average: a little more than there was may have been taken off
    held = (vectors * np.maximum(values, 0.0)) @ vectors.T + np.diag(1.0 / per_axis(unknown))
    found = translational_degeneracy(information, dim)
    cov = np.linalg.inv(held) + np.diag(per_axis(sigma))
    for k in np.flatnonzero(found.eigenvalues < threshold * found.eigenvalues[-1]):
        axis = np.zeros(d)
        axis[move] = found.directions[:, k]
        # no more than was unknown before, whatever the rest of the covariance has along that axis
        cov += max(unknown[0] ** 2 - float(axis @ cov @ axis), 0.0) * np.outer(axis, axis)
    return 0.5 * (cov + cov.T)
