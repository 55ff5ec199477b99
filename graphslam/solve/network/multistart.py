"""The batch optimum of a pose network from several starts, because a local minimum is not an answer."""

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
# Starts with initial objectives as close as this are one start (a file's values are often its printed odometry).
TWIN = 1e-5
# Networks with more residuals than this stop at the first two starts that agree on the lowest objective.
LARGE = 50_000
# χ² that far above its expectation, in standard deviations of what the stated noise allows, is no chance.
BEYOND = 5.0


@dataclass(frozen=True, slots=True)
class StartReport:
    """What became of one start.

    Parameters
    ----------
    objective_initial, objective : float
        Before and after descent.
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
    from graphslam.solve.network.incremental import grow_with_isam2

    found = grow_with_isam2(network)
    return found.poses, found.landmarks


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


def canonical_start(network: PoseNetwork) -> Values:
    """What the file says: its values where it has them all, else its odometry chain."""
    return network_values(network, *(_file(network) or _odometry(network)))


@dataclass(frozen=True, slots=True)
class StartsResult:
    """Best of the starts that were tried.

    Parameters
    ----------
    start : str
        Which won.
    doubt : str
        What spoke against the first start's answer, so that it was certified or the others were tried; empty if
        nothing did, or if starts were named.
    """

    problem: SparseProblem
    best: Optimum
    start: str
    reports: tuple[StartReport, ...]
    doubt: str = ""

    @property
    def iterations(self) -> int:
        """Steps of all starts together."""
        return sum(r.iterations for r in self.reports)


def suspicion_of_answer(network: PoseNetwork, end: Optimum) -> str:
    """Why an answer may not be the best one, in words; empty if nothing speaks against it.

    * The descent did not end at a stationary point.
    * A cycle of edges is wound (:func:`~graphslam.solve.network.start.wound_cycles`): every minimum other than the
      best that was met from random starts on the recorded networks shows that, or the next.
    * χ² is beyond what the stated noise allows, and the cycles do not decide whether it is the noise or the answer.
    * Landmarks: their observations close loops that no cycle of edges shows.
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
        return f"chi2 {end.objective:.4g} for {dof} degrees of freedom"
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
    """Descend from a start, from all that can compete if there is doubt of the answer, and keep the lowest objective.

    Parameters
    ----------
    names : sequence of str, optional
        Keys of :data:`STARTS`, all of which are tried. If not given: the first (of ``given``, then of
        :func:`default_starts`), and the others if there is :func:`suspicion_of_answer` that no certificate settles.
    given : dict of str to Values, optional
        Further starts, tried first.
    flat : FactorArrays, optional
        The network as a problem, where it was made already.
    problem : SparseProblem, optional
        How it is solved; by direct solves if not given.
    certified : callable, optional
        Whether an answer is proved to be the best, which settles a doubt for less than other starts cost.
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
        end = descend_to_minimum(problem, start, best_known=known, foretell=True)
        if end.status in ("stalled", "out of iterations") and not problem.thorough:
            problem.thorough = True
            end = descend_to_minimum(problem, end.values, best_known=known, foretell=True)
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
    """Lower; or equal, and converged where the other is not."""
    if a.objective < b.objective * (1.0 - SAME):
        return True
    return a.objective <= b.objective * (1.0 + SAME) and a.status == "converged" != b.status


def _agreed(reports: list[StartReport], lowest: float) -> bool:
    same = [r for r in reports if r.status == "converged" and r.objective <= lowest * (1.0 + SAME)]
    return len(same) >= 2
