"""Data association given the joint Gaussian of pose and landmarks.

Nearest neighbour tests each pairing separately. Joint compatibility (Neira & Tardós 2001, IEEE Trans. Robotics and
Automation 17(6)) tests all pairings of a scan together, so that a common pose error is not accepted as several good
matches of the wrong landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import special

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam_frontends.landmarks.compatibility_kernels import (
    JointGaussian,
    PairingBuffer,
    candidates_kernel,
    joint_kernel,
    nearest_kernel,
)

Ints = npt.NDArray[np.int64]


@lru_cache(maxsize=64)
def _gates(gate: float, rows: int) -> Array:
    probability = special.chdtrc(2, gate)
    out = np.concatenate([[0.0], special.chdtri(np.arange(1, rows + 1), probability)])
    out.setflags(write=False)
    return out


def gates_by_dof(gate: float, rows: int) -> Array:
    """χ² gates ``(rows + 1,)`` by degrees of freedom, with the probability of ``gate`` at 2 degrees of freedom.

    Examples
    --------
    >>> g = gates_by_dof(11.8, 4)
    >>> [round(float(v), 2) for v in g]
    [0.0, 8.98, 11.8, 14.13, 16.22]
    """
    if not (np.isfinite(gate) and gate > 0):
        raise ConfigError(f"gate = {gate}; wanted a finite number > 0")
    return _gates(float(gate), 1 << max(rows, 2).bit_length())[: rows + 1]


@dataclass(frozen=True, slots=True)
class Pairing:
    """Outcome of the association of one scan.

    Parameters
    ----------
    landmark : (q,) int64
        Landmark of each observation, -1 = none.
    nearest : (q,)
        Least Mahalanobis distance² of any landmark, relative to the gate; inf without landmarks.
    polar : (L, 2)
        Predicted range [m] and bearing [rad] of every landmark.
    distance2 : float
        Joint Mahalanobis distance² of the pairings (joint compatibility only).
    nodes : int
        Hypotheses tested (joint compatibility only).
    capped : bool
        The search was stopped by ``max_nodes``; the pairing is the best found, not proved optimal.
    """

    landmark: Ints
    nearest: Array
    polar: Array
    distance2: float = 0.0
    nodes: int = 0
    capped: bool = False


def pair_observations(
    x: Array,
    P: Array,
    observations: Array,
    sensor: Array,
    *,
    gate: float,
    method: Literal["nearest", "jcbb"],
    max_nodes: int = 20_000,
    alive: npt.NDArray[np.bool_] | None = None,
) -> Pairing:
    """Pair the observations of one scan with the landmarks of a joint Gaussian; exclusive both ways.

    Parameters
    ----------
    x : (≥ 3 + 2 L,)
        Pose x, y, θ, then landmarks [m, rad]. Entries beyond the landmarks of ``alive`` are not read.
    P : (≥ 3 + 2 L, …)
        Covariance of the same.
    observations : (q, 4)
        Range, bearing, variances; an infinite bearing variance = range only, one degree of freedom.
    sensor : (3,)
        ``T_base_sensor``.
    gate : float
        χ² gate with two degrees of freedom (see :func:`gates_by_dof`).
    method : {"nearest", "jcbb"}
        ``nearest``: greedy by Mahalanobis distance² (relative to the gate, so that observations with and without
        bearing are comparable); ``jcbb``: the largest jointly compatible set of pairings, and of those the one with the
        least joint distance².
    max_nodes : int
        Most hypotheses of ``jcbb``.
    alive : (L,) bool, optional
        Landmarks to use; all of ``x`` by default.
    """
    q = len(observations)
    if alive is None:
        alive = np.ones((len(x) - 3) // 2, dtype=np.bool_)
    nl = len(alive)
    gates = gates_by_dof(gate, max(2 * q, 2))
    polar, nearest = np.full((nl, 2), np.nan), np.full(q, np.inf)
    pair_o, pair_k = np.empty(q * nl, dtype=np.int64), np.empty(q * nl, dtype=np.int64)
    d2 = np.empty(q * nl)
    pairs = PairingBuffer(pair_o, pair_k, d2)
    n = candidates_kernel(JointGaussian(x, P), alive, observations, sensor, gates, polar, nearest, pairs)
    match = np.full(q, -1, dtype=np.int64)
    if method == "nearest":
        one = np.isinf(observations[pair_o[:n], 3])
        nearest_kernel(n, pair_o, pair_k, d2[:n] / np.where(one, gates[1], gates[2]), match)
        return Pairing(match, nearest, polar)
    nodes, capped, joint = joint_kernel(JointGaussian(x, P), observations, sensor, gates, n, pairs, max_nodes, match)
    return Pairing(match, nearest, polar, float(joint), int(nodes), bool(capped))
