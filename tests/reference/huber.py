"""Huber's loss on the loops of a pose network, by iteratively reweighted least squares: the robust baseline.

A loop pays ``ρ(c) = c`` up to ``k²`` and ``2 k √c - k²`` beyond, ``c = rᵀ Ω r`` (Huber 1964). A wrong loop still pulls,
with a constant force; it only no longer pulls harder the more wrong it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.graph.network import network_values, problem_of_network
from graphslam.solve.descent import descend_to_minimum
from graphslam.solve.sparse import SparseProblem
from tests.reference.plain_network import edge_costs


@dataclass(frozen=True, slots=True)
class HuberAnswer:
    """Where reweighting ended.

    Parameters
    ----------
    poses : (n, 3) or (n, 7)
    weights : (m,)
        Of the edges, in (0, 1]; 1 for trusted ones.
    cost : float
        ``Σ ρ`` over all edges.
    rounds : int
    converged : bool
        The last round lowered the cost by less than the tolerance.
    """

    poses: Array
    weights: Array
    cost: float
    rounds: int
    converged: bool


def huber_least_squares(
    network: PoseNetwork,
    poses: npt.ArrayLike,
    trusted: npt.NDArray[np.bool_],
    *,
    k: float = 1.345,
    rounds: int = 60,
    tolerance: float = 1e-5,
) -> HuberAnswer:
    """Minimise Huber's cost from given poses; landmark observations are refused.

    Parameters
    ----------
    poses : (n, 3) or (n, 7)
        Start.
    trusted : (m,) bool
        Edges with plain squares (odometry).
    k : float
        In units of σ (1.345: 95 % efficiency in one dimension).
    rounds : int
        Of reweighting, a few Gauss-Newton steps each.
    tolerance : float
        Relative fall of the cost at which to stop.

    Raises
    ------
    ConfigError
        ``k`` not positive, or a network with landmarks.
    """
    if not k > 0.0:
        raise ConfigError(f"Huber's k must be positive, got {k}")
    if len(network.observations):
        raise ConfigError("Huber's loss is for edges only; the network has landmark observations")
    now = np.array(poses, dtype=np.float64)
    costs = edge_costs(network, now)
    cost = _huber(costs, trusted, k)
    for count in range(1, rounds + 1):
        weights = np.where(trusted, 1.0, np.minimum(1.0, k / np.sqrt(np.maximum(costs, 1e-300))))
        weighted = replace(network, information=weights[:, None, None] * network.information)
        problem = SparseProblem(problem_of_network(weighted))
        moved = descend_to_minimum(problem, network_values(network, now), max_iterations=3).values.poses
        costs = edge_costs(network, moved)
        fresh = _huber(costs, trusted, k)
        fall, cost, now = cost - fresh, min(fresh, cost), moved if fresh <= cost else now
        if fall <= tolerance * cost:
            return HuberAnswer(now, weights, cost, count, True)
    return HuberAnswer(now, weights, cost, rounds, False)


def _huber(costs: Array, trusted: npt.NDArray[np.bool_], k: float) -> float:
    robust = np.where(costs <= k * k, costs, 2.0 * k * np.sqrt(costs) - k * k)
    return float(np.where(trusted, costs, robust).sum())
