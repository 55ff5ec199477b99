"""Interface of a graph for loop decisions, and thresholds for accepting loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.config import check_options
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.graph.noise import RobustKernel
from graphslam.loops.measure import Loop
from graphslam.loops.places import Ints

JointTest = Callable[[Array, Array, tuple[Ints, Array, Array]], npt.NDArray[np.bool_]]
"""See :class:`~graphslam.loops.loops.LoopCloser`."""


LEARNT = 0.01
"""Minimum share of a loop's variance that is assumed independent of the graph's posterior."""


class LoopGraph(Protocol):
    """Interface of a graph to which loops are added."""

    def relative(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        """``T_ij (k, 7|3)`` and covariances ``(k, d, d)``, right tangents, from the joint marginals."""
        ...

    def add_loop(self, loop: Loop, robust: RobustKernel) -> int:
        """Add a between-factor; returns its id."""
        ...

    def remove_loop(self, factor_id: int) -> None:
        """Remove a loop."""
        ...

    def solve(self) -> None:
        """Solve to the optimum."""
        ...

    def chi2(self) -> dict[int, float]:
        """``rᵀ P⁻¹ r`` of every factor at the current values, without its kernel."""
        ...


def chi2_without(loop: Loop, T_ij: Array, P: Array) -> float:
    """χ² of a loop in a graph relative to the graph without it: ``rᵀ (R - P)⁻¹ r``.

    Parameters
    ----------
    T_ij : (7,) or (3,)
        Relative pose at the solution with the loop.
    P : (d, d)
        Its posterior covariance, right tangent.

    Notes
    -----
    If the graph got nearly all information from the loop, R and P are equal up to a few thousandths, from the change of
    linearisation: their difference is meaningless then, and could even be negative. It is set to at least
    ``LEARNT`` of R, which makes the test weaker along such directions, never stricter.
    """
    g = group_of(loop.T_ij)
    D = g.between(T_ij, loop.T_ij)
    A = g.adjoint(D)
    R = A @ loop.covariance @ A.T
    e = g.log(D)
    # in units of R: directions that are determined by the loop alone cannot be tested
    L = np.linalg.cholesky(R)
    y, S = np.linalg.solve(L, e), np.linalg.solve(L, np.linalg.solve(L, P).T)
    w, V = np.linalg.eigh(0.5 * (S + S.T))
    left = np.maximum(1.0 - w, LEARNT)
    return float(np.sum((V.T @ y) ** 2 / left))


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """Thresholds for accepting loops."""

    level: float = 0.999
    """Probability that a correct loop passes the χ² test of the graph."""
    chain: float = 0.9999
    """… and that of the chain alone, whose errors affect all loops at once."""
    pairwise: float = 0.99
    """Probability that two correct loops are consistent."""
    kernel: float = 0.95
    """Loops in the graph have a Huber kernel that starts at this quantile of a correct loop."""
    off: float = 0.9999
    """A loop is switched off if the graph without it rejects it with this confidence …"""
    earlier: float = 0.9999
    """… or if it raises the χ² of earlier factors by more than this quantile of its own."""

    def robust(self, dof: int) -> RobustKernel:
        """The kernel of loops in the graph."""
        return RobustKernel("huber", math.sqrt(chi2_quantile(self.kernel, dof)))

    def __post_init__(self) -> None:
        check_options(self, "loops: ", {"in (0, 1)": "*"})
