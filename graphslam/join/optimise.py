"""Least-squares optimum of the submaps, starting from a joined map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.submap import Submap
from graphslam.join.joined_map import JoinResult
from graphslam.join.submap_blocks import SubmapProblem
from graphslam.join.submap_solver import minimise_submaps


def optimise_from_join(submaps: Sequence[Submap], joined: JoinResult) -> JoinResult:
    """Relinearise all submaps, starting at the joined map, until the objective is at its minimum.

    Parameters
    ----------
    submaps : sequence of Submap
        Those that were joined; their ids are replaced by ``joined.submap_ids``.

    Returns
    -------
    JoinResult
        Poses, landmarks and information of the optimum; ``objective`` stays that of the joined map.
    """
    start, cpu = time.perf_counter(), time.process_time()
    problem = joined.problem
    if problem is None or not problem.is_of(submaps):
        problem = SubmapProblem(submaps, ids=joined.submap_ids)
    x = problem.initial(joined.poses[1:], joined.landmarks)  # both in the order of first observation
    best = minimise_submaps(problem, x)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    return replace(
        joined,
        poses=np.vstack([np.zeros((1, 3)), best.x[: 3 * problem.m].reshape(-1, 3)]),
        landmarks=best.x[3 * problem.m :].reshape(-1, 2).copy(),
        information=problem.pattern.matrix(best.data),
        covariance=None,
        chart=problem.chart,
        objective_polished=best.objective,
        iterations=best.iterations,
        converged=best.converged,
        seconds=joined.seconds + seconds,
        times={**joined.times, "polish": cpu},
    )
