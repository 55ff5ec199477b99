"""Every way of joining dense submaps: EIF in sequence and by binary tree, EKF, batch, iSAM2; see :mod:`.pose_map`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt

from graphslam.core.progress import Bar
from graphslam.join.joined_map import JoinTimes
from graphslam.join.pose_ekf import PoseFilter
from graphslam.join.pose_estimate import PoseEstimate, estimate_of_map, evaluate_map, optimise_poses, up_direction
from graphslam.join.pose_map import PoseMap, join_poses
from graphslam.join.pose_problem import PoseProblem

Index = npt.NDArray[np.int64]
_NONE = np.zeros(0, dtype=np.int64)


class SortedFactors:
    """The ties of a problem, by where they enter.

    Attributes
    ----------
    inside : list of (e_k,)
        Edges between two nodes of submap k alone.
    across : list of (c_k,)
        Edges from a node of an earlier submap to one that submap k brings in.
    levels : list of (l_k,)
        Gravity at nodes that submap k brings in.
    """

    def __init__(self, problem: PoseProblem) -> None:
        m = len(problem.keys)
        self.low, self.high = problem.ends.min(axis=1), problem.ends.max(axis=1)
        owner = problem.submap_of(self.high)
        own = self.low >= problem.bases[owner]
        self.inside = _by_group(np.flatnonzero(own), owner, m)
        self.across = _by_group(np.flatnonzero(~own), owner, m)
        self.levels = _by_group(np.arange(len(problem.level_nodes)), problem.submap_of(problem.level_nodes), m)


def _by_group(rows: Index, group: Index, m: int) -> list[Index]:
    order = rows[np.argsort(group[rows], kind="stable")]
    return np.split(order, np.searchsorted(group[order], np.arange(1, m)))


@cache
def load_kernels() -> None:
    """Compiled kernels are loaded at their first use, which takes longer than most joins and is not part of any."""
    ends, W = np.array([[0, 1], [1, 2], [0, 2]]), np.broadcast_to(np.eye(3), (3, 3, 3))
    tiny = PoseProblem(
        ends, np.zeros((3, 3)), W, _NONE, np.zeros((0, 3)), np.zeros((0, 2, 2)),
        keys=np.zeros(1, dtype=np.int64), bases=np.array([0, 2]), times=np.arange(3.0),
    )  # fmt: skip
    leaf = PoseMap.leaf(tiny)  # the dense solver
    leaf.solve(*leaf.linearised(tiny))  # the sparse one


def leaf_maps(problem: PoseProblem, ties: SortedFactors, times: JoinTimes, progress: bool = False) -> list[PoseMap]:
    """Every submap as a map of its own, at its own optimum."""
    load_kernels()
    with times.measure("leaves"):
        return [
            PoseMap.leaf(problem.part(k, k + 1, ties.inside[k], ties.levels[k]))
            for k in Bar(range(len(problem.keys)), name="leaves", unit="submap", shown=progress)
        ]


def join_poses_sequential(problem: PoseProblem, *, passes: int = 1, progress: bool = False) -> PoseEstimate:
    """Join submaps one after the other; a tie enters with the later of its submaps.

    Parameters
    ----------
    passes : int
        How often the ties of a join are linearised.
    progress : bool
        Show a progress bar.
    """
    ties, times = SortedFactors(problem), JoinTimes()
    leaves = leaf_maps(problem, ties, times, progress)
    joined = leaves[0]
    for k, leaf in enumerate(Bar(leaves[1:], name="join", unit="submap", shown=progress), start=1):
        joined = join_poses(joined, leaf, problem.take(ties.across[k], _NONE), times, passes=passes)
    return estimate_of_map(problem, joined, method="eif-sequential", times=times)


def join_poses_tree(problem: PoseProblem, *, passes: int = 1, progress: bool = False) -> PoseEstimate:
    """Join submaps pairwise, then the pairs, and so on; a tie enters where both its ends first meet.

    Parameters
    ----------
    problem, passes, progress
        As in :func:`join_poses_sequential`.
    """
    ties, times = SortedFactors(problem), JoinTimes()
    leaves = leaf_maps(problem, ties, times, progress)
    bases = problem.bases
    with Bar(total=len(leaves) - 1, name="join", unit="join", shown=progress) as bar:

        def joined(a: int, b: int, edges: Index) -> PoseMap:
            """Submaps a … b - 1 with the edges between different ones of them."""
            if b == a + 1:
                return leaves[a]
            middle = a + (1 << (b - a - 1).bit_length() - 1)
            left, right = ties.high[edges] <= bases[middle], ties.low[edges] >= bases[middle]
            A, B = joined(a, middle, edges[left]), joined(middle, b, edges[right])
            bar.update()
            meet = edges[~left & ~right]
            return join_poses(A, B, problem.take(meet, _NONE, int(bases[a])), times, passes=passes)

        root = joined(0, len(leaves), np.concatenate(ties.across))
    return estimate_of_map(problem, root, method="eif-tree", times=times)


def join_poses_ekf(problem: PoseProblem, *, progress: bool = False) -> PoseEstimate:
    """Join submaps one after the other with a dense extended Kalman filter."""
    ties, times = SortedFactors(problem), JoinTimes()
    dense = PoseFilter(problem)
    leaves = leaf_maps(problem, ties, times, progress)
    for k, leaf in enumerate(Bar(leaves, name="join", unit="submap", shown=progress)):
        with times.measure("update"):
            dense.join(leaf, problem.take(ties.across[k], _NONE))
    return evaluate_map(
        problem, dense.poses, up_direction(dense.up), method="ekf", seconds=times.wall, times=times,
        covariance=dense.covariance,
    )  # fmt: skip


def solve_poses(problem: PoseProblem, *, polish: bool = True, progress: bool = False) -> PoseEstimate:
    """Least squares of everything at once, from the chain alone: at its optimum whatever ``polish`` says."""
    load_kernels()
    t0 = time.perf_counter()
    begun = evaluate_map(problem, problem.start, None, method="batch", seconds=time.perf_counter() - t0)
    best = optimise_poses(problem, begun)
    assert best.objective_polished is not None
    return replace(best, objective=best.objective_polished)


def join_poses_isam2(problem: PoseProblem, *, progress: bool = False) -> PoseEstimate:
    """Add submap by submap, updating iSAM2 after each.

    Returns
    -------
    PoseEstimate
        As iSAM2 leaves it, above the optimum by its linearisation gap; ``iterations`` are the updates.
    """
    from graphslam.graph.factor_graph import FactorGraph
    from graphslam.graph.factor_graph_state import BetweenBlock  # gtsam takes a second to load
    from graphslam.solve.isam2 import Isam2Solver

    load_kernels()
    start = time.perf_counter()
    ties, g = SortedFactors(problem), problem.group
    graph = FactorGraph(problem.dim)
    solver = Isam2Solver(graph)
    number = 0
    for k in Bar(range(len(problem.keys)), name="iSAM2", unit="submap", shown=progress):
        a, b = problem.bases[k], problem.bases[k + 1]
        chain = g.between(problem.start[a], problem.start[a + 1 : b + 1])
        graph.structure.append("x", g.compose(graph.pose(int(a)), chain))
        rows = np.concatenate([ties.inside[k], ties.across[k]])
        block = BetweenBlock(
            number, problem.ends[rows], problem.measured[rows], problem.whiteners[rows], "between",
            np.ones(len(rows), dtype=np.bool_),
        )  # fmt: skip
        graph.records.add_block(block)
        number += len(rows)
        for record in problem.attitudes(ties.levels[k], number):
            graph.start_tilt()
            graph.insert(record)
            number += 1
        graph.revision += 1
        solver.update()
    values = graph.values
    system = problem.flat.evaluate(values, dense=False)
    return evaluate_map(
        problem, values.poses.copy(), values.tilt, method="isam2", seconds=time.perf_counter() - start,
        information=system.A, iterations=solver.updates,
    )  # fmt: skip


POSE_JOINERS: dict[str, Callable[..., PoseEstimate]] = {
    "eif-tree": join_poses_tree,
    "eif-sequential": join_poses_sequential,
    "ekf": join_poses_ekf,
    "isam2": join_poses_isam2,
}

POSE_SOLVERS: dict[str, Callable[..., PoseEstimate]] = {"batch": solve_poses}
