"""Pairwise consistency of loops, one cycle at a time, with a covariance by brute force: every measurement moved."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from tests.reference.plain_network import compose, exp, inverse


def log(T: np.ndarray) -> np.ndarray:
    from graphslam.core.geometry import se2_log
    from graphslam.core.se3 import se3_log

    return se2_log(T) if len(T) == 3 else se3_log(T)


def cycle_chi2(
    increments: np.ndarray, covariances: np.ndarray, one: tuple, two: tuple | None, step: float = 1e-6
) -> float:
    """D² of the cycle one - chain - two⁻¹ - chain (or one - chain) by central differences over every measurement.

    A loop is (i, j, T_ij, P_ij).
    """
    d = covariances.shape[-1]
    measured = [*increments, one[2], *([two[2]] if two else [])]
    noise = [*covariances, one[3], *([two[3]] if two else [])]
    n = len(increments)

    def along(z: list[np.ndarray], i: int, j: int) -> np.ndarray:
        T = exp(np.zeros(d))
        for k in range(min(i, j), max(i, j)):
            T = compose(T, z[k])
        return T if i <= j else inverse(T)

    def error(z: list[np.ndarray]) -> np.ndarray:
        if two is None:
            return log(compose(z[n], along(z, one[1], one[0])))
        there = compose(z[n], along(z, one[1], two[1]))
        return log(compose(compose(there, inverse(z[n + 1])), along(z, two[0], one[0])))

    r = error(measured)
    S = np.zeros((d, d))
    for k, P in enumerate(noise):
        J = np.zeros((d, d))
        for c in range(d):
            e = np.zeros(d)
            e[c] = step
            up, down = list(measured), list(measured)
            up[k], down[k] = compose(measured[k], exp(e)), compose(measured[k], exp(-e))
            J[:, c] = (error(up) - error(down)) / (2 * step)
        S += J @ P @ J.T
    return float(r @ np.linalg.solve(S, r))


def largest_clique(adjacent: np.ndarray) -> int:
    """Size of the largest clique by trying all subsets, largest first."""
    n = len(adjacent)
    for size in range(n, 0, -1):
        for subset in combinations(range(n), size):
            if all(adjacent[i, j] for i, j in combinations(subset, 2)):
                return size
    return 0
