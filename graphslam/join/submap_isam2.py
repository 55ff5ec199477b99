"""iSAM2 on a chain of submaps with landmark ids, with the result type of the map-joining methods."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import rotation2
from graphslam.core.progress import Bar
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.join.joined_map import in_group_chart
from graphslam.join.submap_blocks import check_identified, landmark_map_of
from graphslam.join.submap_solver import SubmapEstimate
from graphslam.solve.isam2 import Isam2Solver


def solve_submaps_isam2(
    submaps: Sequence[Submap],
    *,
    polish: bool = True,
    progress: bool = False,
) -> SubmapEstimate:
    """Add the submaps one by one, update iSAM2 after each; then solve to the optimum.

    Parameters
    ----------
    submaps : sequence of Submap
        In order, all landmarks with ids.
    polish : bool
        Continue to the batch optimum; ``objective`` is always that of iSAM2 before, so the difference is its gap.
    progress : bool
        Show a progress bar.

    Returns
    -------
    SubmapEstimate
        ``seconds`` is the total time, ``iterations`` the number of updates.
    """
    check_identified(submaps)
    start = time.perf_counter()
    graph = FactorGraph()
    # The landmarks have ids, so nothing uses the poses before the end: relinearised whenever the map grew by a fifth.
    solver = Isam2Solver(graph, relinearize_skip=len(submaps) + 1)
    due = 0
    for k, submap in enumerate(Bar(submaps, name="iSAM2", unit="submap", shown=progress)):
        graph.add_submap(submap)
        solver.update(relinearize=k >= due or k == len(submaps) - 1)
        due = k + max(10, k // 5) if k >= due else due
    objective = graph.objective().total
    polished = None
    if polish:
        solver.solve_to_optimum()
        polished = graph.objective().total
    here = solver.solution(gap=False)
    values = graph.values
    return SubmapEstimate(
        poses=values.poses.copy(),
        landmark_ids=values.landmark_ids.copy(),
        landmarks=values.landmarks.copy(),
        information=_vector_information(graph),
        objective=objective,
        objective_polished=polished,
        iterations=solver.updates,
        converged=here.converged,
        seconds=time.perf_counter() - start,
        chart="group" if in_group_chart(submaps) else "cartesian",
        anchors=_first_seen(submaps, values.landmark_ids),
    )


def _first_seen(submaps: Sequence[Submap], landmark_ids: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Index of the submap that observed each landmark first."""
    first: dict[int, int] = {}
    for k, s in enumerate(submaps):
        for i in landmark_map_of(s).ids.tolist():
            first.setdefault(i, k)
    return np.array([first[i] for i in landmark_ids.tolist()], dtype=np.int64)


def _vector_information(graph: FactorGraph) -> sp.csc_matrix:
    """Gauss–Newton matrix with poses as (x, y, θ) vectors: ``Gᵀ A G``, ``G = blkdiag(R(θ)ᵀ, 1)`` per pose."""
    values = graph.values
    A = graph.flat().evaluate(values, dense=False).A
    blocks = np.zeros((len(values.poses) - 1, 3, 3))
    blocks[:, :2, :2] = np.swapaxes(rotation2(values.poses[1:, 2]), 1, 2)  # tangent step = R(θ)ᵀ · world step
    blocks[:, 2, 2] = 1.0
    G = sp.block_diag([*blocks, sp.eye(2 * len(values.landmarks))], format="csc")
    return sp.csc_matrix(G.T @ A @ G)
