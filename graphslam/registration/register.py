"""Registration of two clouds: generalised ICP in two stages, a calibrated covariance, and acceptance gates.

Convergence of a matcher is not a sufficient criterion: it also converges with an empty cloud, in a corridor, and one
pillar period off. Therefore the following is measured: share of points with a neighbour, undetermined directions,
distance from the start, and tilt.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import small_gicp

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.points import check_pose, transform_points
from graphslam.registration.config import LEAST_POINTS, RegistrationConfig
from graphslam.registration.degeneracy import calibrated_covariance, noise_induced_information, translational_degeneracy
from graphslam.registration.planar import PlanarAlignment, align_planar
from graphslam.registration.target import Target

_LEAST_NOISE = 1e-4  # for identical clouds, which have no noise
Known = npt.NDArray[np.bool_] | Callable[[Array], npt.NDArray[np.bool_]]
ROTATION_EPSILON = 1e-4
"""A stage of a registration ends when a step rotates by less than this [rad] …"""
TRANSLATION_EPSILON = 1e-4
"""… and moves by less than this [m]."""
COVARIANCE_SCALE_PLANAR = 5.0
"""Factor on the inverse Hessian with the noise estimated from the pairs, in 2-D; calibrated in simulated halls for any
noise, bins and number of points (docs/notes/registration.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """Result of a match.

    Parameters
    ----------
    T_target_source : (3,) or (7,)
        The result; the start if there is none.
    covariance : (d, d)
        In the right tangent (3-D: rotation first). NaN without a result, so that it cannot be used in a graph.
    fitness : float
        Share of all source points with a neighbour nearer than ``near``.
    fitness_known : float
        The same of the source points in known space; NaN if the caller did not give it.
    fitness_upright : float
        The same of the source points on upright surfaces, whose normal is more than 45° off the target's z axis. Level
        floors and ceilings match anywhere and are most of many scans. NaN in 2-D, and with fewer than
        :data:`~graphslam.registration.config.LEAST_POINTS` of them.
    known_share : float
        Share of the source points in known space; NaN if not given.
    rmse : float
        Of the distances to those neighbours [m]; NaN without any.
    inliers : int
        Number of pairs in the last step.
    degeneracy : float
        Least over largest eigenvalue of the translational part of the Hessian.
    weakest : (dim,)
        Least determined direction, a unit vector in the source frame; NaN without a result.
    weakest_sigma : float
        σ along it [m]; NaN without a result.
    tilt : float
        Angle between the z axes of the two frames [rad]; 0 in 2-D.
    shift, turn : float
        From the start to the result [m, rad].
    converged : bool
        There is a result: finite, not far from the start, with enough pairs. It can still be wrong.
    why : str
        Reason for no result, or the failed gates; empty if the match is accepted.
    """

    T_target_source: Array
    covariance: Array
    weakest: Array
    why: str
    fitness: float = 0.0
    fitness_known: float = math.nan
    fitness_upright: float = math.nan
    known_share: float = math.nan
    rmse: float = math.nan
    inliers: int = 0
    degeneracy: float = 0.0
    weakest_sigma: float = math.nan
    tilt: float = math.nan
    shift: float = math.nan
    turn: float = math.nan
    converged: bool = False

    @property
    def accepted(self) -> bool:
        """Whether the result passes all gates."""
        return not self.why

    @property
    def best_fitness(self) -> float:
        """The fitness in known space if given, otherwise that over all points."""
        return self.fitness if np.isnan(self.fitness_known) else self.fitness_known


def register(
    source: Any,
    target: Target,
    T_target_source: Any,
    config: RegistrationConfig | None = None,
    *,
    known: Known | None = None,
) -> Registration:
    """Match a cloud to a target.

    Parameters
    ----------
    source : (m, dim) or Target
        Points in the source frame [m]; non-finite points are ignored. Use a ``Target`` to match it from several starts.
    T_target_source : (3,) or (7,)
        Start.
    known : (m,) bool, or function of points (m, dim) to (m,) bool, optional
        Source points in known space; a function gets points in the *target* frame at the result (e.g.
        ``EvidenceGrid.known_at``). A mask requires a source without downsampling and without non-finite points.

    Returns
    -------
    Registration
        No exception if a match fails: ``why`` is the reason.

    Notes
    -----
    Generalised ICP (Segal, Haehnel and Thrun 2009, eq. 2) in two radii: pairs up to 2 m, then up to 0.5 m. The
    covariance is ``k s² (H - F)⁻¹`` and a floor: s² the noise estimated from the pairs, F the spurious part of the
    Hessian (:func:`~graphslam.registration.degeneracy.noise_induced_information`), k calibrated; undetermined
    directions get a σ according to ``max_shift``.

    Convergence range, measured in simulated halls of 60 m with pillars every 8 m, bare and with parked cars (share of
    20 starts that end within 0.3 m and 2°, the worse of the halls and directions): 0.5 m and 5° off 1.0 in 3-D and in
    2-D, 1 m and 10° 0.9 and 0.95, 2 m and 10° 0.6 and 0.75, 4 m 0. For larger errors, search first
    (:func:`~graphslam.registration.search.correlative_search`). From one pillar period off it converges there,
    sometimes with a fitness that no gate can distinguish from the true one: use several starts.
    """
    config = RegistrationConfig() if config is None else config
    start = check_pose(T_target_source, target.dim, what="start of a registration")
    cloud = source if isinstance(source, Target) else Target(source, neighbours=target.neighbours)
    if cloud.dim != target.dim:
        raise GeometryError("source and target differ in dimension", got=cloud.dim, wanted=target.dim)
    if known is not None and not callable(known) and np.shape(known) != (len(cloud),):
        raise DataError("the mask of known points does not go with the source", got=np.shape(known), wanted=len(cloud))
    for name, c in (("source", cloud), ("target", target)):
        if len(c) < LEAST_POINTS:
            return _no_result(start, f"{name} has {len(c)} points, fewer than {LEAST_POINTS}")
    found = _align(cloud, target, start, config)
    if found.pairs == 0:
        return _no_result(start, f"no target point within {config.radii[-1]:g} m of any source point")
    if not (np.all(np.isfinite(found.T)) and np.all(np.isfinite(found.hessian))):
        return _no_result(start, "the result is not finite")
    shift, turn = _moved(start, found.T)
    if found.pairs < LEAST_POINTS:
        why = f"{found.pairs} pairs left, fewer than {LEAST_POINTS}"
        return dataclasses.replace(_no_result(start, why), inliers=found.pairs)
    if shift > config.max_shift or turn > config.max_turn:
        why = f"the result is {shift:.2f} m and {turn:.2f} rad from the start; at most {config.max_shift:g}, "
        why += f"{config.max_turn:g}"
        return dataclasses.replace(_no_result(start, why), inliers=found.pairs, shift=shift, turn=turn)
    result = _measure(cloud, target, found, shift, turn, config, known)
    return dataclasses.replace(result, why=failed_gates(result, config))


def register_starts(
    source: Any,
    target: Target,
    starts: Iterable[Any],
    config: RegistrationConfig | None = None,
    *,
    known: Known | None = None,
    apart: tuple[float, float] = (0.5, 0.1),
) -> list[Registration]:
    """Match a cloud from several starts; distinct results, best fitness first.

    Parameters
    ----------
    source, target, config, known
        As for :func:`register`.
    starts : iterable of (3,) or (7,)
    apart : (float, float)
        Results nearer than this to a better one are duplicates [m, rad].

    Returns
    -------
    list of Registration
        Those with a result, accepted or not; equal fitness in the order of the starts.
    """
    cloud = source if isinstance(source, Target) else Target(source, neighbours=target.neighbours)
    return distinct_registrations((register(cloud, target, T, config, known=known) for T in starts), apart)


def distinct_registrations(
    results: Iterable[Registration], apart: tuple[float, float] = (0.5, 0.1)
) -> list[Registration]:
    """Registrations with a result, best fitness first, without those next to a better one.

    Parameters
    ----------
    apart : (float, float)
        See :func:`register_starts`.
    """
    kept: list[Registration] = []
    for r in sorted((r for r in results if r.converged), key=lambda r: -r.best_fitness):
        moves = [_moved(b.T_target_source, r.T_target_source) for b in kept]
        if all(shift >= apart[0] or turn >= apart[1] for shift, turn in moves):
            kept.append(r)
    return kept


def failed_gates(result: Registration, config: RegistrationConfig) -> str:
    """Messages of the failed gates; empty if none."""
    g, planar = config.gates, len(result.T_target_source) == 3
    fails = []
    if np.isnan(result.fitness_known):
        least = g.fitness_alone if np.isnan(result.fitness_upright) else g.fitness
        if result.fitness < least:
            fails.append(f"fitness {result.fitness:.3f} < {least:g}")
    else:
        if result.fitness_known < g.fitness_known:
            fails.append(f"fitness in known space {result.fitness_known:.3f} < {g.fitness_known:g}")
        if result.known_share < g.known_share:
            fails.append(f"share in known space {result.known_share:.3f} < {g.known_share:g}")
    if result.fitness_upright < g.fitness_upright:  # NaN passes
        fails.append(f"fitness of upright surfaces {result.fitness_upright:.3f} < {g.fitness_upright:g}")
    least = g.degeneracy_planar if planar else g.degeneracy
    if result.degeneracy < least:
        fails.append(f"degenerate: eigenvalue ratio {result.degeneracy:.4f} < {least:g}")
    if result.tilt > g.tilt:
        fails.append(f"tilt {np.degrees(result.tilt):.1f}° > {np.degrees(g.tilt):.1f}°")
    return "; ".join(fails)


def _align(source: Target, target: Target, T: Array, config: RegistrationConfig) -> PlanarAlignment:
    """Alignment in all stages."""
    limits = (config.iterations, ROTATION_EPSILON, TRANSLATION_EPSILON)
    if target.dim == 2:
        found = PlanarAlignment(T, np.zeros((3, 3)), 0.0, 0)
        for radius in config.radii:
            found = align_planar(source, target, found.T, radius, *limits)
        return found
    (cloud, tree), (moving, _) = target.cloud, source.cloud
    matrix = se3.pose_to_matrix(T)
    for radius in config.radii:
        result = small_gicp.align(
            cloud,
            moving,
            tree,
            init_T_target_source=matrix,
            registration_type="GICP",
            max_correspondence_distance=radius,
            num_threads=1,
            max_iterations=config.iterations,
            rotation_epsilon=ROTATION_EPSILON,
            translation_epsilon=TRANSLATION_EPSILON,
        )
        matrix = np.asarray(result.T_target_source)
        if not np.all(np.isfinite(matrix)):
            return PlanarAlignment(np.full(7, np.nan), np.full((6, 6), np.nan), float("nan"), int(result.num_inliers))
    pose = np.concatenate([matrix[:3, 3], se3.matrix_to_quat(matrix[:3, :3])])
    return PlanarAlignment(pose, np.asarray(result.H), float(result.error), int(result.num_inliers))


def _measure(
    source: Target,
    target: Target,
    found: PlanarAlignment,
    shift: float,
    turn: float,
    config: RegistrationConfig,
    known: Known | None,
) -> Registration:
    """All measures of a result, without the gates."""
    dim, planar = target.dim, target.dim == 2
    moved = transform_points(found.T, source.points)
    reach = max(config.near, config.radii[-1])
    distance, which = target.tree.query(moved, distance_upper_bound=reach)
    near = distance < config.near
    inside = None if known is None else np.asarray(known(moved) if callable(known) else known, dtype=bool)
    if inside is not None and inside.shape != (len(source),):
        raise DataError("the answer of `known` does not go with the source", got=inside.shape, wanted=(len(source),))
    share = float("nan") if inside is None else float(np.mean(inside))
    fitness_known = float("nan") if inside is None else float(np.mean(near[inside])) if np.any(inside) else 0.0
    paired = np.flatnonzero(distance < config.radii[-1])
    upright = float("nan")
    if not planar:
        normals, _ = source.normals(np.arange(len(source)))
        steep = np.abs(se3.quat_rotate(found.T[3:], normals)[:, 2]) < np.sqrt(0.5)
        steep &= np.any(normals != 0.0, axis=1)
        if np.sum(steep) >= LEAST_POINTS:
            upright = float(np.mean(near[steep]))
    own, partner = source.normals(paired), target.normals(which[paired])
    rotation = se2.rotation2(found.T[2]) if planar else se3.quat_to_matrix(found.T[3:])
    noise_induced = noise_induced_information(
        source.points[paired], rotation, (own[0], partner[0]), (own[1], partner[1])
    )
    information = found.hessian - noise_induced
    held = translational_degeneracy(information, dim)
    # noise estimated from the pairs: 1 if the variances of the shapes are right
    freedom = max(found.pairs - len(found.hessian), 1)
    noise = max(2.0 * found.error / freedom, _LEAST_NOISE)
    factor = COVARIANCE_SCALE_PLANAR if planar else config.covariance_scale
    covariance = calibrated_covariance(
        information,
        dim=dim,
        scale=factor * noise,
        sigma=(config.floor_sigma, config.floor_turn),
        unknown=(config.max_shift, config.max_turn),
        threshold=config.gates.degeneracy_planar if planar else config.gates.degeneracy,
    )
    move = slice(0, 2) if planar else slice(3, 6)
    sigma = float(np.sqrt(held.weakest @ covariance[move, move] @ held.weakest))
    return Registration(
        T_target_source=found.T,
        covariance=covariance,
        fitness=float(np.mean(near)),
        fitness_known=fitness_known,
        fitness_upright=upright,
        known_share=share,
        rmse=float(np.sqrt(np.mean(distance[near] ** 2))) if np.any(near) else float("nan"),
        inliers=found.pairs,
        degeneracy=held.ratio,
        weakest=held.weakest,
        weakest_sigma=sigma,
        tilt=0.0 if planar else tilt_angle(found.T),
        shift=shift,
        turn=turn,
        converged=True,
        why="",
    )


def tilt_angle(T: Array) -> float:
    """Angle between the z axes of the two frames of a pose ``(7,)`` [rad]."""
    x, y = T[3], T[4]
    return float(2.0 * np.arctan2(np.hypot(x, y), np.hypot(T[5], T[6])))


def _moved(T_a: Array, T_b: Array) -> tuple[float, float]:
    """Distance between the origins of two poses [m], and angle between them [rad]."""
    shift = float(np.linalg.norm((T_b - T_a)[: 2 if len(T_a) == 3 else 3]))
    if len(T_a) == 3:
        return shift, float(abs(se2.wrap_angle(T_b[2] - T_a[2])))
    return shift, float(np.linalg.norm(se3.so3_log(se3.se3_between(T_a, T_b)[3:])))


def _no_result(start: Array, why: str) -> Registration:
    dim, d = (2, 3) if len(start) == 3 else (3, 6)
    return Registration(
        T_target_source=start, covariance=np.full((d, d), np.nan), weakest=np.full(dim, np.nan), why=why
    )
