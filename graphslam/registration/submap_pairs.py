"""Matching of the surroundings of a place in one submap to another submap: search, registration, gates, covariance.

The source is the map of one submap around a place, the target is the whole other submap. The prediction is a Gaussian
``T_target_source`` with a covariance in its right tangent: it limits the search, and matches that contradict it are
rejected. All good modes in that region are tried, because repetitive buildings have aliases; a match that is hardly
better than the next one is rejected, too.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from graphslam.core.dense import DenseMapView
from graphslam.core.errors import GeometryError
from graphslam.core.gaussian import check_covariance, chi2_quantile
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.points import check_pose, evenly_spaced
from graphslam.core.poses import Group, group_of
from graphslam.registration.config import LEAST_POINTS
from graphslam.registration.gates import failed_match_gates, match_margins
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.register import Registration, distinct_registrations, register
from graphslam.registration.search import at_once, search_in_slices
from graphslam.registration.search_field import SearchField
from graphslam.registration.target import Target


class PreparedMap:
    """A submap's dense map prepared for matching; all parts are computed lazily.

    Parameters
    ----------
    view : DenseMapView
        In the frame of the submap's base.
    """

    def __init__(self, view: DenseMapView, config: PairConfig) -> None:
        self.view, self.config = view, config
        self._fields: dict[float, SearchField] = {}

    @cached_property
    def points(self) -> Array:
        """Surface points, averaged in cells ``(m, dim)`` [m]."""
        return self.view.points(self.config.cloud_level)

    @cached_property
    def target(self) -> Target:
        """The points with their tree and shapes."""
        return Target(self.points)

    def field_in_slices(self, scale: float) -> Generator[None, None, SearchField]:
        """Likelihood field, fine (1) or coarse (2), made at first use in slices of bounded work."""
        if scale not in self._fields:
            c, occupied = self.config, self.view.points()
            yield
            cell = scale * (c.grid / 4.0)
            self._fields[scale] = yield from SearchField.in_slices(occupied, cell=cell, sigma=scale * c.field_sigma)
        return self._fields[scale]

    @property
    def nbytes(self) -> int:
        """Approximate memory of the computed parts [bytes]."""
        made = self.__dict__
        points = made["points"].nbytes if "points" in made else 0
        fields = sum(f.nbytes for f in self._fields.values())
        return fields + points * (6 if "target" in made else 1)  # the points, their tree and their shapes

    def around(self, T_base_place: ArrayLike) -> Array:
        """Points ``(m, dim)`` around a place, in the frame of the place [m]; evenly subsampled if there are too
        many."""
        T = np.asarray(T_base_place, dtype=np.float64)
        g, p = group_of(T), self.points
        near = np.hypot(*(p[:, :2] - T[:2]).T) <= self.config.radius
        if g.dim == 3:
            near &= np.abs(p[:, 2] - T[2]) <= self.config.height
        chosen = evenly_spaced(p[near], self.config.source_points)
        return g.transform(np.broadcast_to(g.inverse(T), (len(chosen), g.size)), chosen)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMatch:
    """Result of matching a place of one submap to another.

    Parameters
    ----------
    T_target_source : (7,) or (3,)
        The match; the prediction if there is none.
    covariance : (d, d)
        Right tangent; NaN without a result.
    why : str
        Failed gates; empty if accepted.
    registration : Registration or None
        The underlying registration.
    chi2 : float
        Of the difference between match and prediction, with both covariances; NaN without a result.
    margin : float
        Difference to the best alternative: mean of the fitness and that of upright surfaces, if known.
    contradiction : float
        Share of contradicting voxels of the two maps; NaN without a result.
    modes : int
        Number of distinct modes.
    points : int
        Number of source points.
    loose : bool
        One direction is not determined by the match, and has the uncertainty of the prediction.
    half_widths : tuple of float
        Of the search: x, y[, z] [m], heading [rad].
    """

    T_target_source: Array
    covariance: Array
    why: str
    registration: Registration | None = None
    chi2: float = math.nan
    margin: float = math.nan
    contradiction: float = math.nan
    modes: int = 0
    points: int = 0
    loose: bool = False
    half_widths: tuple[float, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether the match passes all gates."""
        return not self.why

    def gates(self) -> dict[str, Any]:
        """The tested values, JSON-serialisable."""
        r = self.registration
        nan = math.nan
        return {
            "fitness": nan if r is None else r.fitness,
            "fitness_known": nan if r is None else r.fitness_known,
            "fitness_upright": nan if r is None else r.fitness_upright,
            "known_share": nan if r is None else r.known_share,
            "degeneracy": nan if r is None else r.degeneracy,
            "margin": self.margin,
            "contradiction": self.contradiction,
            "chi2": self.chi2,
            "modes": self.modes,
            "points": self.points,
            "loose": self.loose,
        }


def match_pair_in_slices(
    source: PreparedMap,
    T_base_place: ArrayLike,
    target: PreparedMap,
    T_target_place: ArrayLike,
    covariance: ArrayLike,
    config: PairConfig | None = None,
) -> Generator[None, None, PairMatch]:
    """Match the surroundings of a place of one submap to another submap.

    In slices of bounded work; :data:`match_pair` does them in one call.

    Parameters
    ----------
    T_base_place : (7,) or (3,)
        The place in the frame of the source's base.
    T_target_place : (7,) or (3,)
        Its predicted pose in the frame of the target's base.
    covariance : (d, d)
        Of the prediction, right tangent.
    config : PairConfig, optional
        Default: that of the target.

    Returns
    -------
    PairMatch
        ``T_target_source`` is that of the place. No exception if a match fails.
    """
    c = target.config if config is None else config
    g = group_of(T_target_place)
    if g.dim != target.view.dim or g.dim != source.view.dim:
        raise GeometryError("pair of submaps: dimensions differ", got=(source.view.dim, target.view.dim), wanted=g.dim)
    T = check_pose(T_target_place, g.dim, what="prediction of a pair of submaps")
    P = check_covariance(covariance, what="covariance of a pair of submaps", dim=g.dof)
    points = source.around(T_base_place)
    if min(len(points), len(target.points)) < LEAST_POINTS:
        why = f"nothing: {len(points)} points around the place, {len(target.points)} in the map, wanted {LEAST_POINTS}"
        return _nothing(T, why, len(points))
    half = half_widths(T, P, c)
    yield
    fine = yield from target.field_in_slices(1.0)
    coarse = yield from target.field_in_slices(2.0)
    yield
    steps = [*[c.grid] * g.dim, c.yaw_step]
    found = yield from search_in_slices(points, fine, T, half, steps, c.starts, coarse=coarse)
    best = max((s.score for s in found), default=0.0)
    starts = [s.T for s in found if s.score >= max(c.least_score, best - c.score_margin)]
    if not starts:
        return _nothing(T, f"nothing: no place explains more than {best:.2f} of the points", len(points), tuple(half))
    # a body can be tilted: the tilt against the prediction is tested later
    rules = replace(c.registration, gates=replace(c.registration.gates, tilt=math.pi))
    cloud = Target(points)
    known = target.view.known_at if target.view.knows_space else None  # without free space, all points must fit
    results = []
    for start in starts:
        yield
        results.append(register(cloud, target.target, start, rules, known=known))
    yield
    results = distinct_registrations(results)
    results = [_upright_in_known(r, cloud, target, c) for r in results]
    place = np.asarray(T_base_place, dtype=np.float64)
    return replace(_judge(results, points, source, place, target, T, P, c), half_widths=tuple(half))


match_pair = at_once(match_pair_in_slices)


def half_widths(T: Array, P: Array, config: PairConfig) -> list[float]:
    """Half widths of the search for a prediction: x, y[, z] [m] along the target's axes, heading [rad]."""
    g = group_of(T)
    at = g.position
    R = rotation_matrix_of(T, g)
    s = config.sigmas * np.sqrt(np.diag(R @ P[at, at] @ R.T))
    # heading about the vertical of the target, for a body that can be tilted
    up = R.T[:, 2] if g.dim == 3 else None
    turn = config.sigmas * math.sqrt(P[2, 2] if up is None else float(up @ P[:3, :3] @ up))
    low, high = config.least, config.most
    out = [float(np.clip(v, low[0], high[0])) for v in s[:2]]
    if g.dim == 3:
        out.append(float(np.clip(s[2], low[1], high[1])))
    return [*out, float(np.clip(turn, low[2], high[2]))]


def rotation_matrix_of(T: Array, g: Group) -> Array:
    """Rotation matrix ``(dim, dim)`` of a pose."""
    corner = g.transform(np.broadcast_to(T, (g.dim, g.size)), np.eye(g.dim))
    return np.asarray((corner - T[: g.dim]).T)


def _judge(
    results: Sequence[Registration],
    points: Array,
    source: PreparedMap,
    T_base_place: Array,
    target: PreparedMap,
    T: Array,
    P: Array,
    c: PairConfig,
) -> PairMatch:
    """Best mode compatible with the prediction, and its gates."""
    g = group_of(T)
    modes = distinct_registrations(results)
    if not modes:
        return _nothing(T, "nothing: no start led to a result", len(points))
    own = [_covariance(r, P, c) for r in modes]
    chi2 = np.array([prediction_chi2(r.T_target_source, C, T, P) for r, (C, _) in zip(modes, own)])
    limit = chi2_quantile(c.chi2_level, g.dof)
    fit = np.array([_likeness(r) for r in modes])
    allowed = np.flatnonzero(chi2 <= limit)
    allowed = allowed[np.argsort(-fit[allowed], kind="stable")]  # best first
    k = int(allowed[0]) if len(allowed) else int(np.argmin(chi2))
    best, (covariance, loose) = modes[k], own[k]
    T_found = best.T_target_source
    clash = contradiction_share(source, T_base_place, target, T_found, points)
    out = PairMatch(
        T_target_source=T_found, covariance=covariance, why="", registration=best, chi2=float(chi2[k]),
        contradiction=clash, modes=len(allowed), points=len(points), loose=loose,
    )  # fmt: skip
    if not len(allowed):
        return replace(out, why=f"prediction: χ² {chi2[k]:.1f} > {limit:.1f}")
    margin = _margin([modes[i] for i in allowed], loose, c)
    rules = c.registration
    if loose:  # accounted for in the covariance
        rules = replace(rules, gates=replace(rules.gates, degeneracy=0.0, degeneracy_planar=0.0))
    R = rotation_matrix_of(T, g)
    rise = c.sigmas * math.sqrt(float((R @ P[g.position, g.position] @ R.T)[-1, -1])) if g.dim == 3 else 0.0
    fails = failed_match_gates(best, T, c.gates, rules, sigma=1.0, margin=margin, rise=rise, ask_vague=not loose)
    if clash > c.contradiction:
        fails.append(f"contradiction {clash:.3f} > {c.contradiction:g}")
    return replace(out, why="; ".join(fails), margin=margin)


FREE, BESIDE = -1.0, 0.5
"""Voxels with at most this log-odds are free, unless something is occupied within this distance [m]."""


def contradiction_share(
    source: PreparedMap, T_base_place: Array, target: PreparedMap, T_target_place: Array, points: Array
) -> float:
    """Share of the occupied voxels of one map that are free in the other (of those known there); the larger of both.

    Parameters
    ----------
    T_base_place, T_target_place : (7,) or (3,)
        The place in both base frames.
    points : (m, dim)
        Of the source, around the place and in its frame [m].

    Returns
    -------
    float
        0 without overlap.
    """
    g = group_of(T_target_place)

    def share(held: PreparedMap, p: Array) -> float:
        values = np.asarray(held.view.log_odds_at(p), dtype=np.float64)
        known = ~np.isnan(values)
        if not np.any(known):
            return 0.0
        far = ~np.isfinite(held.target.tree.query(p[known], distance_upper_bound=BESIDE)[0])
        return float(np.mean(far & (values[known] <= FREE)))

    there = target.around(T_target_place)  # in the frame of the place
    return max(
        share(target, g.transform(np.broadcast_to(T_target_place, (len(points), g.size)), points)),
        share(source, g.transform(np.broadcast_to(T_base_place, (len(there), g.size)), there)),
    )


def _upright_in_known(r: Registration, cloud: Target, target: PreparedMap, c: PairConfig) -> Registration:
    """Replace the fitness of upright surfaces by that in known space: the place can extend beyond the map."""
    if cloud.dim == 2 or not target.view.knows_space:
        return r
    T, rules = r.T_target_source, c.registration
    normals, _ = cloud.normals(np.arange(len(cloud)))
    up = rotation_matrix_of(T, group_of(T))[2]  # the target's vertical in the frame of the place
    steep = (np.abs(normals @ up) < math.sqrt(0.5)) & np.any(normals != 0.0, axis=1)
    moved = group_of(T).transform(np.broadcast_to(T, (len(cloud), 7)), cloud.points)
    steep &= target.view.known_at(moved)
    if np.sum(steep) < LEAST_POINTS:
        return replace(r, fitness_upright=math.nan)
    near = target.target.tree.query(moved[steep], distance_upper_bound=rules.near)[0] < rules.near
    return replace(r, fitness_upright=float(np.mean(near)))


def prediction_chi2(T: ArrayLike, C: ArrayLike, T_prior: ArrayLike, P: ArrayLike) -> float:
    """χ² of a match against a prediction, ``e = Log(T_prior⁻¹ T)``, ``eᵀ (P + Ad(T_prior⁻¹ T) C Ad(…)ᵀ)⁻¹ e``.

    Parameters
    ----------
    T, T_prior : (7,) or (3,)
    C, P : (d, d)
        Their covariances, each in its own right tangent.
    """
    g = group_of(T)
    D = g.between(T_prior, T)
    A = g.adjoint(D)
    e = g.log(D)
    return float(e @ np.linalg.solve(np.asarray(P) + A @ np.asarray(C) @ A.T, e))


def _covariance(r: Registration, P: Array, c: PairConfig) -> tuple[Array, bool]:
    """Covariance of a match, and whether one direction is undetermined.

    The registration limits σ of such a direction by the allowed shift, which can be less than that of the prediction.
    Therefore ten σ of the prediction are used, so that the match adds no information along that axis.
    """
    C = c.inflation * r.covariance
    dim = len(r.weakest)
    gates = c.registration.gates
    least = gates.degeneracy_planar if dim == 2 else gates.degeneracy
    if not c.loose or r.degeneracy >= least:
        return C, False
    axis = np.zeros(len(C))
    axis[group_of(r.T_target_source).position] = r.weakest
    unknown = 100.0 * float(axis @ P @ axis)
    return C + max(unknown - float(axis @ C @ axis), 0.0) * np.outer(axis, axis), True


def _likeness(r: Registration) -> float:
    """Score for comparing modes: mean of the fitness and that of upright surfaces, if known. Floors and ceilings are
    most of the points, and fit anywhere."""
    return r.best_fitness if math.isnan(r.fitness_upright) else 0.5 * (r.best_fitness + r.fitness_upright)


def _margin(modes: list[Registration], loose: bool, c: PairConfig) -> float:
    """Score of the first mode minus that of the next; modes along an undetermined direction are not counted."""
    modes = [replace(r, fitness_known=_likeness(r)) for r in modes]
    best = modes[0]
    if loose:
        g = group_of(best.T_target_source)
        v = rotation_matrix_of(best.T_target_source, g) @ best.weakest
        d = np.stack([m.T_target_source[: g.dim] - best.T_target_source[: g.dim] for m in modes])
        across = np.linalg.norm(d - np.outer(d @ v, v), axis=1)
        modes = [best, *(m for m, a in zip(modes[1:], across[1:]) if a >= c.gates.mode_distance)]
    return float(match_margins(modes, np.zeros(len(modes)), c.gates.mode_distance)[0])


def _nothing(T: Array, why: str, points: int, half: tuple[float, ...] = ()) -> PairMatch:
    d = group_of(T).dof
    return PairMatch(
        T_target_source=T, covariance=np.full((d, d), math.nan), why=why, points=points, half_widths=half
    )  # fmt: skip
