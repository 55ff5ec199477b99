"""Select and rank pairs of places for registration.

Two places are a candidate if, by the joint marginal of the graph, they may be so near to each other that their maps
overlap. Registration takes much longer than this selection, and a loop without new information is not worth its risk.
So pairs are ranked by the expected information gain of a match, ``½ log det(I + P R⁻¹)`` (P: current covariance of the
relative pose, R: that of a match), times the probability of overlap, divided by the search cost; and of each stretch
only one place is registered to a submap.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from graphslam.core.config import check_options
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.loops.places import Ints, Places, RelativePoses
from graphslam.registration.search import at_once

FRONT_END, PROXIMITY, APPEARANCE, OVERLAP = "front-end", "proximity", "appearance", "overlap"


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateConfig:
    """Which pairs of places are candidates."""

    overlap: float = 8.0
    """Maps of two places overlap enough to be matched if the distance of the places is smaller than this [m] …"""
    height: float = 1.0
    """… and their height difference not larger than this, because levels of a building look alike [m]."""
    sigmas: float = 2.5
    """A pair is a candidate if it may be within these limits by this many σ of its relative pose."""
    least_path: float = 30.0
    """Minimum path length between the two places: nearer ones share scans or are neighbours [m]."""
    least_gain: float = 2.0
    """Minimum expected information gain of a match [nat]."""
    stretch: float = 12.0
    """Only the best place of each stretch of this length is registered to a submap [m]."""
    keep: int = 200
    """Largest number of candidates."""
    match_sigma: float = 0.1
    """Expected σ of a match: position [m] …"""
    match_angle: float = 0.012
    """… and angles [rad]."""
    search_sigma: float = 2.0
    """σ of the relative position at which the search takes as long as the registration [m]."""
    least_support: float = 0.05
    """Front-end matches with less support of the particles are not used."""
    batch: int = 2000
    """Number of pairs whose joint marginals are computed at once."""

    def __post_init__(self) -> None:
        check_options(self, "loop candidates: ", {"≥ 0": "least_path least_gain least_support stretch", "> 0": "*"})


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopCandidate:
    """A pair of places that may be a loop closure.

    Parameters
    ----------
    i, j : int
        Places, ``i`` before ``j`` along the path: the map of i's submap is the target, the view from j the source.
    source : str
        ``front-end``, ``proximity``, ``appearance``, ``overlap`` (:mod:`~graphslam.loops.overlap_constraints`).
    T_ij : (7,) or (3,)
        The prediction; for a front-end match or an overlap constraint the measurement itself.
    covariance : (d, d)
        Of it, right tangent.
    gain : float
        Expected information gain of a match [nat].
    score : float
        Rank among candidates of one source.
    facts : dict
        Other values from the source: support and fitness of a front-end match, correlation of descriptors.
    """

    i: int
    j: int
    source: str
    T_ij: Array
    covariance: Array
    gain: float
    score: float
    facts: dict[str, Any] = field(default_factory=dict)


def information_gain(P: Array, match_sigma: float, match_angle: float, dim: int) -> Array:
    """``½ log det(I + P R⁻¹)`` of relative poses with covariances ``P (k, d, d)`` and a match of given σ ``(k,)``."""
    d = P.shape[-1]
    inverse_sigma = np.full(d, 1.0 / match_angle)
    inverse_sigma[slice(0, 2) if dim == 2 else slice(3, 6)] = 1.0 / match_sigma
    scaled = np.eye(d) + P * inverse_sigma[:, None] * inverse_sigma
    return np.asarray(0.5 * np.linalg.slogdet(scaled)[1])


def overlap_probability(T: Array, P: Array, config: CandidateConfig) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Probability that two places overlap ``(k,)``, and whether they may ``(k,)``.

    Horizontally by the distance and the larger horizontal σ, in the axes of the first place; vertically by the
    height difference.

    Parameters
    ----------
    T : (k, 7) or (k, 3)
    P : (k, d, d)
        Right tangents.
    """
    g = group_of(T)
    c = config
    corner = g.transform(np.repeat(T, g.dim, axis=0), np.tile(np.eye(g.dim), (len(T), 1))).reshape(-1, g.dim, g.dim)
    R = np.swapaxes(corner - T[:, None, : g.dim], 1, 2)
    S = R @ P[:, g.position, g.position] @ np.swapaxes(R, 1, 2)
    distance = np.hypot(T[:, 0], T[:, 1])
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(S[:, :2, :2])[:, -1], 0.0)) + 1e-9
    chance = ndtr((c.overlap - distance) / sigma) - ndtr((-c.overlap - distance) / sigma)
    may = distance - c.overlap <= c.sigmas * sigma
    if g.dim == 3:
        rise, s = np.abs(T[:, 2]), np.sqrt(np.maximum(S[:, 2, 2], 0.0)) + 1e-9
        chance = chance * (ndtr((c.height - rise) / s) - ndtr((-c.height - rise) / s))
        may &= rise - c.height <= c.sigmas * s
    return np.asarray(chance), np.asarray(may)


def proximity_in_slices(
    places: Places,
    relative: RelativePoses,
    config: CandidateConfig | None = None,
    *,
    exclude: Collection[tuple[int, int]] = (),
    tried: Sequence[tuple[int, int]] = (),
    since: int = 0,
) -> Generator[None, None, list[LoopCandidate]]:
    """Pairs of places that may observe the same surroundings by the graph's estimate, best first.

    In slices of bounded work; the graph must not be changed in between. :data:`proximity_candidates` does them in one
    call.

    Parameters
    ----------
    relative : RelativePoses
        Of the graph, for the nodes of the places.
    exclude : collection of (int, int)
        Pairs of submaps (in any order) that are not compared, because their maps include the same scans.
    tried : sequence of (int, int)
        Pairs of places that were registered before; their stretches are not registered again.
    since : int
        Only pairs whose later place is in this submap of the chain or a later one.
    """
    c = CandidateConfig() if config is None else config
    n = len(places)
    first, second = np.triu_indices(n, 1)
    far = places.arc[second] - places.arc[first] >= c.least_path
    # places of one submap are no pair: the map would be matched with itself
    far &= (places.submap[first] != places.submap[second]) & (places.submap[second] >= since)
    if exclude:
        m = int(places.submap.max()) + 1
        shut = np.zeros((m, m), bool)
        for one, other in exclude:
            shut[one, other] = shut[other, one] = True
        far &= ~shut[places.submap[first], places.submap[second]]
    first, second = first[far], second[far]
    kept: list[tuple[Ints, Ints, Array, Array, Array, Array]] = []
    for k in range(0, len(first), c.batch):
        a, b = first[k : k + c.batch].astype(np.int64), second[k : k + c.batch].astype(np.int64)
        yield
        T, P = relative(places.node[a], places.node[b])
        chance, may = overlap_probability(T, P, c)
        a, b, T, P, chance = a[may], b[may], T[may], P[may], chance[may]
        g = group_of(T)
        gain = information_gain(P, c.match_sigma, c.match_angle, g.dim)
        wide = np.sqrt(np.maximum(np.trace(P[:, g.position, g.position], axis1=1, axis2=2), 0.0))
        score = gain * chance / (1.0 + (wide / c.search_sigma) ** 2)
        worth = gain >= c.least_gain
        kept.append((a[worth], b[worth], T[worth], P[worth], gain[worth], score[worth]))
    if not kept:
        return []
    ends_i, ends_j, T, P, gain, score = (np.concatenate([part[k] for part in kept]) for k in range(6))
    before = [(int(places.submap[p]), float(places.arc[q])) for p, q in tried]
    chosen = thin_candidates(places.submap[ends_i], places.arc[ends_j], score, c.stretch, c.keep, before)
    return [
        LoopCandidate(
            i=int(ends_i[k]),
            j=int(ends_j[k]),
            source=PROXIMITY,
            T_ij=T[k],
            covariance=P[k],
            gain=float(gain[k]),
            score=float(score[k]),
        )
        for k in chosen
    ]


proximity_candidates = at_once(proximity_in_slices)


def thin_candidates(
    target: Ints,
    along: Array,
    score: Array,
    stretch: float,
    keep: int,
    earlier: Sequence[tuple[int, float]] = (),
) -> list[int]:
    """Best pairs, best first, with at most one place per stretch for each target submap.

    Parameters
    ----------
    target : (m,) int
        Target submap of each pair.
    along : (m,)
        Path length at the source place [m].
    score : (m,)
    stretch : float
        [m]
    keep : int
        Largest number of pairs.
    earlier : sequence of (int, float)
        Target and path length of pairs that were used before.
    """
    left = np.ones(len(score), bool)
    for m, w in earlier:
        left &= (target != m) | (np.abs(along - w) >= stretch)
    out: list[int] = []
    for k in np.argsort(-score, kind="stable").tolist():
        if len(out) == keep:
            break
        if left[k]:
            out.append(k)
            left &= (target != target[k]) | (np.abs(along - along[k]) >= stretch)
    return out


def front_end_candidates(
    submaps: Sequence[Submap], places: Places, config: CandidateConfig | None = None
) -> list[LoopCandidate]:
    """Matches of the front end, most supported first; they are measured already and need no registration.

    ``i`` is the place of the target nearest to the match, ``j`` the base of the submap that entered it. Matches into
    submaps that are not in the chain are omitted.
    """
    c = CandidateConfig() if config is None else config
    number = {s.key: k for k, s in enumerate(submaps)}
    out = []
    for k, s in enumerate(submaps):
        for m in s.matches:
            if m.support < c.least_support or m.target not in number:
                continue
            g = group_of(m.T_target_here)
            i = places.nearest(number[m.target], m.T_target_here[: g.dim])
            j = int(places.of_submap(k)[0])
            T = g.between(places.T_base_node[i], g.compose(m.T_target_here, places.T_base_node[j]))
            out.append(
                LoopCandidate(
                    i=i,
                    j=j,
                    source=FRONT_END,
                    T_ij=T,
                    covariance=np.array(m.covariance),
                    gain=math.nan,
                    score=float(m.support),
                    facts={"support": float(m.support), "fitness": float(m.fitness)},
                )
            )
    return sorted(out, key=lambda x: -x.score)


def pairs_sharing_scans(submaps: Sequence[Submap]) -> set[tuple[int, int]]:
    """Pairs of submaps whose maps include the same scans, by number: one continued in the other's map.

    A match between them would find the front end's own alignment. ``report["holds"]`` has the keys of the submaps whose
    scans are in a map; without it, a submap that was entered by a match is assumed to include the scans in the maps of
    its targets.
    """
    number = {s.key: k for k, s in enumerate(submaps)}
    holds: list[set[int]] = []
    for k, s in enumerate(submaps):
        mine = {k}
        if "holds" in s.report:
            mine |= {number[int(key)] for key in s.report["holds"] if int(key) in number}
        elif s.report.get("entered") == "match":
            for m in s.matches:
                if m.target in number:
                    mine |= holds[number[m.target]]
        holds.append(mine)
    n = len(submaps)
    return {(a, b) for a in range(n) for b in range(a + 1, n) if holds[a] & holds[b]}
