"""Small laps worlds whose dense matrices can be written out."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.schur import Network, Workers, WorkRanges, step_poses
from graphslam_studies.sim.laps import Laps, LapsConfig, draw_laps
from tests.reference import dense_skeleton as dense

SMALL = LapsConfig(poses=96, laps=4, begin=3, reach=5, gps_every=4, spacing=0.5)


@pytest.fixture(scope="session")
def laps() -> Laps:
    return draw_laps(SMALL, seed=3)


@pytest.fixture(scope="session")
def problem(laps: Laps) -> SkeletonProblem:
    return laps.problem()


@pytest.fixture(scope="session")
def poses(laps: Laps) -> Poses:
    """Not at the optimum, so that residuals are not small."""
    rng = np.random.default_rng(5)
    return step_poses(laps.truth, 0.02 * rng.standard_normal((SMALL.poses, 6)))


@pytest.fixture(scope="session")
def network(problem: SkeletonProblem, poses: Poses) -> Network:
    return Network(WorkRanges(problem, Workers(1)), poses)


@pytest.fixture(scope="session")
def written_out(problem: SkeletonProblem, poses: Poses) -> dense.Rows:
    return dense.rows(problem, poses, dense.best_landmarks(problem, poses))
