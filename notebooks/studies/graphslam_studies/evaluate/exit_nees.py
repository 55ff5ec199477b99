"""NEES of the end poses of submaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of


@dataclass(frozen=True, slots=True)
class ExitNees:
    """Normalised squared errors of exits.

    Parameters
    ----------
    values : (n,)
        ``eᵀ P⁻¹ e``; its expectation is ``dof`` if the covariances are consistent.
    errors : (n, dof)
        Right tangents at the estimates, of the components that were asked for.
    """

    values: Array
    dof: int
    errors: Array

    @property
    def per_dof(self) -> float:
        """Mean, one for consistent covariances."""
        return float(self.values.mean() / self.dof)

    def inside(self, probability: float = 0.95) -> float:
        """Share inside the region that should hold this share."""
        return float(np.mean(self.values <= chi2_quantile(probability, self.dof)))


def exit_nees(
    estimates: ArrayLike,
    covariances: ArrayLike,
    truths: ArrayLike,
    *,
    components: npt.ArrayLike | None = None,
) -> ExitNees:
    """Are the covariances of exits consistent?

    Parameters
    ----------
    estimates, truths : (n, 7) or (n, 3)
        Exits in the frames of the segments' starts.
    covariances : (n, d, d)
        Right tangent at the estimates.
    components : sequence of int, optional
        Tangent components to judge; default all. Where roll and pitch come from gravity: ``(2, 3, 4, 5)``.
    """
    T = np.atleast_2d(np.asarray(estimates, dtype=np.float64))
    group = group_of(T)
    keep = np.arange(group.dof) if components is None else np.asarray(components, dtype=np.intp)
    e = group.log(group.between(T, truths))[:, keep]
    P = np.asarray(covariances, dtype=np.float64)[:, keep[:, None], keep[None, :]]
    values = np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0])
    return ExitNees(values, len(keep), e)
