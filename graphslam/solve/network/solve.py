"""``solve_network``: one function, four solvers, and an answer that says how good it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, SolverError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.solve.network.descent import SAME, Polished, Problem, is_converged, polish
from graphslam.solve.network.diagnose import check_determined, check_full_rank
from graphslam.solve.network.model import objective, subnetwork
from graphslam.solve.network.multistart import (
    Optimum,
    StartReport,
    best_of_starts,
    canonical_start,
    default_starts,
    native,
    native_problem,
)
from graphslam.solve.network.sparse import PcgProblem

if TYPE_CHECKING:
    from graphslam.solve.network.batch import BatchProblem
    from graphslam.solve.network.certificate import Certificate
    from graphslam.solve.network.robust import Robust

# A threshold at 0.99 leaves out one right loop in a hundred, which alone costs the rest more than 1 % (measured).
INLIER_PROBABILITY = 0.9999
# Least squares of all measurements, beside the robust answer, gets so many steps.
BATCH_STEPS = 10
# … unless more than this share of everything is left out.
FEW = 0.05


@dataclass(frozen=True, slots=True)
class NetworkSolution:
    """Answer of a solver to a pose network.

    Parameters
    ----------
    network : PoseNetwork
        What was solved.
    solver : str
    poses : (n, 3) or (n, 7)
    landmarks : (l, 2)
    objective : float
        ``Σ rᵀ Ω r`` with GTSAM's residual (full logarithm), over all edges and observations.
    objective_initial : float
        The same at what the file says: its values, or its odometry chain if it has edges only.
    iterations : int
        Steps of the descent that won (all solvers count linear solves of the whole network).
    seconds : float
    converged : bool
        At a stationary point (the decrement is negligible) *and* not above the best objective that any start
        reached. For gnc: at a stationary point of the inliers' objective.
    decrement : float
        Predicted further fall of the objective (gnc: of the inliers' objective).
    gap : float
        Objective minus the lowest that any start reached in this run (there may be one only); nan where the start that
        reached it did not converge, because then no optimum is known to measure against. For gnc it is what leaving
        out outliers costs in the objective of all measurements, against what a few steps of least squares from there
        reach (or the starts that were asked for); nan if so much is left out that this was not tried.
    start : str
        Which start won.
    starts : tuple of StartReport
        What every start that was tried reached.
    initial : tuple of (n, 3 | 7), (l, 2)
        What the file says.
    details : dict
        What only this solver has to say.
    inliers : (m + k,) bool or None
        Edges, then observations, that gnc kept; None from solvers that keep everything.
    certificate : Certificate or None
        If it was asked for.
    """

    network: PoseNetwork
    solver: str
    poses: Array
    landmarks: Array
    objective: float
    objective_initial: float
    iterations: int
    seconds: float
    converged: bool
    decrement: float
    gap: float
    start: str
    starts: tuple[StartReport, ...]
    initial: tuple[Array, Array]
    details: dict[str, Any] = field(default_factory=dict)
    inliers: npt.NDArray[np.bool_] | None = None
    certificate: Certificate | None = None

    @property
    def objective_g2o(self) -> float:
        """``Σ rᵀ Ω r`` with g2o's residual (x, y, θ or t, vec q) at the same answer."""
        return objective(self.network, self.poses, self.landmarks, "g2o")

    @property
    def objective_g2o_initial(self) -> float:
        """g2o's objective at what the file says."""
        return objective(self.network, *self.initial, "g2o")

    def to_network(self) -> PoseNetwork:
        """The network with the solution as its values, ready to be written."""
        return self.network.with_poses(self.poses, self.landmarks)

    def __repr__(self) -> str:
        gap = f"gap {self.gap:.6g}" if np.isfinite(self.gap) else f"about {self.decrement:.2g} above a minimum"
        state = "converged" if self.converged else f"NOT converged ({gap})"
        return (
            f"NetworkSolution({self.solver}: {self.objective_initial:.8g} -> {self.objective:.8g}, {state}, from "
            f"{self.start}, {self.iterations} iterations, {self.seconds:.2f} s)"
        )


@dataclass(frozen=True, slots=True)
class _Answer:
    values: Any
    arrays: tuple[Array, Array]
    iterations: int
    optimum: Optimum
    start: str
    details: dict[str, Any]
    # what the solver minimised, where that is not the whole objective
    minimised: Problem | None = None
    minimum: float | None = None
    inliers: npt.NDArray[np.bool_] | None = None


Solver = Callable[[PoseNetwork, Sequence[str] | None, dict[str, Any], bool], _Answer]


def solve_network(
    network: PoseNetwork,
    solver: str = "lm",
    *,
    starts: Sequence[str] | str | None = None,
    certificate: bool = False,
    progress: bool = False,
    **options: Any,
) -> NetworkSolution:
    """Solve a pose network.

    Parameters
    ----------
    network : PoseNetwork
    solver : {"lm", "isam2", "gnc", "pcg"}
        Key of :data:`SOLVERS`.
    starts : sequence of str or "all", optional
        Starts to try (:data:`graphslam.solve.network.multistart.STARTS`); "all" that are worth trying for this
        network. If not given one, and the others if there is doubt of its answer
        (:func:`graphslam.solve.network.multistart.doubt`).
    certificate : bool
        Also say whether the answer is the global optimum of what was minimised (for gnc: of the inliers), in
        ``NetworkSolution.certificate``.
    progress : bool
        Progress bars on stderr.
    **options
        isam2: ``relinearise`` (True: close the gap), ``batch``, ``relinearize_threshold``, ``relinearize_skip``;
        gnc: ``inlier_probability`` (0.9999), ``trust_odometry`` (True), ``noise_scale`` (true over stated variance;
        None: estimated); pcg: ``tolerance``, ``max_iterations``.

    Raises
    ------
    UnknownNameError, ConfigError
        Unknown solver, start or option.
    IndeterminateError
        Variables that the measurements do not determine, by name.
    """
    if solver not in SOLVERS:
        raise UnknownNameError("solver", solver, SOLVERS)
    run, known = SOLVERS[solver]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ConfigError(f"solver {solver} has no option {unknown[0]!r}; known: {', '.join(known) or 'none'}")
    if starts is not None:
        starts = default_starts(network) if starts == "all" else [starts] if isinstance(starts, str) else list(starts)
    begin = time.perf_counter()
    check_determined(network)
    initial = canonical_start(network)
    check_full_rank(network, *initial)
    answer = run(network, starts, options, progress)
    poses, landmarks = answer.arrays
    best = answer.optimum.best
    value = best.objective if answer.values is best.values else objective(network, poses, landmarks)
    gap = value - best.objective
    if answer.values is best.values and best.status == "converged":
        # judged where the descent ended: evaluated again one step on, a decrement at the limit may lie beyond it
        decrement, stationary = best.decrement, True
    else:
        decrement = (answer.minimised or answer.optimum.problem).decrement(answer.values)
        stationary = is_converged(network, value if answer.minimum is None else answer.minimum, decrement)
    at_optimum = gap <= SAME * abs(best.objective) + 1e-12 * network.residuals
    shown = None
    if certificate:
        from graphslam.solve.network.certificate import certify

        judged = network if answer.inliers is None else subnetwork(network, answer.inliers)
        shown = certify(judged, poses, objective(judged, poses, landmarks))
    return NetworkSolution(
        network=network,
        solver=solver,
        poses=poses,
        landmarks=landmarks,
        objective=value,
        objective_initial=objective(network, *initial),
        iterations=answer.iterations,
        seconds=time.perf_counter() - begin,
        converged=bool(stationary and (at_optimum or answer.minimised is not None)),
        decrement=decrement,
        gap=max(gap, 0.0) if best.status == "converged" or answer.minimised is not None else float("nan"),
        start=answer.start,
        starts=answer.optimum.reports,
        initial=initial,
        details=answer.details,
        inliers=answer.inliers,
        certificate=shown,
    )


def _certified(problem: Problem, end: Polished) -> bool:
    from graphslam.solve.network.certificate import certify

    poses, _ = problem.arrays(end.values)
    return certify(problem.network, poses, end.objective, eigenvalue=False).verdict == "certified"


def _lm(network: PoseNetwork, starts: Sequence[str] | None, options: dict[str, Any], progress: bool) -> _Answer:
    optimum = best_of_starts(network, starts, certified=_certified, progress=progress)
    best = optimum.best
    arrays = optimum.problem.arrays(best.values)
    return _Answer(best.values, arrays, best.iterations, optimum, optimum.start, {"doubt": optimum.doubt})


def _pcg(network: PoseNetwork, starts: Sequence[str] | None, options: dict[str, Any], progress: bool) -> _Answer:
    problem = PcgProblem(network, **options)
    optimum = best_of_starts(network, starts, problem=problem, certified=_certified, progress=progress)
    best, report = optimum.best, problem.report
    details = {
        "doubt": optimum.doubt,
        "linear_solves": report.solves,
        "cg_iterations": report.iterations,
        "cg_unconverged": report.unconverged,
        "worst_linear_residual": max(report.residuals, default=0.0),
        "decrement_by": "direct sparse solve",
    }
    return _Answer(best.values, problem.arrays(best.values), best.iterations, optimum, optimum.start, details)


def _isam2(network: PoseNetwork, starts: Sequence[str] | None, options: dict[str, Any], progress: bool) -> _Answer:
    from graphslam.solve.network.incremental import Isam2Options, relinearise_all, run_isam2

    options = dict(options)
    close = bool(options.pop("relinearise", True))
    problem = _native(network, "isam2")
    begin = time.perf_counter()
    settings = Isam2Options(factorization=problem.factorization, **options)
    grown = run_isam2(network, settings, progress=progress)
    seconds = time.perf_counter() - begin
    # the batch optimum is what the gap is measured against; iSAM2's own estimate is one of its starts
    names = None if starts is None else [n for n in starts if n != "incremental"]
    given = {"incremental": problem.arrays(grown)}
    optimum = best_of_starts(network, names, given=given, problem=problem, certified=_certified, progress=progress)
    lowest, raw = optimum.best.objective, problem.objective(grown)
    details: dict[str, Any] = {
        "doubt": optimum.doubt,
        "objective_incremental": raw,
        "gap_incremental": raw - lowest,
        "seconds_incremental": seconds,
    }
    values, updates, start = grown, 0, "incremental"
    if close:
        values, updates = relinearise_all(network, problem.graph, grown, factorization=problem.factorization)
        own = problem.objective(values)
        details["objective_relinearised"] = own
        details["reseeded"] = False
        if own > lowest * (1.0 + SAME) + 1e-12 * network.residuals:
            # another basin is lower: iSAM2 goes on from the start that found it
            values, more = relinearise_all(
                network, problem.graph, optimum.best.values, factorization=problem.factorization
            )
            updates, start = updates + more, optimum.start
            details["reseeded"] = True
    return _Answer(values, problem.arrays(values), updates, optimum, start, details)


def _gnc(network: PoseNetwork, starts: Sequence[str] | None, options: dict[str, Any], progress: bool) -> _Answer:
    from graphslam.solve.network.consensus import odometry_edges  # scipy's statistics take a second to load
    from graphslam.solve.network.robust import truncated_cost, truncated_least_squares

    probability = float(options.get("inlier_probability", INLIER_PROBABILITY))
    scale = options.get("noise_scale")
    problem = _native(network, "gnc")
    # least squares of everything, from every start, is worth its time only if asked for: wrong loops make it slow
    asked = best_of_starts(network, starts, problem=problem, progress=progress) if starts is not None else None
    trust = bool(options.get("trust_odometry", True))
    given = {asked.start: asked.best.values} if asked is not None else {}
    if not given and not (trust and odometry_edges(network).any()):
        # nothing is trusted, so nothing else can make a start
        asked = best_of_starts(network, starts, problem=problem, progress=progress)
        given = {asked.start: asked.best.values}
    robust = truncated_least_squares(
        problem,
        given,
        probability,
        trust_odometry=trust,
        noise_scale=None if scale is None else float(scale),
        progress=progress,
    )
    end = robust.end
    optimum = asked or _from_robust(network, problem, robust)
    out = np.flatnonzero(~robust.inliers)
    m = len(network.edges)
    details = {
        "outliers": len(out),
        "outlier_names": [
            network.edge_name(int(k)) if k < m else network.observation_name(int(k) - m) for k in out[:20]
        ],
        "objective_inliers": end.objective,
        "objective_truncated": robust.truncated,
        "objective_truncated_batch": truncated_cost(network, problem.arrays(optimum.best.values), robust.limit),
        "inlier_probability": probability,
        "noise_scale": robust.scale,
        "edge_limit": float(np.min(robust.limit[:m], initial=np.inf, where=np.isfinite(robust.limit[:m]))),
        "robust_start": robust.start,
        "robust_starts": robust.reached,
    }
    return _Answer(
        end.values,
        problem.arrays(end.values),
        end.iterations,
        optimum,
        robust.start,
        details,
        robust.problem,
        end.objective,
        robust.inliers,
    )


def _from_robust(network: PoseNetwork, problem: BatchProblem, robust: Robust) -> Optimum:
    """What least squares of everything makes of the robust answer, in a few steps: the gap is measured against it."""
    initial = problem.objective(robust.end.values)
    if np.mean(~robust.inliers) > FEW:
        # random loops fill the factorisation: a step of everything costs many times the whole robust solve
        unknown = Polished(robust.end.values, float("nan"), float("inf"), 0, "rejected")
        return Optimum(problem, unknown, "inliers", (StartReport("inliers", initial, float("nan"), 0, "not tried"),))
    best = polish(problem, robust.end.values, max_iterations=BATCH_STEPS)
    report = StartReport("inliers", initial, best.objective, best.iterations, best.status)
    return Optimum(problem, best, "inliers", (report,))


def _native(network: PoseNetwork, solver: str) -> BatchProblem:
    if not native(network):
        raise SolverError(
            f"{network.source}: solver {solver} needs GTSAM's native factors, which do not cover Cartesian landmark "
            "observations; use lm or pcg"
        )
    return native_problem(network)


# name -> (function, its options)
SOLVERS: dict[str, tuple[Solver, tuple[str, ...]]] = {
    "lm": (_lm, ()),
    "isam2": (_isam2, ("relinearise", "batch", "relinearize_threshold", "relinearize_skip")),
    "gnc": (_gnc, ("inlier_probability", "trust_odometry", "noise_scale")),
    "pcg": (_pcg, ("tolerance", "max_iterations")),
}
