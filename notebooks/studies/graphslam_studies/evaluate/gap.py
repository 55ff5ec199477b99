"""How far above the least-squares optimum a method stands: along the sequence, up the tree, and step by step.

The objective ``Σ rᵀ P⁻¹ r`` over the submaps in a map has one minimum that every method should reach. A map above it
stands at values that the same information contradicts; the difference, in units of χ², is the price of linearising
once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from graphslam.core.errors import DataError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.map_truth import MapTruth
from graphslam.core.progress import Bar
from graphslam.core.submap import Submap
from graphslam.evaluate.consistency import Consistency, nees, vector_pose_error
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinedMapView, landmark_scalars, pose_scalars
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_blocks import SubmapProblem, check_identified
from graphslam.join.submap_solver import SubmapEstimate, minimise_submaps
from graphslam_studies.baselines.online import RelinearisationPolicy, join_online

logger = logging.getLogger(__name__)

_OPTIMUM = RelinearisationPolicy(every=1, rtol=1e-12)
_JOINERS: dict[str, Callable[..., Any]] = {
    "eif-sequential": join_sequential,
    "eif-sequential-classical": partial(join_sequential, classical=True),
    "ekf": join_ekf,
    "eif-online": join_online,
    "optimum": partial(join_online, policy=_OPTIMUM),
}
METHODS = (*_JOINERS, "isam2")
"""Methods that go through the submaps one by one."""


def objectives_along(submaps: Sequence[Submap], method: str, *, progress: bool = False) -> Array:
    """Objective ``(m,)`` of the map right after every submap, over the submaps in it.

    Parameters
    ----------
    submaps : sequence of Submap
        In order, every landmark identified.
    method : str
        ``eif-sequential``: in the chart of the submaps; ``eif-sequential-classical``, ``ekf``: Cartesian, linearised
        once; ``eif-online``: afresh where the policy says so; ``isam2``: what incremental updates leave; ``optimum``:
        at the minimum after every submap.
    progress : bool
        Show a progress bar.
    """
    if method not in METHODS:
        raise UnknownNameError("method along a sequence", method, METHODS)
    check_identified(submaps)
    if method == "isam2":
        return _isam2_along(submaps, progress=progress)
    found = np.empty(len(submaps))

    def note(k: int, view: JoinedMapView) -> None:
        x = view.x[np.concatenate([pose_scalars(view.pose_at).ravel(), landmark_scalars(view.landmark_at).ravel()])]
        # both number their landmarks by first observation; headings need no wrapping, residuals are wrapped
        found[k] = SubmapProblem(submaps[: k + 1], ids=[view.ids[e] for e in view.entries]).objective(x)

    _JOINERS[method](submaps, on_join=note, progress=progress)
    return found


def _isam2_along(submaps: Sequence[Submap], *, progress: bool) -> Array:
    from graphslam.graph.factor_graph import FactorGraph  # gtsam takes a second to load
    from graphslam.solve.isam2 import Isam2Solver

    graph = FactorGraph()
    solver = Isam2Solver(graph)
    found = np.empty(len(submaps))
    for k, submap in enumerate(Bar(submaps, name="iSAM2", unit="submap", shown=progress)):
        graph.add_submap(submap)
        solver.update()
        found[k] = graph.objective().total
    return found


def gap_along(
    submaps: Sequence[Submap],
    methods: Sequence[str] = ("eif-sequential", "eif-online", "isam2"),
    *,
    progress: bool = False,
) -> pd.DataFrame:
    """Objective less that of the optimum of the same submaps, right after every submap.

    Parameters
    ----------
    submaps, progress
        See :func:`objectives_along`.

    Returns
    -------
    DataFrame
        ``submap`` (key), ``method``, ``objective``, ``optimum``, ``gap``. A gap may be negative by rounding, or where
        the method found a lower minimum than the optimum that was followed from submap to submap.
    """
    best = objectives_along(submaps, "optimum", progress=progress)
    keys = [s.key for s in submaps]
    tables = []
    for method in methods:
        own = objectives_along(submaps, method, progress=progress)
        tables.append(
            pd.DataFrame({"submap": keys, "method": method, "objective": own, "optimum": best, "gap": own - best})
        )
    return pd.concat(tables, ignore_index=True)


def pose_consistency_along(
    submaps: Sequence[Submap],
    truth: MapTruth,
    methods: Sequence[str] = ("eif-sequential", "eif-online", "optimum"),
    *,
    progress: bool = False,
) -> dict[str, Consistency]:
    """NEES (eq. 18) of the last end pose right after every submap, a row of one run for each method.

    Parameters
    ----------
    submaps, progress
        See :func:`objectives_along`.
    truth : MapTruth
        With the ends of all submaps.
    methods : sequence of str
        Of :func:`objectives_along`, without ``isam2``.

    Raises
    ------
    UnknownNameError
    DataError
        A submap's end is not in the truth.
    """
    at = {int(key): i for i, key in enumerate(truth.keys)}
    unknown = [s.key for s in submaps if s.key not in at]
    if unknown:
        raise DataError(
            "the end of a submap is not in the ground truth", got=unknown[0], wanted="the ends of all of them"
        )
    ends = truth.exit_poses[[at[s.key] for s in submaps]]
    found = {}
    for method in methods:
        if method not in _JOINERS:
            raise UnknownNameError("method with covariances along a sequence", method, _JOINERS)
        d2 = np.empty(len(submaps))

        def note(k: int, view: JoinedMapView, d2: Array = d2) -> None:
            d2[k] = nees(vector_pose_error(view.pose(), ends[k]), view.pose_covariance())

        _JOINERS[method](submaps, on_join=note, progress=progress)
        found[method] = Consistency(
            quantity="pose at the end of the submap", nees=d2[None], dof=np.array(3), gauge="first base fixed"
        )
    return found


def gap_by_tree(submaps: Sequence[Submap], *, classical: bool = False, progress: bool = False) -> pd.DataFrame:
    """Objective of every node of the join tree less that of the optimum of the submaps below it.

    Parameters
    ----------
    submaps : sequence of Submap
        In order, every landmark identified.
    classical : bool
        Cartesian and linearised once, as in the paper, instead of in the chart of the submaps.
    progress : bool
        Show a progress bar.

    Returns
    -------
    DataFrame
        ``level`` (1: pairs of submaps), ``first``, ``last`` (positions, from 0), ``objective``, ``optimum``, ``gap``
        and ``own``: the gap less that of its two children, which is what this one join has added.
    """
    check_identified(submaps)
    m = len(submaps)
    spans = [
        (level, first, min(first + 2**level, m))
        for level in range(1, max(m - 1, 1).bit_length() + 1)
        for first in range(0, m, 2**level)
        if m - first > 2 ** (level - 1)  # an odd one out goes up by itself, without a join
    ]
    rows = []
    gaps: dict[tuple[int, int], float] = {}
    for level, first, end in Bar(spans, name="tree", unit="join", shown=progress):
        below = submaps[first:end]
        joined = join_tree(below, classical=classical)
        best = optimise_from_join(below, joined).objective_polished
        assert best is not None
        gap = joined.objective - best
        middle = first + 2 ** (level - 1)
        own = gap - gaps.get((first, middle), 0.0) - gaps.get((middle, end), 0.0)
        gaps[first, end] = gap
        rows.append((level, first, end - 1, joined.objective, best, gap, own))
    return pd.DataFrame(rows, columns=["level", "first", "last", "objective", "optimum", "gap", "own"])


def polish_history(
    submaps: Sequence[Submap], start: SubmapEstimate | None = None, *, rtol: float = 1e-12, max_iterations: int = 50
) -> Array:
    """Objective before every Gauss–Newton step and at the end ``(iterations + 1,)``.

    Parameters
    ----------
    start : SubmapEstimate, optional
        Map to start from, of these submaps and unpolished; default the chain of submaps.
    rtol, max_iterations
        See :func:`~graphslam.join.submap_solver.minimise_submaps`.
    """
    problem = SubmapProblem(submaps)
    x = problem.initial() if start is None else problem.initial(start.poses[1:], start.landmarks)
    return np.array(minimise_submaps(problem, x, rtol=rtol, max_iterations=max_iterations).history)
