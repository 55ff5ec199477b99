"""Localisation in a map by a temporary particle filter: quality and precision of a match (SegSLAM eq. 19).

Unlike registration it needs no surface normals and no correspondences. It gives the quality (range error) and the
precision (remaining spread).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of, pose_mean, pose_scatter
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.likelihood import EndpointLikelihood, log_weights
from graphslam.evidence.queries import cast_grids
from graphslam_frontends.grid.particles import effective_sample_size, normalise_log_weights, systematic_resample
from graphslam_frontends.segslam.segmentation import LookAheadWindow

_SHRINK = 0.95  # shrinkage about the mean before the cloud is blurred to its old covariance (Liu & West 2001)


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalisationConfig:
    """The temporary particle filter that checks a match (eq. 19)."""

    particles: int = 100
    """Number of poses, sampled around the start."""
    rounds: int = 4
    """Number of rounds of weighting and resampling, each with an equal part of the likelihood."""
    position: float = 0.4
    """σ of the samples in position [m]."""
    angle: float = 0.05
    """σ of the samples in heading [rad]; roll and pitch are those of the start."""
    effective_beams: float = 60.0
    """Effective number of independent beams of the window."""
    cast_sigma: float = 0.2
    """σ of the ranges in the range error [m]: the unit of ``clip``."""
    clip: float = 3.0
    """Range errors are limited to this many σ."""


LOCALISATION = LocalisationConfig()
"""Default for the matches of SegSLAM."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanLocalisation:
    """Pose of a scan in a map.

    Parameters
    ----------
    pose : (7,) or (3,)
        ``T_map_body``, mean of the cloud.
    covariance : (d, d)
        Of the cloud, right tangent. Roll and pitch were not searched and have zero variance.
    error : float
        err_X: mean squared difference of measured and expected ranges at ``pose``, each limited [m²].
    spread : float
        ``|Σ_X|`` of the position as a length: the 2·dim-th root of its determinant [m].
    effective : float
        Smallest N_eff / N of the rounds.
    """

    pose: Array
    covariance: Array
    error: float
    spread: float
    effective: float


def localise_in_map(
    grid: EvidenceGrid,
    T_start: ArrayLike,
    window: LookAheadWindow,
    max_range: float,
    rng: np.random.Generator,
    config: LocalisationConfig = LOCALISATION,
    *,
    threads: int = 1,
) -> ScanLocalisation:
    """Sample poses around a start, and weight and resample them in several rounds.

    Each round uses an equal part of the likelihood, so that all rounds together count the scan once; between them the
    cloud is blurred such that its mean and covariance stay (Liu & West 2001).

    Parameters
    ----------
    grid : EvidenceGrid
        The map; read-only.
    T_start : (7,) or (3,)
        ``T_map_body``. Roll and pitch are not changed.
    max_range : float
        [m]
    threads : int
        The result does not depend on it.
    """
    if not len(window):
        raise DataError("nothing to localise by", got="a window without beams that met something", wanted="some")
    T = np.asarray(T_start, dtype=np.float64)
    g, n = group_of(T), config.particles
    sigma = np.zeros(g.dof)
    sigma[g.position], sigma[g.heading] = config.position, config.angle
    free = np.flatnonzero(sigma)
    likelihood = EndpointLikelihood(exponent=config.effective_beams / (len(window) * config.rounds))
    # offsets about the start, in map axes; roll and pitch stay zero, because a rotation about the vertical through the
    # body does not change them if the start is level
    x = sigma * rng.standard_normal((n, g.dof))
    w, effective = np.full(n, 1.0 / n), 1.0
    for round in range(config.rounds):
        if round:
            x = _blurred(x[systematic_resample(w, float(rng.random()))], free, rng)
        poses = _placed(T, x)
        w = normalise_log_weights(
            log_weights([grid] * n, poses, window.points, likelihood, origin=window.origins, threads=threads)
        )
        effective = min(effective, effective_sample_size(w) / n)
    poses = _placed(T, x)
    mean = pose_mean(poses, w)
    covariance = pose_scatter(poses, mean, w)
    P = covariance[g.position, g.position]
    spread = max(float(np.linalg.det(P)), 0.0) ** (0.5 / g.dim)
    return ScanLocalisation(
        pose=mean,
        covariance=0.5 * (covariance + covariance.T),
        error=range_error(grid, mean, window, max_range, clip=config.clip * config.cast_sigma),
        spread=spread,
        effective=effective,
    )


def range_error(grid: EvidenceGrid, pose: Array, window: LookAheadWindow, max_range: float, *, clip: float) -> float:
    """Mean squared difference of measured and expected ranges [m²], each limited to ``clip`` [m]; err_X of eq. 19.

    If the map has no surface on the beam, the difference is ``clip``. NaN without any beam.
    """
    if not len(window):
        return math.nan
    rays = window.points - window.origins
    c = cast_grids([grid], np.asarray(pose)[None], window.origins, rays, max_range + clip)
    with np.errstate(invalid="ignore"):
        d = np.abs(c.ranges[0] - np.linalg.norm(rays, axis=1))
    d = np.where(c.hit[0], np.minimum(d, clip), clip)
    return float(np.mean(d * d))


def _placed(T: Array, x: Array) -> Array:
    """Poses ``(n, 7|3)`` at offsets ``(n, d)``: positions along the axes of the map, heading about its z axis."""
    g = group_of(T)
    if g.dim == 2:
        return T + x
    half = 0.5 * x[:, g.heading]
    turn = np.zeros((len(x), 7))
    turn[:, 5], turn[:, 6] = np.sin(half), np.cos(half)
    still = np.concatenate([np.zeros(3), T[3:]])
    out = g.compose(turn, np.broadcast_to(still, turn.shape))
    out[:, :3] = T[:3] + x[:, g.position]
    return out


def _blurred(x: Array, free: npt.NDArray[np.intp], rng: np.random.Generator) -> Array:
    """Shrink the cloud to its mean and blur it, so that mean and covariance stay."""
    out = x.copy()
    y = x[:, free]
    mean = y.mean(axis=0)
    P = np.cov(y.T, bias=True) + 1e-12 * np.eye(len(free))
    noise = rng.standard_normal(y.shape) @ np.linalg.cholesky(P).T
    out[:, free] = mean + _SHRINK * (y - mean) + math.sqrt(1.0 - _SHRINK**2) * noise
    return out
