"""Dense submaps along a way, in the plane or in space, with paths inside whose covariances are those of their steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3, Group
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory

STEP_SIGMA = {2: np.array([0.01, 0.01, 0.002]), 3: np.array([1e-3, 1e-3, 2e-3, 0.01, 0.01, 0.01])}


@dataclass
class DenseChain:
    """Submaps and truth; everything in the frame of the first base.

    Parameters
    ----------
    submaps : list of Submap
    poses : (m + 1, 3|7)
        True bases and the last exit.
    path : (m, n + 1, 3|7)
        True poses of the body inside every submap.
    times : (m, n + 1)
    """

    submaps: list[Submap]
    poses: Array
    path: Array
    times: Array


def step_of(group: Group, turn: float, climb: float = 0.0) -> Array:
    """Half a metre forward and a little turn; in space also a little climb, roll and pitch."""
    if group.dim == 2:
        return group.exp([0.5, 0.0, turn])
    return group.exp([0.01 * np.sin(9 * turn), climb, turn, 0.5, 0.0, 0.02])


def dense_chain(
    rng: np.random.Generator,
    dim: int = 3,
    m: int = 6,
    steps: int = 24,
    *,
    noise: float = 1.0,
    laps: float = 1.2,
    covariances: bool = True,
) -> DenseChain:
    """``m`` submaps of ``steps`` steps of half a metre around a circle; independent noise at every step.

    Parameters
    ----------
    noise : float
        Factor on the noise that is drawn; the covariances stay.
    """
    group = SE2 if dim == 2 else SE3
    Q = np.diag(STEP_SIGMA[dim] ** 2)
    turn = 2 * np.pi * laps / (m * steps)
    base = group.identity
    submaps, poses, paths, all_times = [], [base], [], []
    for k in range(m):
        truth, seen, P = [base], [group.identity], [1e-12 * np.eye(group.dof)]
        for j in range(steps):
            step = step_of(group, turn, 0.002 * np.cos(0.3 * (k * steps + j)))
            truth.append(group.compose(truth[-1], step))
            error = noise * STEP_SIGMA[dim] * rng.standard_normal(group.dof)
            measured = group.compose(step, group.exp(error))
            seen.append(group.compose(seen[-1], measured))
            ad = group.adjoint(group.inverse(measured))
            P.append(ad @ P[-1] @ ad.T + Q)
        times = 10.0 * k + 10.0 * np.arange(steps + 1) / steps
        path = Trajectory(times, np.array(seen), np.array(P) if covariances else None)
        submaps.append(
            Submap(
                key=k,
                interval=(10.0 * k, 10.0 * (k + 1)),
                exit_pose=seen[-1],
                exit_covariance=P[-1],
                trajectory=path,
                uses=frozenset({"laser", "odometry"}),
            )
        )
        base = truth[-1]
        poses.append(base)
        paths.append(truth)
        all_times.append(times)
    return DenseChain(submaps, np.array(poses), np.array(paths), np.array(all_times))
