"""Consistency of an estimator: NEES with two-sided bounds, consistency index, coverage.

Combined SLAM (2012): ``D² = (x - x̂)ᵀ P⁻¹ (x - x̂)`` (eq. 18), consistent if ``D² < χ²_{n,1-α}`` (eq. 19), index ``CI =
D²/χ²_{n,1-α}`` (eq. 20). ``CI < 1`` alone is a weak test: with three degrees of freedom it passes an estimator whose
covariance is 2.6 times too small, and it never detects a conservative one. The verdict therefore uses the *mean* NEES
over independent runs with two-sided χ² bounds; CI is reported as well.

The error of a pose is the right tangent ``ξ = Log(T_est⁻¹ T_true)`` in GTSAM's order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg as sla
import scipy.sparse as sp
from scipy import special

from graphslam.core import se3
from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.gaussian import check_covariance, chi2_mean_bounds, chi2_quantile
from graphslam.core.geometry import Array, ArrayLike, se2_between, se2_log, wrap_angle
from graphslam.core.markup import pair_list

Unit = Literal["run", "value"]
Verdict = Literal["consistent", "overconfident", "conservative"]


def pose_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Right-tangent errors ``Log(T_est⁻¹ T_true)``: ``(..., 3)`` of 2-D poses, ``(..., 6)`` of 3-D poses."""
    e, t = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if e.shape[-1] != t.shape[-1] or e.shape[-1] not in (3, 7):
        raise DataError("poses of estimate and truth differ in kind", got=(e.shape, t.shape), wanted="(..., 3) or 7")
    return se2_log(se2_between(e, t)) if e.shape[-1] == 3 else se3.se3_log(se3.se3_between(e, t))


def vector_pose_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Errors ``truth - estimate`` of the vectors (x, y, θ), heading wrapped: the form of Combined SLAM eq. 15."""
    d = np.asarray(truth, dtype=np.float64) - np.asarray(estimate, dtype=np.float64)
    d[..., 2] = wrap_angle(d[..., 2])
    return d


def nees(error: ArrayLike, covariance: ArrayLike) -> Array:
    """``D² = eᵀ P⁻¹ e`` (eq. 18) for errors ``(..., n)`` and covariances ``(..., n, n)``."""
    e, P = np.asarray(error, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    if P.shape[-2:] != (e.shape[-1], e.shape[-1]):
        raise CovarianceError("covariance does not fit the error", got=P.shape, wanted=(*e.shape, e.shape[-1]))
    turned = np.swapaxes(P, -1, -2)
    asymmetric = np.abs(P - turned).max(axis=(-1, -2)) > 1e-6 * np.abs(P).max(axis=(-1, -2))
    try:
        if np.any(asymmetric) or not np.all(np.isfinite(P)):
            raise np.linalg.LinAlgError
        L = np.linalg.cholesky(0.5 * (P + turned))  # the same matrix as in check_covariance
    except np.linalg.LinAlgError:
        for k, one in enumerate(P.reshape(-1, *P.shape[-2:])):
            check_covariance(one, what=f"covariance {k}")
        raise
    y = np.linalg.solve(L, e[..., None])[..., 0]
    return np.asarray(np.sum(y**2, axis=-1))


def joint_nees(
    error: ArrayLike, *, covariance: ArrayLike | None = None, information: sp.spmatrix | sp.sparray | None = None
) -> float:
    """NEES of one whole map: error ``(n,)`` with its dense covariance, or its sparse information matrix."""
    e = np.asarray(error, dtype=np.float64)
    if (covariance is None) == (information is None):
        raise CovarianceError("a joint NEES needs either a covariance or an information matrix")
    if information is not None:
        d2 = float(e @ (sp.csr_array(information) @ e))
        if not d2 >= 0:
            raise CovarianceError("information matrix is not positive semi-definite", got=f"eᵀ Λ e = {d2:.3g}")
        return d2
    c = sla.cho_factor(check_covariance(covariance, dim=len(e)), lower=True)  # type: ignore[arg-type]
    return float(e @ sla.cho_solve(c, e))


def consistency_index(d2: ArrayLike, dof: ArrayLike, *, confidence: float = 0.95) -> Array:
    """``CI = D² / χ²_{n,1-α}`` (eq. 20), α = 1 - confidence. A perfect estimator has mean ``n/χ²``, not 1."""
    return np.asarray(d2, dtype=np.float64) / (
        2.0 * special.gammaincinv(0.5 * np.asarray(dof, dtype=np.float64), confidence)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """NEES values with all data needed for the verdict.

    Parameters
    ----------
    quantity : str
        What is tested: "pose", "landmark", "joint" …
    nees : (runs, k)
        One row per independent run; nan where a value is missing.
    dof : (runs, k)
        Degrees of freedom n of each value.
    gauge : str
        How the frame was fixed, e.g. "first base fixed".
    confidence : float
        Of the two-sided bounds, and 1 - α of CI and coverage.
    unit : {"run", "value"}
        What is independent. ``run`` (default): values of one run may have any correlation (all landmarks of a map
        depend on its heading), so a run counts once. ``value``: all values are independent (local maps).
    """

    quantity: str
    nees: Array
    dof: Array
    gauge: str
    confidence: float = 0.95
    unit: Unit = "run"

    def __post_init__(self) -> None:
        d2 = np.asarray(self.nees, dtype=np.float64)
        d2 = d2.reshape(-1, 1) if d2.ndim < 2 else d2
        dof = np.broadcast_to(np.asarray(self.dof, dtype=np.float64), d2.shape)
        known = np.isfinite(d2)
        if d2.ndim != 2 or not np.all(np.any(known, axis=1)) or not len(d2):
            raise DataError("NEES needs runs with at least one value each", where=self.quantity, got=d2.shape)
        if np.any(d2[known] < 0) or np.any(np.isinf(d2)):
            raise DataError("NEES is negative or infinite", where=self.quantity, wanted="≥ 0, or nan where missing")
        if np.any(dof[known] < 1):
            raise DataError("degrees of freedom are not positive", where=self.quantity, got=float(dof[known].min()))
        if not 0 < self.confidence < 1:
            raise DataError(
                "confidence is no probability", where=self.quantity, got=self.confidence, wanted="in (0, 1)"
            )
        if self.unit not in ("run", "value"):
            raise DataError("unknown unit", where=self.quantity, got=self.unit, wanted="run or value")
        object.__setattr__(self, "nees", d2)
        object.__setattr__(self, "dof", dof)

    @property
    def runs(self) -> int:
        """Number of independent runs."""
        return len(self.nees)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(np.sum(np.isfinite(self.nees)))

    @property
    def dimension(self) -> float:
        """Degrees of freedom of a value; their mean if they differ."""
        return float(np.mean(self.dof[np.isfinite(self.nees)]))

    @property
    def mean_normalised(self) -> float:
        """Mean of ``D²/n``: 1 for a consistent estimator, above it overconfident, below it conservative."""
        if self.unit == "value":
            known = np.isfinite(self.nees)
            return float(np.sum(self.nees[known]) / np.sum(self.dof[known]))
        return float(np.mean(np.nanmean(self.nees / self.dof, axis=1)))

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided bounds of :attr:`mean_normalised` for a consistent estimator.

        With ``unit="run"`` the values of a run are assumed fully correlated: the mean over a run is then distributed as
        ``χ²_n/n``. If they are less correlated, the bounds are too wide, never too narrow.
        """
        known = np.isfinite(self.nees)
        if self.unit == "value":
            total = float(np.sum(self.dof[known]))
            low, high = chi2_mean_bounds(total, 1, self.confidence)
            return low / total, high / total
        n = float(np.min(self.dof[known]))
        low, high = chi2_mean_bounds(n, self.runs, self.confidence)
        return low / n, high / n

    @property
    def verdict(self) -> Verdict:
        """``overconfident`` above the bounds, ``conservative`` below, else ``consistent``."""
        low, high = self.bounds
        m = self.mean_normalised
        return "overconfident" if m > high else "conservative" if m < low else "consistent"

    @property
    def index(self) -> Array:
        """Consistency index of each value ``(runs, k)`` (eq. 20)."""
        return consistency_index(self.nees, self.dof, confidence=self.confidence)

    @property
    def coverage(self) -> float:
        """Share of values inside their ``confidence`` region (eq. 19)."""
        known = np.isfinite(self.nees)
        return float(np.mean(self.index[known] < 1.0))

    def curve(self) -> tuple[Array, Array, Array]:
        """Mean over the runs of ``D²/n`` per column, with its lower and upper bounds, each ``(k,)``.

        Columns are usually submaps. Only runs with a value in the column are used.
        """
        runs = np.sum(np.isfinite(self.nees), axis=0)
        if np.any(runs == 0):
            raise DataError("a column has no value", where=self.quantity, got=int(np.argmin(runs)))
        mean = np.nanmean(self.nees / self.dof, axis=0)
        n = np.where(np.isfinite(self.nees), self.dof, np.inf).min(axis=0)
        a = (1.0 - self.confidence) / 2.0
        low, high = (2.0 * special.gammaincinv(0.5 * n * runs, q) / (n * runs) for q in (a, 1.0 - a))
        return mean, low, high

    def as_row(self) -> dict[str, Any]:
        """One row of a table: metrics, gauge, dimension, number of runs, confidence."""
        low, high = self.bounds
        index = self.index[np.isfinite(self.nees)]
        return {
            "quantity": self.quantity,
            "nees_over_n": self.mean_normalised,
            "low": low,
            "high": high,
            "verdict": self.verdict,
            "ci_mean": float(np.mean(index)),
            "ci_median": float(np.median(index)),
            "ci_consistent": float(self.dimension / chi2_quantile(self.confidence, self.dimension)),
            "coverage": self.coverage,
            "dimension": self.dimension,
            "runs": self.runs,
            "values": self.count,
            "unit": self.unit,
            "confidence": self.confidence,
            "gauge": self.gauge,
        }

    def _repr_html_(self) -> str:
        return pair_list(self.as_row())
