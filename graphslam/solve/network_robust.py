"""Truncated least squares on a pose network: graduated non-convexity, then a tight solve of the inliers.

A measurement pays at most the χ² quantile of its dimension (Yang, Antonante, Tzoumas & Carlone 2020, TLS cost).
GNC chooses the inliers; the plain batch optimum, trimmed by the same rule, is the competitor, because GNC is a
heuristic and may end above what it was given.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from scipy import stats

from graphslam.core.errors import ConfigError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.solve.network_batch import BatchProblem, Polished, polish
from graphslam.solve.network_model import edge_costs, observation_costs

Mask = npt.NDArray[np.bool_]
ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Robust:
    """Inliers and the solution of their least-squares problem.

    Parameters
    ----------
    inliers : (m + k,) bool
        Edges, then observations.
    problem : BatchProblem
        Of the inliers alone.
    end : Polished
        Its objective is that of the inliers.
    truncated, truncated_before : float
        Truncated cost here, and at the values that were given.
    """

    inliers: Mask
    problem: BatchProblem
    end: Polished
    truncated: float
    truncated_before: float


def truncated_least_squares(
    problem: BatchProblem, values: gtsam.Values, probability: float = 0.99, trust_odometry: bool = True
) -> Robust:
    """Minimise ``Σ min(rᵀ Ω r, χ²_d(probability))`` from ``values``.

    Parameters
    ----------
    probability : float
        An inlier is kept with this probability.
    trust_odometry : bool
        Edges between neighbours in id order are never outliers (they are not loop closures).

    Raises
    ------
    ConfigError
        Probability outside (0, 1).
    SolverError
        GTSAM's optimiser failed.
    """
    if not 0.0 < probability < 1.0:
        raise ConfigError(f"inlier_probability must lie between 0 and 1, got {probability}")
    network, m = problem.network, len(problem.network.edges)
    limit = np.full(m + len(network.observations), stats.chi2.ppf(probability, 2))
    limit[:m] = stats.chi2.ppf(probability, network.tangent_dim)
    trusted = np.zeros(len(limit), dtype=np.bool_)
    if trust_odometry:
        trusted[:m] = np.abs(np.diff(network.edges, axis=1)[:, 0]) == 1
        limit[trusted] = np.inf
    before = _costs(network, *problem.arrays(values))
    weights, found = _graduated(problem, values, probability, np.flatnonzero(trusted))
    competitors = [
        _trim(network, found, (weights > 0.5) | trusted, limit),
        _trim(network, values, before <= limit, limit),
    ]
    inliers, inner, end, cost = min(competitors, key=lambda c: c[3])
    return Robust(inliers, inner, end, cost, float(np.minimum(before, limit).sum()))


def _graduated(
    problem: BatchProblem, values: gtsam.Values, probability: float, trusted: npt.NDArray[np.intp]
) -> tuple[Array, gtsam.Values]:
    anchors = len(problem.network.anchors)
    lm = gtsam.LevenbergMarquardtParams()
    lm.setLinearSolverType(f"MULTIFRONTAL_{problem.factorization}")
    params = gtsam.GncLMParams(lm)
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([*range(anchors), *(anchors + trusted).tolist()])
    try:
        optimizer = gtsam.GncLMOptimizer(problem.graph, values, params)
        optimizer.setInlierCostThresholdsAtProbability(probability)
        found = optimizer.optimize()
    except RuntimeError as error:
        raise SolverError(f"{problem.network.source}: GNC failed ({error})") from None
    return np.asarray(optimizer.getWeights())[anchors:], found


def _trim(
    network: PoseNetwork, values: gtsam.Values, inliers: Mask, limit: Array
) -> tuple[Mask, BatchProblem, Polished, float]:
    """Alternate least squares of the inliers and the choice of inliers until the choice stays.

    Neither step raises the truncated cost, so it ends.
    """
    for _ in range(ROUNDS):
        inner = BatchProblem(network, inliers)
        end = polish(inner, values)
        costs = _costs(network, *inner.arrays(end.values))
        fresh = costs <= limit
        if (fresh == inliers).all():
            break
        inliers, values = fresh, end.values
    return inliers, inner, end, float(np.where(inliers, costs, limit).sum())


def _costs(network: PoseNetwork, poses: Array, landmarks: Array) -> Array:
    return np.concatenate([edge_costs(network, poses), observation_costs(network, poses, landmarks)])
