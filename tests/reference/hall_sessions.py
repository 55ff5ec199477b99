"""Drives through halls made of boxes, as chains of dense submaps whose paths and exits err as their covariances say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from tests.reference.box_submaps import clouded, mapped
from tests.reference.box_world import BoxWorld

STEP_SIGMA = np.array([3e-4, 3e-4, 2e-3, 0.01, 0.01, 0.003])
"""Of each step of a path: rotation [rad], position [m]."""


@dataclass
class HallDrive:
    """Submaps and truth.

    Parameters
    ----------
    submaps : list of Submap
    path : Trajectory
        True poses in the hall's frame.
    """

    submaps: list[Submap]
    path: Trajectory


def hall_drive(
    world: BoxWorld,
    path: Array,
    rng: np.random.Generator,
    *,
    per_submap: int = 27,
    start: float = 0.0,
    clouds: bool = False,
) -> HallDrive:
    """A drive along true poses ``way (n, 7)``, one a second, in submaps of so many steps, with grids or clouds."""
    times = start + np.arange(len(path), dtype=float)
    submaps = []
    for k, a in enumerate(range(0, len(path) - 1, per_submap)):
        b = min(a + per_submap, len(path) - 1)
        local, P = [np.array([0.0, 0, 0, 0, 0, 0, 1])], [np.zeros((6, 6))]
        for step in se3.se3_between(path[a:b], path[a + 1 : b + 1]):
            measured = se3.se3_compose(step, se3.se3_exp(STEP_SIGMA * rng.standard_normal(6)))
            A = se3.se3_adjoint(se3.se3_inverse(measured))
            local.append(se3.se3_compose(local[-1], measured))
            P.append(A @ P[-1] @ A.T + np.diag(STEP_SIGMA**2))
        make, kind = (clouded, "cloud") if clouds else (mapped, "grid")
        seen = {kind: make(world, path[a : b + 1], rng, believed=np.stack(local))}
        submaps.append(
            Submap(
                key=k, interval=(times[a], times[b]), exit_pose=local[-1], exit_covariance=P[-1],
                trajectory=Trajectory(times[a : b + 1], np.stack(local), np.stack(P)), **seen,
                uses=frozenset({"scanner", "wheels"}), report={"ended": "test", "scans": b - a},
            )
        )  # fmt: skip
    return HallDrive(submaps, Trajectory(times, path))
