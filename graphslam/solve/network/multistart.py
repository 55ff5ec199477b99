"""Batch optimum of a pose network from several starts, to avoid local minima."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import IndeterminateError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.network import network_values
from graphslam.graph.variables import Values
from graphslam.solve.descent import SAME, Optimum, descend_to_minimum
from graphslam.solve.network.start import (
    chordal_start,
    landmarks_from,
    network_arrays,
    odometry_start,
    tree_start,
    wound_cycles,
)
from graphslam.solve.sparse import SparseProblem

log = logging.getLogger(__name__)

Start = tuple[Array, Array]
# Starts with a smaller relative difference of the initial objective are equal (values in files are often the odometry).
TWIN = 1e-5
# Larger networks (number of residuals) stop at the first two starts with the same lowest objective.
LARGE = 50_000
# Limit of χ² above its expectation, in standard deviations under the noise of the file.
BEYOND = 5.0


@dataclass(frozen=True, slots=True)
class StartReport:
    """Result of one start.

    Parameters
    ----------
    objective_initial, objective : float
        Before and after descent.
    status : str
        "converged", "rejected" (another start is lower), "stalled", "out of iterations", "same as …" (not tried) or
        "failed".
    """

    name: str
    objective_initial: float
    objective: float
    iterations: int
    status: str


def _file(network: PoseNetwork) -> Start | None:
    if not network.has_initial.all():
        return None
    marks = landmarks_from(network, network.poses)
    return network.poses, np.where(network.has_landmark[:, None], network.landmarks, marks)


def _odometry(network: PoseNetwork) -> Start:
    poses = odometry_start(network)
    return poses, landmarks_from(network, poses)


def _tree(network: PoseNetwork) -> Start:
    poses = tree_start(network)
    return poses, landmarks_from(network, poses)


def _chordal(network: PoseNetwork) -> Start:
    poses, marks = chordal_start(network)
    return poses, marks


def _incremental(network: PoseNetwork) -> Start:
    from graphslam.solve.network.incremental import grow_with_isam2

    found = grow_with_isam2(network)
    return found.poses, found.landmarks


# In the order of trial.
STARTS: dict[str, Callable[[PoseNetwork], Start | None]] = {
    "incremental": _incremental,
    "chordal": _chordal,
    "file": _file,
    "tree": _tree,
    "odometry": _odometry,
}


def default_starts(network: PoseNetwork) -> tuple[str, ...]:
    """Names of the useful starts.

    The rotations of a landmark network are constrained only by odometry, so rotations first would ignore its loops: it
    is solved incrementally instead.
    """
    names = ["chordal", "file", "tree", "odometry"]
    if len(network.observations) and network.observation_kind == "bearing-range":
        names.insert(0, "incremental")
    return tuple(n for n in names if n != "file" or network.has_initial.all())


def canonical_start(network: PoseNetwork) -> Values:
    """Values of the file if complete, otherwise its odometry chain."""
    return network_values(network, *(_file(network) or _odometry(network)))


@dataclass(frozen=True, slots=True)
class StartsResult:
    """Best of the starts that were tried.

    Parameters
    ----------
    start : str
        Name of the best start.
    doubt : str
        Reason to doubt the first start's solution, so that a certificate or other starts were tried; empty without a
        reason, or if starts were given.
    """

    problem: SparseProblem
    best: Optimum
    start: str
    reports: tuple[StartReport, ...]
    doubt: str = ""

    @property
    def iterations(self) -> int:
        """Total steps of all starts."""
        return sum(r.iterations for r in self.reports)


def suspicion_of_answer(network: PoseNetwork, end: Optimum) -> str:
    """Reason why a solution may not be the global minimum; empty if there is none.

    * The descent did not end at a stationary point.
    * A cycle of edges is wound (:func:`~graphslam.solve.network.start.wound_cycles`): on the recorded networks, all
      other minima found from random starts show this or the next.
    * χ² is too large for the noise of the file, and the cycles do not decide whether noise or solution is wrong.
    * Landmarks: their observations close loops that are not cycles of edges.
    """
    if end.status != "converged":
        return f"the first start did not converge ({end.status})"
    if len(network.observations):
        return "loops by landmarks show in no cycle of edges"
    wound, undecided, cycles = wound_cycles(network, end.values.poses)
    if wound:
        return f"{wound} of {cycles} cycles turn once too often"
    dof = network.residuals - network.states
    if end.objective > dof + BEYOND * np.sqrt(2.0 * max(dof, 1)):
        return f"chi2 {end.objective:.4g} for {dof} degrees of freedom: wrong edges (try gnc) or too small covariances"
    if 2 * undecided > cycles:
        return f"{undecided} of {cycles} cycles are too noisy to tell turns"
    return ""


def best_of_starts(
    network: PoseNetwork,
    names: Sequence[str] | None = None,
    *,
    given: dict[str, Values] | None = None,
    flat: FactorArrays | None = None,
    problem: SparseProblem | None = None,
    certified: Callable[[PoseNetwork, Optimum], bool] | None = None,
    progress: bool = False,
) -> StartsResult:
    """Descend from one start, or from several if the solution is doubtful, and keep the lowest objective.

    Parameters
    ----------
    names : sequence of str, optional
        Keys of :data:`STARTS` to try. Default: the first (of ``given``, then of :func:`default_starts`), and the others
        if :func:`suspicion_of_answer` has a reason and there is no certificate.
    given : dict of str to Values, optional
        Further starts, tried first.
    flat : FactorArrays, optional
        The network as a problem, if available.
    problem : SparseProblem, optional
        The problem with its linear solver; default: direct solves.
    certified : callable, optional
        Test for global optimality, which is faster than other starts.
    """
    chosen = tuple(names) if names is not None else default_starts(network)
    for name in chosen:
        if name not in STARTS:
            raise UnknownNameError("start", name, STARTS)
    problem = problem or SparseProblem(flat or network_arrays(network))
    given = given or {}
    offered = [*given, *(n for n in chosen if n not in given)]
    best: Optimum | None = None
    winner = ""
    reports: list[StartReport] = []
    failure: IndeterminateError | None = None
    why = ""
    for name in _shown(offered) if progress else offered:
        if best is not None and network.residuals > LARGE and _agreed(reports, best.objective):
            break
        try:
            made = None if name in given else STARTS[name](network)
        except IndeterminateError as error:
            failure = error
            reports.append(StartReport(name, float("inf"), float("inf"), 0, "failed"))
            continue
        if name not in given and made is None:
            continue
        start = given[name] if made is None else network_values(network, *made)
        initial = problem.flat.objective(start)
        twin = next((r for r in reports if abs(r.objective_initial - initial) <= TWIN * abs(initial)), None)
        if twin is not None:
            reports.append(StartReport(name, initial, twin.objective, 0, f"same as {twin.name}"))
            continue
        known = np.inf if best is None else best.objective
        end = descend_to_minimum(problem, start, best_known=known, predict=True)
        if end.status in ("stalled", "out of iterations") and not problem.thorough:
            problem.thorough = True
            end = descend_to_minimum(problem, end.values, best_known=known, predict=True)
        reports.append(StartReport(name, initial, end.objective, end.iterations, end.status))
        log.info("%s: %s %.8g -> %.8g (%s)", network.source, name, initial, end.objective, end.status)
        if best is None or _better(end, best):
            best, winner = end, name
        if names is None and len(reports) == 1:
            why = suspicion_of_answer(network, end)
            if not why or (certified is not None and end.status == "converged" and certified(network, end)):
                break
    if best is None:
        raise failure or IndeterminateError(f"{network.source}: no start could be made")
    return StartsResult(problem, best, winner, tuple(reports), why)


def _shown(names: list[str]) -> Iterable[str]:
    from graphslam.core.progress import Bar

    return Bar(names, name="starts", unit="start")


def _better(a: Any, b: Any) -> bool:
    """Whether a has a lower objective; or an equal one, and only a converged."""
    if a.objective < b.objective * (1.0 - SAME):
        return True
    return a.objective <= b.objective * (1.0 + SAME) and a.status == "converged" != b.status


def _agreed(reports: list[StartReport], lowest: float) -> bool:
    same = [r for r in reports if r.status == "converged" and r.objective <= lowest * (1.0 + SAME)]
    return len(same) >= 2
