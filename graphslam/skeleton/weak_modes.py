"""The weakest modes of a skeleton network: deformations that the measurements determine least. Approximate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg as spla

from graphslam.core.geometry import Array
from graphslam.skeleton.preconditioner import KeyframeNetwork, preconditioner_levels
from graphslam.skeleton.schur import Network


@dataclass(frozen=True)
class WeakMode:
    """Displacement of the poses by one mode for an increase of the objective by one unit of χ².

    Parameters
    ----------
    rms, largest : float
        RMS over the keyframes, and largest displacement of a keyframe [m].
    pose : int
        Pose of the largest displacement.
    """

    rms: float
    largest: float
    pose: int


def weakest_modes(network: Network, count: int = 3) -> list[WeakMode]:
    """Modes with the largest position variance, weakest first, by Lanczos on the factorised keyframe network.

    The keyframes allow only rigid motion between them, so the true modes are at least as weak: the values are lower
    bounds.
    """
    poses = network.layout.problem.poses
    keyframes = KeyframeNetwork(network, preconditioner_levels(poses).factored or max(1, poses // 40))
    n = keyframes.frames

    def spread(x: Array) -> Array:
        full = np.zeros((n, 6))
        full[:, 3:] = x.reshape(n, 3)
        return keyframes.solve(full)[:, 3:].ravel()

    operator = spla.LinearOperator((3 * n, 3 * n), matvec=spread, dtype=np.float64)
    count = min(count, 3 * n - 2)
    begin = np.cos(np.arange(3.0 * n))
    value, vector = spla.eigsh(operator, k=count, which="LM", v0=begin, tol=1e-3)
    modes = []
    for i in np.argsort(-value):
        move = np.linalg.norm(vector[:, i].reshape(n, 3), axis=1) * np.sqrt(value[i])
        at = int(np.argmax(move))
        pose = min(at * keyframes.k, len(network.poses.position) - 1)
        modes.append(WeakMode(float(np.sqrt(np.mean(move**2))), float(move[at]), pose))
    return modes
