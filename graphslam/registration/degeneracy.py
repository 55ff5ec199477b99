"""Directions that a match does not determine: along a corridor, around a round room.

Matching with nearest neighbours converges at *some* place along a corridor. The Hessian shows the degeneracy: its least
eigenvalue is small (Zhang, Kaess and Singh 2016, "On degeneracy of optimization-based state estimation problems"),
after spurious information from pairs and noisy normals is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.registration.target import flat_shapes


@dataclass(frozen=True, slots=True)
class Degeneracy:
    """Degeneracy of the translational part of a Hessian.

    Parameters
    ----------
    ratio : float
        Least eigenvalue over the largest, 0 … 1; 0 without a match.
    eigenvalues : (dim,)
        Ascending.
    directions : (dim, dim)
        Column k belongs to eigenvalue k: a unit vector in the source frame.
    """

    ratio: float
    eigenvalues: Array
    directions: Array

    @property
    def weakest(self) -> Array:
        """Least determined direction ``(dim,)`` in the source frame."""
        return self.directions[:, 0]


def translation_of(dim: int) -> slice:
    """Indices of the translation in a tangent vector: after the rotation in 3-D, before it in 2-D."""
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
    """The spurious part of a Hessian.

    It has two causes. A pair of flat shapes, with variance 1 along each, constrains even motion in the common plane,
    with weight ½; but repeated scans do not hit the same points of a surface. And normals are noisy: in a corridor
    their random tilts add up to spurious information along it. With the pair's normal m ± δ and its weight w, the
    Hessian has ``w (m mᵀ + cov δ)`` on average in place of ``w m mᵀ``.

    Parameters
    ----------
    source : (m, dim)
        Paired points, source frame.
    rotation : (dim, dim)
        Source to target.
    normals : two of (m, dim)
        Of the paired source points in the source frame, of their partners in the target frame.
    noise : two of (m, dim, dim)
        Covariances of these; see :meth:`graphslam.registration.target.Target.normals`.

    Returns
    -------
    (d, d)
        ``Σ Jᵀ (½ I + w cov δ) J``, with J of the Hessian: ``R [-[p]×, I]`` (right tangent, rotation first) or, in 2-D,
        ``R [I, p⊥]``.
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
        Hessian in the right tangent, without its spurious part.
    scale : float
        Factor on the inverse: pairs are not independent, and their noise differs from the model.
    sigma : (float, float)
        Lower limit of σ of translation [m] and rotation [rad] for any number of pairs: common errors of the clouds.
    unknown : (float, float)
        σ of translation and rotation before the match: upper limit in all directions.
    threshold : float
        Translations with an eigenvalue below this share of the largest count as not measured, and keep their prior σ.

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
    # the spurious part is an average and can exceed the actual one: clip at 0
    held = (vectors * np.maximum(values, 0.0)) @ vectors.T + np.diag(1.0 / per_axis(unknown))
    found = translational_degeneracy(information, dim)
    cov = np.linalg.inv(held) + np.diag(per_axis(sigma))
    for k in np.flatnonzero(found.eigenvalues < threshold * found.eigenvalues[-1]):
        axis = np.zeros(d)
        axis[move] = found.directions[:, k]
        # prior variance along that axis, whatever the covariance has there
        cov += max(unknown[0] ** 2 - float(axis @ cov @ axis), 0.0) * np.outer(axis, axis)
    return 0.5 * (cov + cov.T)
