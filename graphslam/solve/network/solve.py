"""``solve_network``: solve a pose network with one of four solvers, with convergence diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.network import network_values, problem_of_network
from graphslam.graph.variables import Values
from graphslam.solve.descent import SAME, Optimum, descend_to_minimum, limits_of
from graphslam.solve.network.diagnose import check_determined, check_full_rank
from graphslam.solve.network.multistart import (
    StartReport,
    StartsResult,
    best_of_starts,
    canonical_start,
    default_starts,
)
from graphslam.solve.network.start import network_arrays
from graphslam.solve.sparse import PcgProblem, SparseProblem

if TYPE_CHECKING:
    from graphslam.solve.network.certificate import Certificate
    from graphslam.solve.network.leave_one_out import RobustResult

# A threshold at 0.99 rejects one true loop in a hundred, which increases the error by more than 1 % (measured).
INLIER_PROBABILITY = 0.9999
# Steps of least squares of all measurements after the robust solution …
BATCH_STEPS = 10
# … which is skipped if more than this share was rejected.
FEW = 0.05
# Least number of loops for the test whether most contradict the rest.
FEWEST_LOOPS = 10


@dataclass(frozen=True, slots=True)
class NetworkSolution:
    """Result of a solver for a pose network.

    Parameters
    ----------
    network : PoseNetwork
        The solved network.
    poses : (n, 3) or (n, 7)
    landmarks : (l, 2)
    objective : float
        ``Σ rᵀ Ω r`` with GTSAM's residual (full logarithm), over all edges and observations.
    objective_initial : float
        The same at the values of the file, or at its odometry chain if it has only edges.
    iterations : int
        Steps of the best descent (all solvers count linear solves of the whole network).
    converged : bool
        At a stationary point (the decrement is negligible) *and* not above the best objective of all starts. For gnc:
        at a stationary point of the inliers' objective, and most loops do not contradict each other and the odometry
        (``details["doubt"]``).
    decrement : float
        Predicted further decrease of the objective (gnc: of the inliers' objective).
    gap : float
        Objective minus the lowest of all starts in this run (possibly one); nan if that start did not converge, because
        the optimum is then unknown. For gnc: increase of the objective of all measurements by rejecting outliers,
        relative to the result of a few least-squares steps from there (or of the given starts); nan if too much was
        rejected for this.
    start : str
        Name of the best start.
    starts : tuple of StartReport
        Results of all tried starts.
    initial : Values
        Values of the file.
    details : dict
        Details that are specific to the solver.
    inliers : (m + k,) bool or None
        Edges, then observations, that gnc kept; None for other solvers.
    certificate : Certificate or None
        If requested.
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
    initial: Values
    details: dict[str, Any] = field(default_factory=dict)
    inliers: npt.NDArray[np.bool_] | None = None
    certificate: Certificate | None = None

    @property
    def objective_g2o(self) -> float:
        """``Σ rᵀ Ω r`` with g2o's residual (x, y, θ or t, vec q) at the solution."""
        return g2o_objective(self.network, network_values(self.network, self.poses, self.landmarks))

    @property
    def objective_g2o_initial(self) -> float:
        """g2o's objective at the values of the file."""
        return g2o_objective(self.network, self.initial)

    def to_network(self) -> PoseNetwork:
        """The network with the solution as its values, for writing."""
        return self.network.with_poses(self.poses, self.landmarks)

    def __repr__(self) -> str:
        gap = f"gap {self.gap:.6g}" if np.isfinite(self.gap) else f"about {self.decrement:.2g} above a minimum"
        state = "converged" if self.converged else f"NOT converged ({gap})"
        return (
            f"NetworkSolution({self.solver}: {self.objective_initial:.8g} -> {self.objective:.8g}, {state}, from "
            f"{self.start}, {self.iterations} iterations, {self.seconds:.2f} s)"
        )


def g2o_objective(network: PoseNetwork, values: Values) -> float:
    """``Σ rᵀ Ω r`` with g2o's residual of an edge: (x, y, θ), in 3-D (t, vec q), of the transform whose logarithm
    GTSAM takes. The objective differs wherever a residual is not small."""
    g, (i, j) = group_of(values.poses), network.edges.T
    r = g.between(network.measurements, g.between(values.poses[i], values.poses[j]))
    if network.dim == 3:
        r = np.concatenate([r[:, 3:6], r[:, :3]], axis=1)
    total = float(np.einsum("mi,mij,mj->m", r, network.information, r).sum())
    if len(network.observations):
        total += float(problem_of_network(network, ordered=False).squared(values)[len(r) :].sum())
    return total


@dataclass(frozen=True, slots=True)
class _Answer:
    values: Values
    iterations: int
    optimum: StartsResult
    start: str
    details: dict[str, Any]
    # the minimised problem, if it is not the whole objective
    minimised: SparseProblem | None = None
    minimum: float | None = None
    inliers: npt.NDArray[np.bool_] | None = None


class _Task(NamedTuple):
    network: PoseNetwork
    flat: FactorArrays
    starts: Sequence[str] | None
    options: dict[str, Any]
    progress: bool


Solver = Callable[[_Task], _Answer]


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
    solver : {"lm", "isam2", "gnc", "pcg"}
        Key of :data:`SOLVERS`.
    starts : sequence of str or "all", optional
        Starts to try (:data:`graphslam.solve.network.multistart.STARTS`); "all" that are useful for this network.
        Default: one, and the others if its solution is doubtful
        (:func:`graphslam.solve.network.multistart.suspicion_of_answer`).
    certificate : bool
        Also test whether the solution is the global optimum of the minimised problem (for gnc: of the inliers), in
        ``NetworkSolution.certificate``.
    progress : bool
        Progress bars on stderr.
    **options
        isam2: ``relinearise`` (True: close the gap); gnc: ``inlier_probability`` (0.9999), ``trust_odometry`` (True),
        ``noise_scale`` (true variance over that in the file; None: estimated); pcg: ``tolerance``, ``max_iterations``.
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
    flat = network_arrays(network)
    check_determined(network, flat)
    initial = canonical_start(network)
    check_full_rank(network, flat, initial)
    answer = run(_Task(network, flat, starts, options, progress))
    best = answer.optimum.best
    evaluated = answer.values is best.values and np.isfinite(best.objective)
    value = best.objective if evaluated else flat.objective(answer.values)
    gap = value - best.objective
    if answer.values is best.values and best.converged:
        # evaluated where the descent ended: one step later, a decrement at the limit can be above it
        decrement, stationary = best.decrement, True
    else:
        decrement = (answer.minimised or answer.optimum.problem).decrement(answer.values)
        reached = limits_of(network.residuals).reached
        stationary = reached(value if answer.minimum is None else answer.minimum, decrement)
    at_optimum = gap <= SAME * abs(best.objective) + 1e-12 * network.residuals
    shown = None
    if certificate:
        from graphslam.solve.network.certificate import certify

        judged = network if answer.inliers is None else network.only(answer.inliers)
        shown = certify(judged, answer.values.poses, value if answer.minimum is None else answer.minimum)
    return NetworkSolution(
        network=network,
        solver=solver,
        poses=answer.values.poses,
        landmarks=answer.values.landmarks.reshape(-1, 2),
        objective=value,
        objective_initial=flat.objective(initial),
        iterations=answer.iterations,
        seconds=time.perf_counter() - begin,
        converged=bool(stationary and (at_optimum or answer.minimised is not None))
        and not str(answer.details.get("doubt", "")).startswith("not solved"),
        decrement=decrement,
        gap=max(gap, 0.0) if best.converged or answer.minimised is not None else float("nan"),
        start=answer.start,
        starts=answer.optimum.reports,
        initial=initial,
        details=answer.details,
        inliers=answer.inliers,
        certificate=shown,
    )


def _certified(network: PoseNetwork, end: Optimum) -> bool:
    from graphslam.solve.network.certificate import certify

    return certify(network, end.values.poses, end.objective, eigenvalue=False).verdict == "certified"


def _lm(task: _Task) -> _Answer:
    optimum = best_of_starts(task.network, task.starts, flat=task.flat, certified=_certified, progress=task.progress)
    best = optimum.best
    return _Answer(best.values, best.iterations, optimum, optimum.start, {"doubt": optimum.doubt})


def _pcg(task: _Task) -> _Answer:
    problem = PcgProblem(task.flat, **task.options)
    optimum = best_of_starts(task.network, task.starts, problem=problem, certified=_certified, progress=task.progress)
    best, report = optimum.best, problem.report
    details = {
        "doubt": optimum.doubt,
        "linear_solves": report.solves,
        "cg_iterations": report.iterations,
        "cg_unconverged": report.unconverged,
        "worst_linear_residual": max(report.residuals, default=0.0),
        "decrement_by": "direct sparse solve",
    }
    return _Answer(best.values, best.iterations, optimum, optimum.start, details)


def _isam2(task: _Task) -> _Answer:
    from graphslam.solve.network.incremental import grow_with_isam2

    network, flat, starts, options, progress = task
    close = bool(options.get("relinearise", True))
    begin = time.perf_counter()
    grown = grow_with_isam2(network, progress=progress)
    seconds = time.perf_counter() - begin
    # the gap is measured from the batch optimum; iSAM2's estimate is one of its starts
    names = None if starts is None else [n for n in starts if n != "incremental"]
    given = {"incremental": grown}
    optimum = best_of_starts(network, names, given=given, flat=flat, certified=_certified, progress=progress)
    best, raw = optimum.best, flat.objective(grown)
    details: dict[str, Any] = {
        "doubt": optimum.doubt,
        "objective_incremental": raw,
        "gap_incremental": raw - best.objective,
        "seconds_incremental": seconds,
    }
    if not close:
        return _Answer(grown, 0, optimum, "incremental", details)
    # the gap is closed by relinearisation: by the descent from there, or from another start in a lower basin
    details["objective_relinearised"] = optimum.reports[0].objective
    details["reseeded"] = optimum.start != "incremental"
    return _Answer(best.values, best.iterations, optimum, optimum.start, details)


def _gnc(task: _Task) -> _Answer:
    from graphslam.solve.network.consensus import odometry_edges  # scipy.stats takes a second to load
    from graphslam.solve.network.robust import (
        BORNE_OUT,
        truncated_cost,
        truncated_least_squares,
        with_weaker_positions,
    )

    network, flat, starts, options, progress = task
    probability = float(options.get("inlier_probability", INLIER_PROBABILITY))
    scale = options.get("noise_scale")
    # least squares of all measurements from every start only on request: false loops make it slow
    asked = best_of_starts(network, starts, flat=flat, progress=progress) if starts is not None else None
    trust = bool(options.get("trust_odometry", True))
    given = {asked.start: asked.best.values} if asked is not None else {}
    if not given and not (trust and odometry_edges(network).any()):
        # no edge is trusted, so there is no other start
        asked = best_of_starts(network, starts, flat=flat, progress=progress)
        given = {asked.start: asked.best.values}
    how: dict[str, Any] = {"trust_odometry": trust, "noise_scale": None if scale is None else float(scale)}
    robust = truncated_least_squares(network, flat, given, probability, **how, progress=progress)
    priors, doubt = network.position_priors, ""
    beyond = priors & robust.inliers[: len(priors)] & (flat.squared(robust.end.values) > robust.limit)[: len(priors)]
    if beyond.any():
        network, excess = with_weaker_positions(network, probability, **how)
        flat = network_arrays(network)
        robust = truncated_least_squares(network, flat, {}, probability, **how, progress=progress)
        doubt = (
            f"not solved with the assumed noise: {np.count_nonzero(beyond)} of {np.count_nonzero(priors)} position "
            f"priors contradict the other measurements; σ of all of them was multiplied by {np.sqrt(excess):.3g}, so "
            "that half of them agree. Check their frame, stamps and σ"
        )
    end = robust.end
    optimum = asked or _from_robust(flat, robust)
    out = np.flatnonzero(~robust.inliers)
    m = len(network.edges)
    loops = ~odometry_edges(network) & network.relative
    kept = int(np.count_nonzero(robust.inliers[:m] & loops))
    # loops confirmed by neighbours can be fewer than those that contradict everything
    enough = 0.5 if robust.start in ("odometry", "cauchy") else BORNE_OUT
    if not doubt and kept < enough * np.count_nonzero(loops) and np.count_nonzero(loops) >= FEWEST_LOOPS:
        doubt = (
            f"not solved: only {kept} of {np.count_nonzero(loops)} loops agree with each other and with the odometry "
            "with its assumed noise; either most loops are wrong, or the odometry is worse than stated"
        )
    details: dict[str, Any] = {
        "doubt": doubt,
        "outliers": len(out),
        "outlier_names": [
            network.edge_name(int(k)) if k < m else network.observation_name(int(k) - m) for k in out[:20]
        ],
        "objective_inliers": end.objective,
        "objective_truncated": robust.truncated,
        "objective_truncated_batch": truncated_cost(flat, optimum.best.values, robust.limit),
        "inlier_probability": probability,
        "noise_scale": robust.scale,
        "edge_limit": float(np.min(robust.limit[:m], initial=np.inf, where=np.isfinite(robust.limit[:m]))),
        "robust_start": robust.start,
        "robust_starts": robust.reached,
    }
    return _Answer(
        end.values,
        end.iterations,
        optimum,
        robust.start,
        details,
        robust.problem,
        end.objective,
        robust.inliers,
    )


def _from_robust(flat: FactorArrays, robust: RobustResult) -> StartsResult:
    """Result of a few least-squares steps of all measurements from the robust solution, the reference of the gap."""
    problem = SparseProblem(flat, thorough=True)
    initial = problem.objective(robust.end.values)
    if np.mean(~robust.inliers) > FEW:
        # random loops fill the factorisation: a step with all costs many times the whole robust solution
        unknown = Optimum(robust.end.values, initial, float("nan"), float("inf"), 0, "rejected")
        return StartsResult(
            problem, unknown, "inliers", (StartReport("inliers", initial, float("nan"), 0, "not tried"),)
        )
    best = descend_to_minimum(problem, robust.end.values, max_iterations=BATCH_STEPS)
    report = StartReport("inliers", initial, best.objective, best.iterations, best.status)
    return StartsResult(problem, best, "inliers", (report,))


# name -> (function, its options)
SOLVERS: dict[str, tuple[Solver, tuple[str, ...]]] = {
    "lm": (_lm, ()),
    "isam2": (_isam2, ("relinearise",)),
    "gnc": (_gnc, ("inlier_probability", "trust_odometry", "noise_scale")),
    "pcg": (_pcg, ("tolerance", "max_iterations")),
}
