"""What decisions on loops ask of a graph, and when a loop is believed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.graph.noise import RobustKernel
from graphslam.loops.measure import Loop
from graphslam.loops.places import Ints

Judge = Callable[[Array, Array, tuple[Ints, Array, Array]], npt.NDArray[np.bool_]]
"""See :class:`~graphslam.loops.loops.LoopCloser`."""


LEARNT = 0.01
"""Least share of a loop's variance that the graph is taken not to have learnt from it."""


class LoopGraph(Protocol):
    """What is asked of a graph that loops are added to."""

    def relative(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        """``T_ij (k, 7|3)`` and covariances ``(k, d, d)``, right tangents, from the joint marginals."""
        ...

    def add_loop(self, loop: Loop, robust: RobustKernel) -> int:
        """Add a between-factor; its id."""
        ...

    def remove_loop(self, factor_id: int) -> None:
        """Take it out again."""
        ...

    def solve(self) -> None:
        """Bring the values to the optimum."""
        ...

    def chi2(self) -> dict[int, float]:
        """``rᵀ P⁻¹ r`` of every factor at the values, without its kernel."""
        ...


def chi2_without(loop: Loop, T_ij: Array, P: Array) -> float:
    """χ² of a loop that is in a graph against the graph without it: ``rᵀ (R - P)⁻¹ r``.

    Parameters
    ----------
    T_ij : (7,) or (3,)
        Relative pose at the solution with the loop.
    P : (d, d)
        Its posterior covariance, right tangent.

    Notes
    -----
    Where the graph learnt nearly all from the loop, R and P are the same but for what bending the graph changed of P, a
    few thousandths: their difference says nothing there, and could even be negative. It is taken to be at least
    ``LEARNT`` of R, which makes the test milder along such directions, never harsher.
    """
    g = group_of(loop.T_ij)
    D = g.between(T_ij, loop.T_ij)
    A = g.adjoint(D)
    R = A @ loop.covariance @ A.T
    e = g.log(D)
    # in units of R: what of it the graph had to learn from the loop is no test of it
    L = np.linalg.cholesky(R)
    y, S = np.linalg.solve(L, e), np.linalg.solve(L, np.linalg.solve(L, P).T)
    w, V = np.linalg.eigh(0.5 * (S + S.T))
    left = np.maximum(1.0 - w, LEARNT)
    return float(np.sum((V.T @ y) ** 2 / left))


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """When a loop is believed."""

    level: float = 0.999
    """A right loop passes the χ² of the graph with this probability."""
    chain: float = 0.9999
    """… and that of the chain alone with this: what is wrong with the chain is wrong for all loops at once."""
    pairwise: float = 0.99
    """Two right loops agree with this probability."""
    kernel: float = 0.95
    """Loops in the graph have a Huber kernel that begins where a right loop lies with this probability."""
    off: float = 0.9999
    """A loop is switched off that the graph without it would refuse with this confidence."""
    earlier: float = 0.9999
    """… or that raises the χ² of earlier factors by more than this quantile of its own."""

    def robust(self, dof: int) -> RobustKernel:
        """The kernel of loops in the graph."""
        return RobustKernel("huber", math.sqrt(chi2_quantile(self.kernel, dof)))

    def __post_init__(self) -> None:
        for f in fields(self):
            if not 0.0 < getattr(self, f.name) < 1.0:
                raise ConfigError(f"loops: {f.name} = {getattr(self, f.name)}; wanted a probability in (0, 1)")
