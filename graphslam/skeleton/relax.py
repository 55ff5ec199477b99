"""Optimisation of a skeleton network: Gauss-Newton with preconditioned conjugate gradients, and alternatives (C5)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError, SolverError
from graphslam.core.geometry import Array
from graphslam.skeleton.false_correspondences import split_false_correspondences
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import (
    KeyframePattern,
    Preconditioner,
    PreconditionerLevels,
    preconditioner_levels,
)
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.reduced_network import ReducedNetwork
from graphslam.skeleton.schur import Network, Workers, WorkRanges, step_poses
from graphslam.skeleton.start import chain_start, forward_pass
from graphslam.skeleton.weak_modes import WeakMode, weakest_modes

logger = logging.getLogger(__name__)
Method = Literal["gn", "cg", "blocks", "levels"]
Start = Literal["forward", "chain", "odometry"]


@dataclass(frozen=True)
class RelaxConfig:
    """Configuration of the optimisation.

    Parameters
    ----------
    method : {"gn", "cg", "blocks", "levels"}
        ``gn``: Gauss-Newton; its linear systems by conjugate gradients, the Schur complement applied without being
        formed. ``cg``: non-linear conjugate gradients, as in the paper. ``blocks``: Gauss-Newton with the explicit
        reduced network. ``levels``: only keyframes are variables, rigid motion between them: *approximate*.
    start : {"forward", "chain", "odometry"}
        Initial poses: odometry; ``chain``: with tilt and GPS; ``forward``: then one pass against older landmarks.
    iterations : int
        Most Gauss-Newton steps; for ``cg`` most gradients.
    gain, move : float
        If the predicted decrease of a step is below ``gain`` (in units of χ²), one or two more follow, with linear
        systems solved to 1 %. It has converged (``"poses"``) if the last one moves no pose by more than ``move`` [m];
        otherwise ``converged`` is ``"objective"``: long modes are weakly determined.
    enough : float
        It also ends when the predicted decrease is below this.
    levels : PreconditionerLevels, optional
        Of the preconditioner. Default: by size. ``PreconditionerLevels(-1, 0)`` with ``cg``: no preconditioner.
    rebuild : int
        Gradients between two preconditioners of ``cg``; 0: the first one is kept.
    inner : int
        Most products of one linear system.
    limit : float
        Memory limit of the explicit network [bytes].
    halve : bool
        Halve a step that increases the objective; otherwise it is accepted.
    split : bool
        Detect and split false correspondences.
    soft : int
        Number of weakest modes to report; 0: none.
    threads : int
        Number of threads; it does not affect the result.
    """

    method: Method = "gn"
    start: Start = "forward"
    iterations: int = 30
    gain: float = 1e-2
    move: float = 1e-4
    enough: float = 0.0
    levels: PreconditionerLevels | None = None
    rebuild: int = 10
    inner: int = 400
    limit: float = 4e9
    halve: bool = True
    split: bool = True
    soft: int = 3
    threads: int = 1

    def __post_init__(self) -> None:
        check_options(self, "relaxation: ", {"≥ 1": "iterations inner threads", "≥ 0": "gain move"})

    @classmethod
    def paper(cls) -> RelaxConfig:
        """As in urban GraphSLAM: conjugate gradients from the odometry, no preconditioner, no outlier detection."""
        return cls("cg", "odometry", 300, levels=PreconditionerLevels(-1, 0), rebuild=0, split=False)


@dataclass(frozen=True)
class Iteration:
    """One step of the optimisation.

    Parameters
    ----------
    objective, chi2 : float
        After the step; χ² per degree of freedom.
    products : int
        Number of products with the Schur complement.
    predicted, gained : float
        Predicted and actual decrease of the objective.
    largest_move : float
        [m]
    scale : float
        Factor on the step.
    seconds : float
        CPU time since the start.
    """

    objective: float
    chi2: float
    products: int
    predicted: float
    gained: float
    largest_move: float
    scale: float
    seconds: float


@dataclass(frozen=True, eq=False)
class RelaxationResult:
    """An optimised skeleton network.

    Parameters
    ----------
    landmarks : (L, 3)
    landmark : (M,) int32
        Landmark of each measurement; differs from the problem's if landmarks were split.
    objective, chi2 : float
        Sum of squared normalised residuals; per degree of freedom.
    gradient : float
        Length of half the gradient.
    converged : {"poses", "objective", ""}
    soft : list of WeakMode
        Approximate.
    split, refused : int
        Number of split landmarks; number of observations that the forward pass rejected.
    seconds : dict
        CPU time by stage.
    approximate : bool
        True for ``levels``.
    """

    method: str
    poses: Poses
    landmarks: Array
    landmark: npt.NDArray[np.int32]
    objective: float
    chi2: float
    gradient: float
    converged: str
    history: list[Iteration]
    soft: list[WeakMode] = field(default_factory=list)
    split: int = 0
    refused: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    approximate: bool = False

    @property
    def iterations(self) -> int:
        """Number of steps."""
        return len(self.history)

    @property
    def products(self) -> int:
        """Number of products with the Schur complement."""
        return sum(h.products for h in self.history)

    @property
    def largest_move(self) -> float:
        """Largest move of a pose in the last step [m]."""
        return self.history[-1].largest_move if self.history else 0.0

    @property
    def predicted(self) -> float:
        """Predicted decrease of the last step, in units of χ²."""
        return self.history[-1].predicted if self.history else 0.0


class StageTimes:
    """CPU seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._begin = self._last = time.process_time()

    def __call__(self, name: str) -> None:
        """Add the time since the last call to ``name``."""
        now = time.process_time()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """CPU time since the start."""
        return time.process_time() - self._begin


def relax_skeleton(
    problem: SkeletonProblem,
    config: RelaxConfig | None = None,
    poses: Poses | None = None,
    progress: Callable[[Iteration], None] | None = None,
) -> RelaxationResult:
    """Optimise the poses of a skeleton network.

    Parameters
    ----------
    problem : SkeletonProblem
    config : RelaxConfig, optional
    poses : Poses, optional
        Start from these instead of ``config.start``.
    progress : callable, optional
        Called after every step.

    Returns
    -------
    Relaxation
        Poses in the world frame, χ², largest move of the last step [m], and the weakest modes.

    Raises
    ------
    IndeterminateError
        A pose or landmark is not determined.
    SolverError
        The objective is not finite; or ``blocks`` would need more memory than ``config.limit``.

    Examples
    --------
    >>> from graphslam_studies.sim.laps import LapsConfig, draw_laps
    >>> found = gs.relax_skeleton(draw_laps(LapsConfig(poses=1200)).problem())
    >>> found.converged, round(found.chi2, 2)
    ('poses', 1.0)
    """
    c = config or RelaxConfig()
    if problem.tiles is not None and (c.split or c.method == "blocks"):
        raise ConfigError(
            "measurements are on disk; wanted split=False (wrong unions are found in memory) and another method than "
            "'blocks'"
        )
    if len(problem.normals) and (c.split or poses is None):
        raise ConfigError("measurements have normals; wanted initial poses, and split=False")
    stages = StageTimes()
    refused = 0
    if poses is None:
        poses = problem.dead_reckoning() if c.start == "odometry" else chain_start(problem)
        stages("chain")
        if c.start == "forward":
            walk = forward_pass(problem, poses)
            poses, refused = walk.poses, walk.refused
            stages("forward pass")
    descent = _Descent(problem, c, Workers(c.threads), poses, stages, progress)
    descent.run()
    while c.split and descent.split():
        descent.run()
    soft = weakest_modes(descent.network, c.soft) if c.soft else []
    stages("softest modes")
    network = descent.network
    return RelaxationResult(
        method=c.method,
        poses=network.poses,
        landmarks=network.landmarks,
        landmark=descent.problem.landmark,
        objective=network.objective,
        chi2=network.objective / max(1, descent.problem.freedom),
        gradient=float(np.linalg.norm(network.gradient)),
        converged=descent.converged,
        history=descent.history,
        soft=soft,
        split=descent.found,
        refused=refused,
        seconds=stages.seconds,
        approximate=c.method == "levels",
    )


class _Descent:
    """One descent: the network at the current poses, and the steps."""

    def __init__(
        self,
        problem: SkeletonProblem,
        config: RelaxConfig,
        workers: Workers,
        poses: Poses,
        stages: StageTimes,
        progress: Callable[[Iteration], None] | None,
    ) -> None:
        self.problem, self.config, self.workers, self.stages = problem, config, workers, stages
        self.levels = config.levels or preconditioner_levels(problem.poses)
        self.history: list[Iteration] = []
        self.converged = ""
        self.found = 0
        self._finishing = self._before = 0
        self._progress = progress
        self._pattern: KeyframePattern | None = None
        self._begin(problem, poses)

    def _begin(self, problem: SkeletonProblem, poses: Poses) -> None:
        self.problem = problem
        self.layout = WorkRanges(problem, self.workers)
        self.network = self._network(poses)
        self._pattern = None

    def _network(self, poses: Poses) -> Network:
        network = Network(self.layout, poses)
        self.stages("linearise")
        return network

    def _preconditioner(self) -> Preconditioner:
        M = Preconditioner(self.network, self.levels, self._pattern)
        self._pattern = M.pattern
        self.stages("preconditioner")
        return M

    def split(self) -> int:
        """Split false correspondences at the current poses; returns their number."""
        landmark, found = split_false_correspondences(self.network)
        self.stages("wrong unions")
        self.found += found
        if found:
            logger.info("%d landmarks were wrong unions and are split", found)
            self._begin(self.problem.relabelled(landmark), self.network.poses)
        return found

    @property
    def chi2(self) -> float:
        return self.network.objective / max(1, self.problem.freedom)

    def run(self) -> None:
        """Iterate until convergence."""
        self.converged = ""
        self._finishing, self._before = 0, len(self.history)
        if not np.isfinite(self.network.objective):
            raise SolverError("objective of the skeleton network is not finite at its start")
        {"gn": self._gauss_newton, "blocks": self._gauss_newton, "levels": self._levels, "cg": self._gradients}[
            self.config.method
        ]()

    # ---- Gauss-Newton ------------------------------------------------------------------------------------------

    def _gauss_newton(self) -> None:
        c = self.config
        M: Preconditioner | None = None
        rebuilt = 0
        for _ in range(c.iterations):
            last = self.history[-1] if len(self.history) > self._before else None
            close = last is not None and last.predicted < 10.0
            if M is None or self.chi2 > 1.5 or (last is not None and last.scale < 1.0) or (close and not rebuilt):
                M = self._preconditioner()
                rebuilt = int(close)
            # weak modes hardly change the objective: accurate solves are needed to see whether poses still move
            self._finishing += last is not None and last.predicted < c.gain
            tolerance = 0.01 if self.chi2 > 2.0 or self._finishing else 1e-3 if close else 0.03
            gain = 0.0 if self._finishing else 1e-3 * c.gain
            product = self.network.product
            if c.method == "blocks":
                product = ReducedNetwork(self.network, c.limit).product
                self.stages("thinning")
            step, predicted, products = conjugate_gradients(
                product, M, -self.network.gradient, tolerance, c.inner, gain
            )
            self.stages("products")
            if self._take(step, predicted, products):
                return
            if c.split and len(self.history) == 1 and self.split():
                M = None  # earlier, too many correct ones look false; later, false ones have distorted the poses

    def _levels(self) -> None:
        """Steps of the keyframes only."""
        if not self.levels.factored:
            raise ConfigError(f"the method 'levels' needs keyframes; got {self.levels}")
        for _ in range(self.config.iterations):
            M = self._preconditioner()
            assert M.network is not None
            step = np.zeros_like(self.network.gradient)
            M.network.apply(-self.network.gradient, step)
            self.stages("products")
            if self._take(step, -float(np.einsum("ij,ij->", step, self.network.gradient)), 0):
                return

    def _take(self, step: Array, predicted: float, products: int) -> bool:
        """Apply a step, halved while the objective increases; True if it was the last one."""
        c, before = self.config, self.network
        scale = 1.0
        while True:
            there = self._network(step_poses(before.poses, step, scale))
            gained = before.objective - there.objective
            # ignore rounding errors of the sum of all residuals
            if not c.halve or gained >= -1e-12 * before.objective * np.sqrt(self.problem.measurements):
                break
            scale *= 0.5
            if scale < 1e-4:
                self._note(before, products, predicted, 0.0, 0.0, 0.0)
                return True
        far = float(np.sqrt(np.max(np.sum(step[:, 3:] ** 2, axis=1)))) * scale
        self.network = there
        self._note(there, products, predicted, gained, far, scale)
        if scale < 1.0 or predicted >= max(c.gain, c.enough):
            return False
        solved = self._finishing > 0 or c.method == "levels"
        self.converged = "poses" if predicted < c.gain and far < c.move and solved else "objective"
        return self.converged == "poses" or predicted < c.enough or self._finishing > 1 or c.method == "cg"

    def _note(self, network: Network, products: int, predicted: float, gained: float, far: float, scale: float) -> None:
        chi2 = network.objective / max(1, self.problem.freedom)
        self.history.append(
            Iteration(network.objective, chi2, products, predicted, gained, far, scale, self.stages.total)
        )
        logger.info("step %d: %s", len(self.history), self.history[-1])
        if self._progress is not None:
            self._progress(self.history[-1])

    # ---- non-linear conjugate gradients ------------------------------------------------------------------------

    def _gradients(self) -> None:
        """Polak-Ribière; step length from one product, halved while the objective increases."""
        c = self.config
        plain = self.levels.jacobi < 0
        M: Callable[[Array], Array] | None = None
        old: tuple[Array, float] | None = None
        direction: Array | None = None
        for k in range(c.iterations):
            if M is None or (not plain and c.rebuild and k % c.rebuild == 0):
                M = np.copy if plain else self._preconditioner()
            g = self.network.gradient
            z = M(g)
            now = _dot(g, z)
            beta = 0.0 if old is None else max(0.0, (now - _dot(z, old[0])) / old[1])
            direction = -z if direction is None or beta == 0.0 else beta * direction - z
            slope = _dot(g, direction)
            if slope >= 0.0:
                direction, slope = -z, -now
            step = direction * (-slope / _dot(direction, self.network.product(direction)))
            self.stages("products")
            old = g, now
            if self._take(step, -_dot(step, g), 1):
                return


def _dot(a: Array, b: Array) -> float:
    return float(np.einsum("ij,ij->", a, b))


def conjugate_gradients(
    product: Callable[[Array], Array],
    M: Callable[[Array], Array],
    b: Array,
    tolerance: float,
    most: int,
    gain: float,
) -> tuple[Array, float, int]:
    """Solve ``S x = b`` by preconditioned conjugate gradients.

    It ends when the residual, in the norm of the preconditioner, is below ``tolerance`` times its initial value, or
    when the last four products together decreased the quadratic by less than ``gain``.

    Returns
    -------
    x : (N, 6)
    predicted : float
        ``xᵀ b``: decrease of the objective in the linear model.
    """
    x, r, gains = np.zeros_like(b), b.copy(), list[float]()
    d = M(r).copy()
    now = first = _dot(r, d)
    while len(gains) < most and now > 0.0:
        q = product(d)
        curve = _dot(d, q)
        if not curve > 0.0:
            raise SolverError(f"the Schur complement has no positive curvature ({curve:g}) along a direction")
        a = now / curve
        x += a * d
        r -= a * q
        gains.append(a * now)
        z = M(r)
        new = _dot(r, z)
        if new <= tolerance**2 * first or sum(gains[-4:]) < gain:
            break
        d *= new / now
        d += z
        now = new
    return x, sum(gains), len(gains)
