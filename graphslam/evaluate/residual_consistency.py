"""Consistency of a solved graph without ground truth: χ² per class of factors.

Residuals at the optimum are smaller than the noise, because the unknowns were fitted to them: a class of factors keeps
``rows - leverage`` degrees of freedom, its leverage is the number of unknowns that it determines. Related tests without
ground truth: withheld GPS (:mod:`graphslam.evaluate.gps_innovation`) and pairs of loops
(:mod:`graphslam.evaluate.loop_consistency`).

All are two-sided: below the bounds an estimate is conservative, and its gates accept outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.evaluate.consistency import Verdict
from graphslam.evaluate.whiteness import Whiteness, residual_whiteness
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.gps import GpsBatch
from graphslam.graph.noise import robust_terms

CORRELATED = "correlated: overconfident"
"""Verdict on residuals that are time-correlated, whatever their size."""
JUDGED_WITH = {"path": ("gps", "control", "distance")}
"""Factors that measure nothing alone: points of a path exist for fixes or control points, and share their residuals.
They are counted with the first of these classes that the graph has."""
NOT_TESTED = {"overlap": 0, "levelled": 2}
"""Classes of pseudo-measurements of poses or gravity that other factors contain already: their residuals are always
small. The value is the number of unknowns that only the class determines: for levelled bases the tilt of the frame."""
LONGEST_SERIES = 1200
"""Scalars of a class whose joint covariance is computed; of a longer series the middle."""


def two_sided_bounds(ratio: float, dof: float, confidence: float) -> tuple[float, float, Verdict]:
    """Bounds of ``χ²_dof / dof`` and the verdict on ``ratio``."""
    a = (1.0 - confidence) / 2.0
    low, high = (float(np.divide(chi2_quantile(q, dof), dof)) for q in (a, 1.0 - a))
    return low, high, "overconfident" if ratio > high else "conservative" if ratio < low else "consistent"


def correlated_dof(covariance: Array, d: int) -> float:
    """Effective degrees of freedom of a sum of ``n / d`` normalised squares that are correlated with each other.

    ``Σ eᵢᵀ Pᵢ⁻¹ eᵢ`` has the mean n and the variance ``2 ‖C‖²`` (Frobenius), where C is the covariance with whitened d
    × d diagonal blocks; a scaled ``χ²_ν`` with the same two moments has ``ν = n² / ‖C‖²`` (Satterthwaite).

    Parameters
    ----------
    covariance : (n, n)
        Joint covariance of all errors.
    d : int
        Size of one error.
    """
    n = len(covariance)
    k = n // d
    blocks = covariance.reshape(k, d, k, d)[np.arange(k), :, np.arange(k), :]
    W = np.linalg.inv(np.linalg.cholesky(blocks))
    C = np.einsum("kij,kjm->kim", W, covariance.reshape(k, d, n)).reshape(n, k, d)
    C = np.einsum("nkj,kij->nki", C, W)
    return float(n**2 / np.sum(C**2))


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassConsistency:
    """χ² of one class of factors, with its expectation at the optimum.

    Parameters
    ----------
    factors, rows : int
        Factors, and scalars that they measure.
    leverage : float
        Number of unknowns that this class determines: ``Σ w tr(J P Jᵀ Λ)``. The sum over all classes is the number of
        unknowns.
    dof : float
        Expectation of :attr:`chi2` if the noise model is right: ``rows - leverage`` without kernels; with them (weights
        assumed constant) ``Σ tr(I - 2 w H + J P M P Jᵀ Λ)``, ``M = Σ w² Jᵀ Λ J``.
    chi2 : float
        ``Σ rᵀ Λ r``, without kernels.
    mean_weight, least_weight : float
        Weights of the robust kernels; 1 without kernels.
    """

    name: str
    factors: int
    rows: int
    leverage: float
    dof: float
    chi2: float
    mean_weight: float
    least_weight: float
    confidence: float = 0.95
    whiteness: Whiteness | None = None

    @property
    def independent(self) -> float:
        """Effective number of independent degrees of freedom: :attr:`dof` over the correlation time."""
        return self.dof / (1.0 if self.whiteness is None else self.whiteness.tau)

    @property
    def ratio(self) -> float:
        """χ²/dof; ``nan`` for a class without redundancy."""
        return self.chi2 / self.dof if self.dof > 1e-6 * self.rows else float("nan")

    def as_row(self) -> dict[str, Any]:
        """One row of a table, with the two-sided bounds of the ratio and the verdict.

        The bounds are those of ``χ²_dof``. One class of several is part of a projection and varies less, so the bounds
        are too wide rather than too narrow. If the residuals are time-correlated, the verdict is overconfident whatever
        their size: a map that follows such errors has small residuals.
        """
        low = high = float("nan")
        w, verdict = self.whiteness, "not tested" if self.name in NOT_TESTED else "no redundancy"
        if self.name not in NOT_TESTED and np.isfinite(self.ratio):
            low, high, verdict = two_sided_bounds(self.ratio, self.independent, self.confidence)
            verdict = CORRELATED if w is not None and w.correlated() else verdict
        return {
            "class": self.name,
            "factors": self.factors,
            "rows": self.rows,
            "leverage": self.leverage,
            "dof": self.dof,
            "chi2": self.chi2,
            "chi2_per_dof": self.ratio,
            "low": low,
            "high": high,
            "verdict": verdict,
            "mean_weight": self.mean_weight,
            "least_weight": self.least_weight,
            "lag1": None if w is None else w.lag1,
            "lag1_score": None if w is None else w.score,
            "correlation_time": None if w is None else w.tau,
        }


def class_consistency(graph: FactorGraph, *, confidence: float = 0.95) -> dict[str, ClassConsistency]:
    """χ² and effective degrees of freedom of every class of factors, at the current values of the graph.

    Parameters
    ----------
    graph : FactorGraph
        At its optimum; elsewhere the residuals are larger.

    Returns
    -------
    dict
        By class: ``submap``, ``gps``, ``match`` …
    """
    covariance = graph.covariance()
    blocks = graph.flat().factor_blocks(graph.values)
    sandwich = _sandwich(covariance, blocks) if np.any(blocks.weight != 1.0) else None
    sums: dict[str, list[tuple[float, ...]]] = {}
    classes = {r.group for r in blocks.records}
    for record, columns, H, d2, w in zip(blocks.records, blocks.columns, blocks.H, blocks.d2, blocks.weight):
        free = columns >= 0
        c, H_free = columns[free], H[np.ix_(free, free)]
        h = float(np.sum(H_free * covariance.columns(c))) if len(c) else 0.0
        again = w * h if sandwich is None else float(np.sum(H_free * sandwich[np.ix_(c, c)]))
        dof = record.rows - 2.0 * w * h + again
        name = next((n for n in JUDGED_WITH.get(record.group, ()) if n in classes), record.group)
        sums.setdefault(name, []).append((record.rows, w * h, dof, float(d2), float(w), float(name == record.group)))
    series = _series(graph, covariance)
    out = {}
    for name, rows in sums.items():
        n, leverage, dof, chi2, weight, own_factors = np.array(rows).T
        out[name] = ClassConsistency(
            name=name,
            factors=int(own_factors.sum()),
            rows=int(n.sum()),
            leverage=float(leverage.sum()),
            dof=float(dof.sum()),
            chi2=float(chi2.sum()),
            mean_weight=float(weight.mean()),
            least_weight=float(weight.min()),
            confidence=confidence,
            whiteness=series.get(name),
        )
    return out


def _series(graph: FactorGraph, covariance: JointCovariance) -> dict[str, Whiteness]:
    """Whiteness of every class with factors in time order: fixes, readings, and chains of increments."""
    values = graph.values
    found: dict[str, list[tuple[float, Array, Array, Array]]] = {}
    for batch in graph.flat().batches:
        if not isinstance(batch, UniformBatch) or batch.prior or not len(batch):
            continue
        at = [_order(batch.records[k]) for k in range(len(batch))]
        if all(t is None for t in at):
            continue
        r, J = batch.whitened(values)
        if isinstance(batch, GpsBatch):  # errors are correlated in the frame of the fixes
            turn = batch.turns(values)
            r, J = np.einsum("kij,kj->ki", turn, r), turn @ J
        root = np.sqrt(robust_terms(np.sum(r**2, axis=1), batch.code, batch.k)[1])
        columns = batch.columns.reshape(len(batch), -1)
        for k, t in enumerate(at):
            if t is not None:
                row = (t, root[k] * r[k], root[k] * J[k], columns[k])
                found.setdefault(batch.group or batch.records[k].group, []).append(row)
    out = {}
    for name, rows in found.items():
        if len({len(row[1]) for row in rows}) > 1:
            continue
        rows.sort(key=lambda row: row[0])
        d = len(rows[0][1])
        most = LONGEST_SERIES // d
        first = max(0, (len(rows) - most) // 2)
        w = _whiteness_of(rows[first : first + most], covariance)
        if w is not None:
            out[name] = w
    return out


def _order(record: Any) -> float | None:
    """Sort key of a factor in a series: its time, or its index in a chain of increments."""
    if isinstance(record, BetweenRecord):
        return float(record.i) if record.j == record.i + 1 and record.group == "dense-submap" else None
    time = getattr(record, "time", None)
    return None if time is None else float(time)


def _whiteness_of(rows: list[tuple[float, Array, Array, Array]], covariance: JointCovariance) -> Whiteness | None:
    n, d = len(rows), len(rows[0][1])
    needed, where = np.unique(np.stack([row[3] for row in rows]), return_inverse=True)
    at = where.reshape(n, -1)
    held = int(needed[0] < 0)
    A = np.zeros((n, d, len(needed)))
    J = np.stack([row[2] for row in rows])
    for c in range(at.shape[1]):  # a column can be twice in a factor
        A[np.arange(n), :, at[:, c]] += J[:, :, c]
    flat = A[:, :, held:].reshape(n * d, -1)
    C = np.eye(n * d) - flat @ covariance.columns(needed[held:]) @ flat.T
    return residual_whiteness(
        np.array([row[0] for row in rows]), np.stack([row[1] for row in rows]), C.reshape(n, d, n, d)
    )


def _sandwich(covariance: JointCovariance, blocks: Any) -> Array:
    """``P (Σ w² Jᵀ Λ J) P``: sandwich covariance of the estimate with kernel weights."""
    n = covariance.layout.size
    M = np.zeros((n, n))
    for columns, H, w in zip(blocks.columns, blocks.H, blocks.weight):
        free = columns >= 0
        c = columns[free]
        np.add.at(M, (c[:, None], c[None, :]), w**2 * H[np.ix_(free, free)])  # a column can be repeated
    P = covariance.full()
    return np.asarray(P @ M @ P)
