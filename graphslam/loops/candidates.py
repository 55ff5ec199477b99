"""Which pairs of places are worth trying to match, and in which order.

Two places may see the same surroundings if the joint marginal of the graph lets them lie so near to each other that
their maps overlap. Registration costs far more than looking, and a loop that tells nothing new is not worth its risk:
so pairs are ordered by what a match would tell, ``½ log det(I + P R⁻¹)`` (P the covariance of the relative pose now, R
that of a match), times the chance that the two overlap, over what it costs to search; and of one stretch against
one submap one place is tried, not all.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.loops.places import Ints, Places, RelativePoses

FRONT_END, PROXIMITY, APPEARANCE, TIE = "front-end", "proximity", "appearance", "tie"


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateConfig:
    """Which pairs are tried."""

    overlap: float = 8.0
    """Maps of two places overlap enough to be matched if the places are nearer than this [m] …"""
    height: float = 1.0
    """… and not farther above each other than this [m]: storeys look alike."""
    sigmas: float = 2.5
    """A pair is a candidate if this many σ of its relative pose bring it within that."""
    least_way: float = 30.0
    """Places nearer along the way are not tried: they share scans or are neighbours anyway [m]."""
    least_gain: float = 2.0
    """Pairs whose match would tell less are not tried [nat]."""
    stretch: float = 12.0
    """Of one stretch of this length only the best place is tried against one submap [m]."""
    keep: int = 200
    """Candidates, at most."""
    match_sigma: float = 0.1
    """σ of a match that is expected: position [m] …"""
    match_angle: float = 0.012
    """… and angles [rad]."""
    search_sigma: float = 2.0
    """A search over this σ costs twice as much as the registration [m]."""
    least_support: float = 0.05
    """Front ends' matches with less support of their particles are left out."""
    batch: int = 20000
    """Pairs whose joint marginals are asked for at once."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            zero = f.name in ("least_way", "least_gain", "least_support", "stretch")
            if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
                raise ConfigError(f"loop candidates: {f.name} = {value}; wanted a number {'≥' if zero else '>'} 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopCandidate:
    """A pair of places that may be tied.

    Parameters
    ----------
    i, j : int
        Places, ``i`` before ``j`` on the way: the map of i's submap is the target, what j sees the source.
    source : str
        ``front-end``, ``proximity``, ``appearance``, ``tie`` (:mod:`~graphslam.loops.overlap_constraints`).
    T_ij : (7,) or (3,)
        The prediction; for a front end's match or a tie the measurement itself.
    covariance : (d, d)
        Of it, right tangent.
    gain : float
        What a match is expected to tell [nat].
    score : float
        What candidates of one source are ordered by.
    facts : dict
        What else the source says: support and fitness of a front end's match, distance of descriptors.
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
    """``½ log det(I + P R⁻¹)`` of relative poses with covariances ``P (k, d, d)`` and a match of stated σ ``(k,)``."""
    d = P.shape[-1]
    inverse_sigma = np.full(d, 1.0 / match_angle)
    inverse_sigma[slice(0, 2) if dim == 2 else slice(3, 6)] = 1.0 / match_sigma
    scaled = np.eye(d) + P * inverse_sigma[:, None] * inverse_sigma
    return np.asarray(0.5 * np.linalg.slogdet(scaled)[1])


def overlap_probability(T: Array, P: Array, config: CandidateConfig) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Chance that two places overlap ``(k,)``, and whether they may ``(k,)``.

    Horizontally by the distance and its σ along the line between the two (or across it, where they may coincide), in
    the axes of the first; vertically by the difference of heights.

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


def proximity_candidates(
    places: Places,
    relative: RelativePoses,
    config: CandidateConfig | None = None,
    *,
    exclude: Collection[tuple[int, int]] = (),
    tried: Sequence[tuple[int, int]] = (),
    since: int = 0,
) -> list[LoopCandidate]:
    """Pairs that may see the same surroundings by what the graph knows, most telling first.

    Parameters
    ----------
    relative : RelativePoses
        Of the graph, asked for the nodes of places.
    exclude : collection of (int, int)
        Pairs of submaps (either way round) that are not tried: their maps hold the same scans.
    tried : sequence of (int, int)
        Pairs of places that were tried before: their stretches are not tried again.
    since : int
        Only pairs whose later place lies in this submap of the chain or a later one.
    """
    c = CandidateConfig() if config is None else config
    n = len(places)
    first, second = np.triu_indices(n, 1)
    far = places.way[second] - places.way[first] >= c.least_way
    # a map against itself finds itself: stretches of one submap are no pair
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
    before = [(int(places.submap[p]), float(places.way[q])) for p, q in tried]
    chosen = thin_candidates(places.submap[ends_i], places.way[ends_j], score, c.stretch, c.keep, before)
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


def thin_candidates(
    target: Ints,
    way: Array,
    score: Array,
    stretch: float,
    keep: int,
    taken: Sequence[tuple[int, float]] = (),
) -> list[int]:
    """Best pairs of which no two try places of one stretch against one submap, best first.

    Parameters
    ----------
    target : (m,) int
        Submaps that would be searched, whole.
    way : (m,)
        Of the places that would be looked for [m].
    score : (m,)
    stretch : float
        [m]
    keep : int
        At most.
    taken : sequence of (int, float)
        Target and way of pairs that were tried already.
    """
    left = np.ones(len(score), bool)
    for m, w in taken:
        left &= (target != m) | (np.abs(way - w) >= stretch)
    out: list[int] = []
    for k in np.argsort(-score, kind="stable").tolist():
        if len(out) == keep:
            break
        if left[k]:
            out.append(k)
            left &= (target != target[k]) | (np.abs(way - way[k]) >= stretch)
    return out


def front_end_candidates(
    submaps: Sequence[Submap], places: Places, config: CandidateConfig | None = None
) -> list[LoopCandidate]:
    """Matches that the front end made, most supported first; they are measured already, and need no registration.

    ``i`` is the place of the target nearest to the match, ``j`` the base of the submap that entered it. Matches into
    submaps that are not in the chain are left out.
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
    """Pairs of submaps whose maps hold the same scans, by number: one entered the other's map and went on in it.

    Matching the two would find what the front end put there. What submaps hold is said by ``report["holds"]``, the keys
    of the submaps whose scans are in; without it a submap that was entered by a match is taken to hold its heaviest
    target's, and so on from there.
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
