"""Refine a solved path with its scans: rounds of association and Gauss–Newton, with checks of the result.

Nodes are steps. The measurements are the points of the scans on surfaces of other steps, the increments of the odometry
with systematic errors as unknowns, and gravity. End poses of submaps, matches and loops of the run are only the initial
guess, because they were made from the same scans.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.heap import trim_heap
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.spill_cache import CacheEntry
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.refine.config import CHECKED_BEAMS, DISTANCES, MOST_BEAMS, RefineConfig
from graphslam.refine.fixes import FixModel
from graphslam.refine.motion import MotionModel, States
from graphslam.refine.nodes import StepsBetweenNodes, find_nodes, scans_at, thin_beams
from graphslam.refine.problem import (
    LinearisedProblem,
    RefinementProblem,
    agreeing_share,
    chunk_information,
    correlation_factor,
    pair_noise,
    point_information,
    surface_residuals,
)
from graphslam.refine.result import AttemptComparison, Refinement, RefinementRound, ScanCheck
from graphslam.refine.revisit_constraints import ACCEPTED, RevisitConstraints, find_revisit_constraints
from graphslam.refine.scans import Scans
from graphslam.refine.surfaces import (
    ChunkPairs,
    ScanReturns,
    SurfacePairs,
    Surfaces,
    chunk_pairs,
    find_surfaces,
    match_surfaces,
)
from graphslam.registration.plane_kernels import PlanePairs
from graphslam.registration.surfaces import SURFACE
from graphslam_frontends.odometry.recorded import chain_odometry

log = logging.getLogger(__name__)
Index = npt.NDArray[np.int64]

NEAR = ((1.0, 0.10), (0.7, 0.07))
"""Distance and σ of the rounds with consecutive chunks [m]; the last is repeated until the path has converged."""
STILL = 0.01, 1e-4
"""The path has converged if a round moved it by less than this [m], or than this share of its length."""
MOST_ROUNDS = 10
MOST_GATES = 6
WIDE = 3.0, 2.0
"""Largest distances of pairs before those of the configuration, if no guide aligned the traversals [m]."""
DOUBTED = 0.2
"""Residuals below this share of the largest distance of a pair are not down-weighted."""
FEWEST = 3
"""Minimum number of chunks of one traversal that a chunk is paired with; otherwise the number that fits in a reach."""
KEPT = 2
"""Surfaces are computed again in this number of rounds with all traversals; later, steps hardly move."""
CHUNK_LENGTH = 3.0
"""Path length over which the points of steps are searched together [m] …"""
CHUNK_TIME = 10.0
"""… largest duration of such a chunk, for static robots [s] …"""
CHUNK_TURN = 0.5
"""… and in 2-D its largest rotation [rad], because a scanner with a limited field of view soon observes other walls."""


def refine_by_scans(
    steps: Scans,
    start: Array,
    config: RefineConfig | None = None,
    *,
    gps: tuple[Gps, GpsConfig] | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Refinement:
    """Refine a path with the scans of its steps.

    Parameters
    ----------
    start : (n, 7) or (n, 3)
        Poses of the base at the stamps of the steps; in 3-D in a level frame.
    gps : (Gps, GpsConfig), optional
        Fixes to use as well, and their options.
    progress : callable, optional
        Called with a text after each round.
    """
    work, nodes = _begin(steps, start, config or RefineConfig(), gps, progress)
    return work.run().at_all_steps(steps, start, nodes)


def refine_if_contradicted(
    steps: Scans,
    start: Array,
    config: RefineConfig | None = None,
    *,
    progress: Callable[[str], Any] | None = None,
) -> Refinement | ScanCheck:
    """Refine a path only if its scans contradict it; otherwise return the check, which needs a part of the beams.

    For scans that the odometry of the path has already matched. Parameters as of :func:`refine_by_scans`.
    """
    check = _begin(steps, start, config or RefineConfig(), None, progress, CHECKED_BEAMS)[0].check()
    return refine_by_scans(steps, start, config, progress=progress) if check.contradicted else check


def _begin(
    steps: Scans,
    start: Array,
    config: RefineConfig,
    gps: tuple[Gps, GpsConfig] | None,
    progress: Callable[[str], Any] | None,
    most: int = MOST_BEAMS,
) -> tuple[_Refiner, Index]:
    """A refiner of the steps that are nodes, with at most ``most`` beams, and the indices of these steps."""
    g = steps.group
    if start.shape != (len(steps), g.size) or not np.all(np.isfinite(start)):
        raise GeometryError(
            "the start does not fit the steps", got=start.shape, wanted=f"({len(steps)}, {g.size}), finite"
        )
    if len(steps) < 3:
        raise DataError("too few steps to refine", where=steps.name, got=len(steps), wanted="≥ 3")
    nodes = find_nodes(steps, config.spacing, config.turn)
    if len(nodes) < 3:
        nodes = np.arange(len(steps), dtype=np.int64)
    some = thin_beams(scans_at(steps, nodes) if len(nodes) < len(steps) else steps, most)
    work = _Refiner(some, start[nodes], config, gps, progress or (lambda _: None))
    if not len(work.cloud.points):
        raise DataError("no beam of the steps met anything", where=steps.name)
    if work.cloud.chunks < 2:
        raise DataError(
            "the path is too short to refine: no two pieces of it to compare",
            where=steps.name,
            got=f"{len(steps)} steps in one piece",
            wanted="≥ 2 pieces",
        )
    return work, nodes


@dataclass(frozen=True, slots=True)
class _Attempt:
    poses: Array
    states: States
    cloud: ScanReturns
    surfaces: Surfaces
    chunks: ChunkPairs
    found: SurfacePairs
    noise: Array
    rounds: list[RefinementRound]
    scales: Array
    walk: float


NOTHING = SurfacePairs(
    PlanePairs(*np.zeros((4, 0), np.int64)), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))
)
"""No pairs."""


class _Refiner:
    """State of a refinement."""

    def __init__(
        self,
        steps: Scans,
        start: Array,
        config: RefineConfig,
        gps: tuple[Gps, GpsConfig] | None,
        tell: Callable[[str], Any],
    ) -> None:
        self.steps, self.start, self.config, self.tell = steps, start, config, tell
        self.group = group_of(start)
        turn = CHUNK_TURN if steps.group.dim == 2 else np.inf
        self.raw = self.cloud = ScanReturns.of(steps, chunk_length=CHUNK_LENGTH, chunk_time=CHUNK_TIME, chunk_turn=turn)
        self.motion = MotionModel(steps, bridge=self.cloud.bridge())
        self.every = max(config.every, int(np.ceil(len(self.cloud.points) / config.most_points)))
        fixes = None if gps is None else FixModel(*gps, self.motion, start)
        self.fixes = fixes if fixes is not None and gps is not None and fixes.ready(gps[1].baseline, start) else None
        self.problem = RefinementProblem(self.motion, self.cloud, start[0].copy(), self.fixes)
        self.poses = start.copy()
        self.states = self.first_states()
        self.rounds: list[RefinementRound] = []
        self.alike = 1.0
        self.found = NOTHING
        self.surfaces: Surfaces | None = None
        self.first: CacheEntry[Surfaces] | None = None
        self.length = float(steps.path_length[-1])
        self.reach = config.reach if config.reach is not None else steps.reach
        self.most = max(FEWEST, round(self.reach / CHUNK_LENGTH))
        self.guided: tuple[RevisitConstraints, npt.NDArray[np.bool_]] | None = None

    def first_states(self) -> States:
        """Systematic errors of zero; datum of the fixes aligned to the path."""
        own = (np.zeros(len(self.motion.knots)), np.zeros(self.motion.constants))
        return own if self.fixes is None else (*own, *self.fixes.start(self.poses))

    def run(self) -> Refinement:
        """All rounds; repeated from the odometry's path if the initial path is wrong."""
        guides, used = self.neighbours_and_guides()
        self.all_passes(DISTANCES)
        other = None
        assert self.surfaces is not None
        odometry = self.odometry_path()
        self.reckoned = self.agreement_along(odometry)
        contradicted = np.any(~used & guides.far(self.poses))
        if contradicted or self.reckoned > self.agreement(self.cloud, self.surfaces, self.poses, self.noise):
            why = "the start contradicts the scans between" if contradicted else "the odometry alone agrees better"
            self.tell(f"{why}: once more from the odometry")
            other = self.from_odometry()
            used = used & (not other.swapped)
            self.reckoned = self.agreement_along(odometry)
        found = self.result(guides.steps[~used & guides.far(self.poses)], other)
        if not found.input_better or self.fixes is not None:  # fixes constrain the path, and the odometry has none
            return found
        self.tell("the odometry alone agrees better; its path is the result")
        return self.initial_result(found, odometry)

    def check(self) -> ScanCheck:
        """Do the scans contradict the initial path? Only if it has revisits, consecutive chunks are matched, too."""
        odometry_path = self.odometry_path()
        pairs = [self.pairs_along(self.start)]
        if not np.allclose(odometry_path, self.start, rtol=0.0, atol=1e-6):  # equal if the graph changed nothing
            pairs.append(self.pairs_along(odometry_path))
        noise = np.min([pair_noise(found, r) for found, r in pairs], axis=0)
        shares = [agreeing_share(found, r, noise) for found, r in pairs]
        check = ScanCheck(shares[-1], shares[0], np.zeros((0, 2), np.int64))
        if check.contradicted or not len(self.find_guides()):
            return check
        guides, used = self.neighbours_and_guides()
        return replace(check, refused=guides.steps[~used & guides.far(self.poses)])

    def odometry_path(self) -> Array:
        """Poses of the odometry alone, from the first pose of the initial path."""
        return self.group.compose(self.start[0], chain_odometry(self.steps.odometry).poses)

    def initial_result(self, found: Refinement, odometry: Array) -> Refinement:
        """The path of the odometry, with the covariance of motion and gravity, without scans."""
        assert self.surfaces is not None
        self.poses, self.states = odometry, self.first_states()
        self.motion.scales, self.motion.walk = np.ones_like(self.motion.scales), 1.0
        unspent = np.zeros(len(self.found.pairs.source))
        solved, _ = self.problem.linearise(self.poses, self.states, self.found.pairs, self.surfaces, unspent)
        return replace(
            found,
            poses=odometry,
            covariances=self.marginals(solved),
            yaw_bias=np.column_stack([self.motion.knots, self.states[0]]),
            constants={},
            parts=solved.parts,
            agreement=(found.agreement[0], found.reckoned),
            left=found.agreement[1],
            other=None,
            scales=self.motion.scales,
            walk=self.motion.walk,
            motion=0.0,
            solved=solved,
        )

    def marginals(self, solved: LinearisedProblem) -> Array:
        """Covariances ``(n, d, d)`` of the poses."""
        n, w = len(self.steps), self.group.dof
        return solved.factor.inverse_diagonal_blocks(np.arange(n, dtype=np.int64) * w, w)

    def from_odometry(self) -> AttemptComparison:
        """Repeat without the initial path, whose wrong loops may have deformed it.

        The path with the better agreement of scans is kept.
        """
        first = self.attempt()
        self.poses = self.odometry_path()
        self.states = self.first_states()
        self.motion.scales, self.motion.walk = np.ones_like(self.motion.scales), 1.0
        self.cloud = self.problem.cloud = self.raw
        self.rounds = []
        self.neighbours()
        self.all_passes(tuple(d for d in WIDE if d > DISTANCES[0]) + DISTANCES)
        second = self.attempt()
        # the same noise for both; otherwise larger noise alone would give a better agreement
        noise = np.minimum(first.noise, second.noise)
        self.motion.scales = np.ones_like(self.motion.scales)
        a, b = (self.agreement(x.cloud, x.surfaces, x.poses, noise) for x in (first, second))
        d = self.group.dim
        apart = float(np.sqrt(np.mean(np.sum((first.poses[:, :d] - second.poses[:, :d]) ** 2, axis=1))))
        self.take_up(second if b > a else first)
        return AttemptComparison(apart, max(a, b), min(a, b), b > a)

    def attempt(self) -> _Attempt:
        """The current state of the refinement."""
        assert self.surfaces is not None
        motion = (self.motion.scales, self.motion.walk)
        return _Attempt(
            self.poses,
            self.states,
            self.cloud,
            self.surfaces,
            self.chunks,
            self.found,
            self.noise,
            self.rounds,
            *motion,
        )

    def take_up(self, a: _Attempt) -> None:
        """Restore a state of the refinement."""
        self.poses, self.states, self.surfaces, self.chunks = a.poses, a.states, a.surfaces, a.chunks
        self.found, self.noise, self.rounds = a.found, a.noise, a.rounds
        self.cloud = self.problem.cloud = a.cloud
        self.motion.scales, self.motion.walk = a.scales, a.walk

    def neighbours(self) -> None:
        """Rounds with consecutive chunks, until the path has converged."""
        for distance, sigma in NEAR:
            self.round(distance, sigma, passes=False, again=True)
        while self.rounds[-1].moved > max(STILL[0], STILL[1] * self.length) and len(self.rounds) < MOST_ROUNDS:
            self.round(*NEAR[-1], passes=False, again=False)

    def all_passes(self, distances: tuple[float, ...]) -> None:
        """Rounds with all traversals at decreasing distances."""
        for k, distance in enumerate(distances):
            again = k < len(distances) - len(DISTANCES) + KEPT
            self.round(distance, None, passes=True, again=again, steps=2 if k == 0 else 1)

    def round(self, distance: float, sigma: float | None, *, passes: bool, again: bool, steps: int = 2) -> None:
        """Associate, and Gauss–Newton steps; without a σ the noise is estimated from the residuals."""
        # free the old data first, so that there are never two of them in memory
        self.found = NOTHING
        if passes:
            self.cloud = self.problem.cloud = self.raw
            self.cloud = self.problem.cloud = self.raw.corrected(self.motion.corrections(self.poses))
        trim_heap()
        if again or self.surfaces is None:
            self.surfaces = None
            self.surfaces = find_surfaces(self.cloud, self.poses, SURFACE)
            if self.first is None:
                self.first = self.surfaces.put_aside()
        self.chunks = chunk_pairs(self.cloud, self.poses, self.reach, self.most, passes=passes)
        self.found = match_surfaces(
            self.cloud,
            self.surfaces,
            self.poses,
            self.chunks,
            distance=distance,
            every=self.every,
            within=self.motion.within if sigma is None else None,
        )
        before = self.poses
        solved: LinearisedProblem | None = None
        for _ in range(steps):
            solved = None  # the factor of a long path is the largest object: never two of them in memory
            r = surface_residuals(self.found.pairs, self.cloud, self.surfaces, self.poses)
            noise = pair_noise(self.found, r) if sigma is None else np.array([0.0, sigma**2, 0.0])
            information = point_information(self.found, r, noise, DOUBTED * distance)
            if sigma is None:
                self.alike = correlation_factor(self.found, self.cloud, r, noise)
                information /= self.alike
            solved = self.step(information)
        if passes and distance <= DISTANCES[0] and solved is not None:
            self.motion.widen(self.poses, self.states, solved.factor)
        self.noise = noise
        d = self.group.dim
        moved = float(np.sqrt(np.mean(np.sum((self.poses[:, :d] - before[:, :d]) ** 2, axis=1))))
        spread = 1.4826 * float(np.median(np.abs(r))) if len(r) else 0.0
        a, b, _ = np.sqrt(noise).tolist()
        found = RefinementRound(
            distance, a, b, len(r), int(np.sum(self.chunks.passes[self.found.whose])), spread, moved
        )
        self.rounds.append(found)
        self.tell(f"round {len(self.rounds)}: {found.pairs} pairs within {distance:g} m, moved by {moved:.3f} m")
        log.info("refine: %s", found)

    def step(self, information: Array, extra: list[Any] | None = None) -> LinearisedProblem:
        """One Gauss–Newton step."""
        assert self.surfaces is not None
        holds = chunk_information(self.found, self.cloud, self.surfaces, self.poses, information)
        solved, step = self.problem.linearise(
            self.poses, self.states, self.found.pairs, self.surfaces, information, extra or [], holds
        )
        self.poses, self.states = self.problem.moved(self.poses, self.states, step)
        return solved

    def neighbours_and_guides(self) -> tuple[RevisitConstraints, npt.NDArray[np.bool_]]:
        """Once: the rounds with consecutive chunks, then the guides, and which of them agree with the scans."""
        if self.guided is None:
            self.neighbours()
            self.guided = self.follow_guides()
        return self.guided

    def find_guides(self) -> RevisitConstraints:
        """Pairs of steps of different traversals that are near each other in the initial path."""
        return find_revisit_constraints(self.cloud, self.start, 0.5 * self.reach)

    def follow_guides(self) -> tuple[RevisitConstraints, npt.NDArray[np.bool_]]:
        """Align traversals as in the initial path where the scans in between allow it; returns guides and a mask."""
        guides = self.find_guides()
        if not len(guides):
            return guides, np.zeros(0, bool)
        assert self.surfaces is not None
        r = surface_residuals(self.found.pairs, self.cloud, self.surfaces, self.poses)
        information = point_information(self.found, r, np.array([0.0, NEAR[-1][1] ** 2, 0.0]))
        used = np.zeros(len(guides), bool)
        solved: LinearisedProblem | None = None
        for _ in range(MOST_GATES):
            for _ in range(1 + 2 * int(used.any())):
                solved = None  # see `round`
                w = np.where(used, (ACCEPTED / (guides.squared(self.poses) + ACCEPTED)) ** 2, 0.0)
                solved = self.step(information, [guides.terms(self.poses, w)])
            assert solved is not None
            fits = guides.distances(self.poses, solved, self.group.dof) < ACCEPTED
            if np.array_equal(fits, used):
                break
            used = fits
        self.tell(f"{len(guides)} guides, {int(used.sum())} of them agree with the scans between")
        return guides, used

    def pairs(self, cloud: ScanReturns, surfaces: Surfaces, poses: Array) -> tuple[SurfacePairs, Array]:
        """Pairs found at a path with surfaces made there, and their residuals [m].

        They do not depend on how the path was estimated.
        """
        found = match_surfaces(
            cloud,
            surfaces,
            poses,
            chunk_pairs(cloud, poses, self.reach, self.most, passes=True),
            distance=DISTANCES[0],
            every=4 * self.every,
            within=self.motion.within,
            least_share=0.0,
        )
        return found, surface_residuals(found.pairs, cloud, surfaces, poses)

    def agreement(self, cloud: ScanReturns, surfaces: Surfaces, poses: Array, noise: Array) -> float:
        """Share of the points that are on the surfaces of others along a path."""
        return agreeing_share(*self.pairs(cloud, surfaces, poses), noise)

    def pairs_along(self, poses: Array) -> tuple[SurfacePairs, Array]:
        """Pairs of the raw scans at another path, with surfaces made there."""
        return self.pairs(self.raw, find_surfaces(self.raw, poses, SURFACE), poses)

    def agreement_along(self, poses: Array) -> float:
        """Share of the points of the raw scans that agree along another path."""
        return agreeing_share(*self.pairs_along(poses), self.noise)

    def result(self, refused: Index, other: AttemptComparison | None) -> Refinement:
        """Final covariances, and all results."""
        assert self.surfaces is not None
        assert self.first is not None
        trim_heap()
        before = self.agreement(self.raw, self.first.get(), self.start, self.noise)
        r = surface_residuals(self.found.pairs, self.cloud, self.surfaces, self.poses)
        self.alike = correlation_factor(self.found, self.cloud, r, self.noise)
        information = point_information(self.found, r, self.noise, DOUBTED * DISTANCES[-1])
        solved = self.step(information / self.alike)
        n, w, K = len(self.steps), self.group.dof, len(self.motion.knots)
        C = self.marginals(solved)
        const = solved.factor.inverse_block(n * w + K + np.arange(self.motion.constants))
        names = ("scale", "side", "rise", "clock", "roll", "pitch", "bend", "turn")
        sigma = np.sqrt(np.diag(const))
        at = self.motion.at
        return Refinement(
            times=self.steps.times,
            poses=self.poses,
            covariances=C,
            start=self.start,
            yaw_bias=np.column_stack([self.motion.knots, self.states[0]]),
            constants={
                name: (float(self.states[1][at[k]]), float(sigma[at[k]])) for k, name in enumerate(names) if at[k] >= 0
            },
            rounds=tuple(self.rounds),
            parts=solved.parts,
            refused=refused,
            reckoned=self.reckoned,
            agreement=(before, self.agreement(self.cloud, self.surfaces, self.poses, self.noise)),
            other=other,
            scales=self.motion.scales,
            walk=self.motion.walk,
            motion=solved.parts["yaw bias walk"] / max(K - 1, 1),
            solved=solved,
            nodes=np.arange(n, dtype=np.int64),
            between=StepsBetweenNodes.at_nodes(n, w),
            alike=self.alike,
            fixes=None if self.fixes is None else self.fixes.report(self.poses, self.states),
        )
