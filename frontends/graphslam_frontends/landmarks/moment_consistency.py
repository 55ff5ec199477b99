"""How honest a particle map is: its moments, those of independent filters, and how far both are from the smoothed map.

Forty particles that were resampled a few times describe their own descent as much as the posterior. Two things tell:
the distance to the Laplace Gaussian of the smoothed submap, and the scatter between filters that share nothing but the
data. Both stand beside every map; neither changes it unless asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from graphslam.core.errors import CovarianceError
from graphslam.core.gaussian import Gaussian, chi2_quantile, moment_match
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.summarise import (
    REGULARISER,
    LandmarkAssociation,
    SmoothingResult,
    gaussian_of_particles,
)

FALSE_ALARM = 0.01
"""Share of the submaps of honest filters that each test of the flag may blame."""
LEAST_ESS = 2.0
"""An effective sample size below this, at any scan, raises the flag: one particle decided alone."""
LEAST_ANCESTORS = 10.0
"""Particles that are handed over as moments and descend from fewer raise the flag: a variance made of nine degrees of
freedom is off by a factor of two in one case of ten."""


@dataclass(frozen=True, slots=True)
class ParticleGaussians:
    """Gaussians of one submap made of particles, over the landmarks that the smoothed map holds.

    Parameters
    ----------
    moments : Gaussian or None
        Moments of the filter that decided (B3); None if no particle holds the common features.
    dropped_particles : int
        Particles left out of it (B4).
    pooled : Gaussian or None
        Pooled moments of all filters; None without pooling, or if fewer than two filters hold the common features.
    dropped_filters : int
        Filters left out of it.
    """

    moments: Gaussian | None
    dropped_particles: int
    pooled: Gaussian | None
    dropped_filters: int


def particle_gaussians(
    filters: Sequence[ParticleSet], association: LandmarkAssociation, smoothed: SmoothingResult, *, inflate: bool
) -> ParticleGaussians:
    """Moments of the particles of one submap, alone and pooled.

    Parameters
    ----------
    filters : sequence of ParticleSet
        The first one decided; the others saw the same scans with random numbers of their own.
    association : LandmarkAssociation
        Of the standard particle of the first.
    smoothed : SmoothingResult
        Says which landmarks are left.
    inflate : bool
        See :func:`graphslam_frontends.landmarks.summarise.gaussian_of_particles`; only the first filter's own moments
        are inflated.
    """
    keep = smoothed.landmark_kept
    used = keep[association.landmark]
    rank = np.cumsum(keep) - 1
    same = LandmarkAssociation(association.slots[keep], association.observation[used], rank[association.landmark[used]])
    moments, dropped = _moments(filters[0], same, inflate)
    if len(filters) < 2:
        return ParticleGaussians(moments, dropped, None, 0)
    each = [_moments(p, same, False)[0] for p in filters]
    there = [g for g in each if g is not None]
    return ParticleGaussians(
        moments, dropped, pool_gaussians(there) if len(there) > 1 else None, len(each) - len(there)
    )


def _moments(particles: ParticleSet, association: LandmarkAssociation, inflate: bool) -> tuple[Gaussian | None, int]:
    try:
        return gaussian_of_particles(particles, association, inflate=inflate)
    except CovarianceError:  # every particle was dropped
        return None, len(particles.pose)


def pool_gaussians(gaussians: Sequence[Gaussian]) -> Gaussian:
    """One Gaussian of K independent estimates of the same posterior: within + (1 + 1/K) between.

    The mean of their covariances, and the unbiased scatter of their means with a 1/K share for the error of the pooled
    mean itself (Rubin's rule of multiple imputation; the factor is 1.2 for five filters).

    Parameters
    ----------
    gaussians : sequence of Gaussian
        At least two, over the same vector.
    """
    k = len(gaussians)
    floor = REGULARISER * np.eye(len(gaussians[0].mean))
    scatter = moment_match(np.ones(k), [g.mean for g in gaussians], floor, gaussians[0].angular)
    between = (scatter.covariance - floor) * k / (k - 1)
    within = np.mean([g.covariance for g in gaussians], axis=0)
    return replace(scatter, covariance=within + (1.0 + 1.0 / k) * between)


def gaussian_discrepancy(prefix: str, particle: Gaussian | None, smoothed: Gaussian) -> dict[str, Any]:
    """How far a Gaussian made of particles is from the smoothed one, as ``prefix_…`` figures; None where it is missing.

    ``d2_per_dof``: Mahalanobis distance² of the means under the particles' covariance, over the dimension; ``kl``:
    KL(smoothed ‖ particles) in nats; ``pose_variance_ratio``: particles / smoothed, for x, y and heading.
    """
    if particle is None:
        return {f"{prefix}_d2_per_dof": None, f"{prefix}_kl": None, f"{prefix}_pose_variance_ratio": None}
    ratio = np.diag(particle.covariance)[:3] / np.diag(smoothed.covariance)[:3]
    return {
        f"{prefix}_d2_per_dof": particle.mahalanobis2(smoothed.mean) / len(smoothed.mean),
        f"{prefix}_kl": smoothed.kl_from(particle),
        f"{prefix}_pose_variance_ratio": [float(r) for r in ratio],
    }


def consistency_flag(report: dict[str, Any], particles: int) -> list[str]:
    """Why a map is not to be taken at its particles' word; empty if it may be.

    Parameters
    ----------
    report : dict
        With the figures of :func:`gaussian_discrepancy`, ``min_ess``, ``effective_ancestors``, ``handover``, and
        ``chi2`` with ``dof`` of the smoothing.
    particles : int
        A set smaller than :data:`LEAST_ESS` cannot reach it and is not blamed for that alone.
    """
    reasons = []
    handed = {"moments": "moment", "pooled": "pooled"}.get(report.get("handover", "smoothed"))
    lines = float(report.get("effective_ancestors", particles))
    for prefix, samples in (("moment", lines), ("pooled", lines * report.get("pooled_filters", 1))):
        ratio = report.get(f"{prefix}_pose_variance_ratio")
        if ratio is None and f"{prefix}_kl" in report and handed == prefix:
            reasons.append(f"{prefix}-missing")
        elif ratio is not None:
            low, high = variance_bounds(samples)
            if not all(low <= r <= high for r in ratio):
                reasons.append(f"{prefix}-pose-variance")
    if handed == "moment" and lines < min(LEAST_ANCESTORS, particles):
        reasons.append("ancestors")
    if report["min_ess"] < min(LEAST_ESS, particles):
        reasons.append("ess")
    if report.get("dof", 0) > 0 and report["chi2"] > special.chdtri(report["dof"], FALSE_ALARM):
        reasons.append("residuals")
    return reasons


def variance_bounds(samples: float) -> tuple[float, float]:
    """Between which a variance made of independent samples lies, over the true one, in honest maps.

    It is ``χ²_ν / samples``, ``ν = samples - 1``, and three of them are looked at (Bonferroni). Fewer than two samples
    have no bounds: they say nothing.
    """
    nu = samples - 1.0
    if nu < 1.0:
        return 0.0, np.inf
    tail = FALSE_ALARM / 3.0 / 2.0
    return float(chi2_quantile(tail, nu) / samples), float(special.chdtri(nu, tail) / samples)
