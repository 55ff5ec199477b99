"""The batch optimum of a pose network from several starts, because a local minimum is not an answer."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from graphslam.core.errors import IndeterminateError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.solve.network.batch import BatchProblem, Polished, Problem, polish
from graphslam.solve.network.factors import from_values
from graphslam.solve.network.incremental import run_isam2
from graphslam.solve.network.model import objective
from graphslam.solve.network.sparse import SparseProblem
from graphslam.solve.network.start import chordal_start, landmarks_from, odometry_start, tree_start

log = logging.getLogger(__name__)

Start = tuple[Array, Array]
# Two starts agree, and one beats another, at this relative difference of the objective.
SAME = 1e-6
# Starts with initial objectives as close as this are one start (a file's values are often its printed odometry).
TWIN = 1e-5
# Networks with more residuals than this stop at the first two starts that agree on the lowest objective.
LARGE = 50_000


@dataclass(frozen=True, slots=True)
class StartReport:
    """What became of one start.

    Parameters
    ----------
    name : str
    objective_initial, objective : float
        Before and after descent.
    iterations : int
    status : str
        "converged", "rejected" (could not get below another start), "stalled", "out of iterations",
        "same as …" (not tried) or "failed".
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
    return from_values(network, run_isam2(network))


# In the order in which they are tried.
STARTS: dict[str, Callable[[PoseNetwork], Start | None]] = {
    "incremental": _incremental,
    "chordal": _chordal,
    "file": _file,
    "tree": _tree,
    "odometry": _odometry,
}


def default_starts(network: PoseNetwork) -> tuple[str, ...]:
    """Names of the starts worth trying.

    The rotations of a landmark network are tied by odometry alone, so rotations first know nothing of its loops: it
    is built up pose by pose instead.
    """
    names = ["chordal", "file", "tree", "odometry"]
    if len(network.observations) and network.observation_kind == "bearing-range":
        names.insert(0, "incremental")
    return tuple(n for n in names if n != "file" or network.has_initial.all())


def canonical_start(network: PoseNetwork) -> Start:
    """What the file says: its values where it has them all, else its odometry chain."""
    return _file(network) or _odometry(network)


def make_problem(network: PoseNetwork) -> Problem:
    """GTSAM's factors; plain numpy where GTSAM has no native factor (Cartesian landmark observations)."""
    if len(network.observations) and network.observation_kind != "bearing-range":
        return SparseProblem(network)
    return BatchProblem(network)


@dataclass(frozen=True, slots=True)
class Optimum:
    """Best of several starts."""

    problem: Problem
    best: Polished
    start: str
    reports: tuple[StartReport, ...]

    @property
    def iterations(self) -> int:
        """Steps of all starts together."""
        return sum(r.iterations for r in self.reports)


def best_of_starts(
    network: PoseNetwork,
    names: Sequence[str] | None = None,
    *,
    given: dict[str, Start] | None = None,
    problem: Problem | None = None,
    progress: bool = False,
) -> Optimum:
    """Descend from every start that can compete and keep the lowest objective.

    Parameters
    ----------
    names : sequence of str, optional
        Keys of :data:`STARTS`; :func:`default_starts` if not given.
    given : dict of str to (poses, landmarks), optional
        Further starts, tried first.
    problem : Problem, optional
        How the network is solved; GTSAM if it can.

    Raises
    ------
    UnknownNameError
        For a start that does not exist.
    IndeterminateError
        If every start ends in a singular system.
    """
    chosen = tuple(names) if names is not None else default_starts(network)
    for name in chosen:
        if name not in STARTS:
            raise UnknownNameError("start", name, STARTS)
    problem = problem or make_problem(network)
    given = given or {}
    offered = [*given, *(n for n in chosen if n not in given)]
    best: Polished | None = None
    winner = ""
    reports: list[StartReport] = []
    failure: IndeterminateError | None = None
    for name in tqdm(offered, desc="starts", unit="start", disable=not progress, leave=False):
        if best is not None and network.residuals > LARGE and _agreed(reports, best.objective):
            break
        try:
            start = given[name] if name in given else STARTS[name](network)
        except IndeterminateError as error:
            failure = error
            reports.append(StartReport(name, float("inf"), float("inf"), 0, "failed"))
            continue
        if start is None:
            continue
        initial = objective(network, *start)
        twin = next((r for r in reports if abs(r.objective_initial - initial) <= TWIN * abs(initial)), None)
        if twin is not None:
            reports.append(StartReport(name, initial, twin.objective, 0, f"same as {twin.name}"))
            continue
        end = polish(problem, problem.values(*start), best_known=np.inf if best is None else best.objective)
        reports.append(StartReport(name, initial, end.objective, end.iterations, end.status))
        log.info("%s: %s %.8g -> %.8g (%s)", network.source, name, initial, end.objective, end.status)
        if best is None or _better(end, best):
            best, winner = end, name
    if best is None:
        raise failure or IndeterminateError(f"{network.source}: no start could be made")
    return Optimum(problem, best, winner, tuple(reports))


def _better(a: Any, b: Any) -> bool:
    """Lower; or equal, and converged where the other is not."""
    if a.objective < b.objective * (1.0 - SAME):
        return True
    return a.objective <= b.objective * (1.0 + SAME) and a.status == "converged" != b.status


def _agreed(reports: list[StartReport], lowest: float) -> bool:
    same = [r for r in reports if r.status == "converged" and r.objective <= lowest * (1.0 + SAME)]
    return len(same) >= 2
