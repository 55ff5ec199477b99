"""Consistency of a particle map: its moments, those of independent filters, and their distances to the smoothed map.

After a few resamplings 40 particles reflect their common ancestry as much as the posterior. Two checks: the distance to
the Laplace Gaussian of the smoothed submap, and the scatter between independent filters on the same data. Both are in
the report; neither changes the map, except as the chosen output.
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
"""False-alarm rate per test of the flag, for consistent filters."""
LEAST_ESS = 2.0
"""A smaller effective sample size at any scan raises the flag: one particle dominated."""
LEAST_ANCESTORS = 10.0
"""With moments as output, fewer effective ancestors raise the flag: a variance from nine degrees of freedom is off by a
factor of two in one case of ten."""


@dataclass(frozen=True, slots=True)
class ParticleGaussians:
    """Gaussians of one submap from particles, over the landmarks of the smoothed map.

    Parameters
    ----------
    moments : Gaussian or None
        Moments of the first filter (B3); None if no particle has the common features.
    dropped_particles : int
        Number of particles left out of it (B4).
    pooled : Gaussian or None
        Pooled moments of all filters; None without pooling, or if fewer than two filters have the common features.
    dropped_filters : int
        Number of filters left out of it.
    """

    moments: Gaussian | None
    dropped_particles: int
    pooled: Gaussian | None
    dropped_filters: int


def particle_gaussians(
    filters: Sequence[ParticleSet], association: LandmarkAssociation, smoothed: SmoothingResult, *, inflate: bool
) -> ParticleGaussians:
    """Moments of the particles of one submap, of the first filter and pooled.

    Parameters
    ----------
    filters : sequence of ParticleSet
        The first one determined the association; the others used the same scans with other random numbers.
    association : LandmarkAssociation
        Of the standard particle of the first.
    smoothed : SmoothingResult
        Its landmarks are used.
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
    """Pool K independent Gaussian estimates of the same posterior: within + (1 + 1/K) between.

    The mean of their covariances, plus the unbiased scatter of their means with a 1/K part for the error of the pooled
    mean (Rubin's rule of multiple imputation; the factor is 1.2 for five filters).

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
    """Discrepancy of a Gaussian from particles to the smoothed one, as metrics ``prefix_…``; None if it is missing.

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
    """Reasons why the particle map is inconsistent; empty if there are none.

    Parameters
    ----------
    report : dict
        With the metrics of :func:`gaussian_discrepancy`, ``min_ess``, ``effective_ancestors``, ``handover``, and
        ``chi2`` with ``dof`` of the smoothing.
    particles : int
        A set smaller than :data:`LEAST_ESS` cannot reach it, and is not flagged for that alone.
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
    """Bounds of the ratio of a variance from independent samples to the true one, for consistent maps.

    It is ``χ²_ν / samples``, ``ν = samples - 1``, and three of them are tested (Bonferroni). Fewer than two samples
    have no bounds.
    """
    nu = samples - 1.0
    if nu < 1.0:
        return 0.0, np.inf
    tail = FALSE_ALARM / 3.0 / 2.0
    return float(chi2_quantile(tail, nu) / samples), float(special.chdtri(nu, tail) / samples)
