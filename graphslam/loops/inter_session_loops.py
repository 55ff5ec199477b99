"""Align one session of dense submaps with another: candidates by appearance, registration, and pairwise consistency.

The relative pose of two sessions is unknown, so there is no prediction to gate a match, and in a building with
repeating structure a similar place is often wrong. The decision is by consistency: two loop closures (a, b) and (c, d)
and the two chains between their ends must form a closed cycle (:mod:`~graphslam.association.consistent_set`, with the
chain cut between the sessions). The largest set of loop closures that are pairwise consistent must be large enough,
extend over some path length, and there must be no second set of similar size; otherwise no alignment is returned, with
the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import numpy.typing as npt

from graphslam.association.consistent_set import LoopArrays, OdometryChain, largest_consistent_set, pair_chi2
from graphslam.core.config import check_options
from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.evidence.views import dense_view, has_dense_view
from graphslam.graph.inner_nodes import cut_submap
from graphslam.loops.appearance import AppearanceConfig, appearance_candidates
from graphslam.loops.candidates import LoopCandidate, thin_candidates
from graphslam.loops.measure import Loop, LoopMeasurer
from graphslam.loops.places import Ints, Places
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.place_descriptor import (
    DescriptorConfig,
    PlaceDescriptors,
    concatenate_descriptors,
    describe_places,
)

Mask = npt.NDArray[np.bool_]
_APART = 1000.0  # path length between the sessions [m], so that no two of their places are in one stretch


@dataclass(frozen=True, slots=True, kw_only=True)
class InterSessionConfig:
    """Tests for accepting loop closures between two sessions."""

    top: int = 3
    """Largest number of candidates in the other session for each place."""
    alike: float = 0.5
    """Minimum correlation of descriptors."""
    stretch: float = 6.0
    """Places with a smaller distance along the path are in one stretch [m]."""
    keep: int = 60
    """Largest number of candidates that are registered, most similar first."""
    level: float = 0.99
    """Probability that two correct loop closures are consistent."""
    least: int = 3
    """Minimum number of consistent loop closures …"""
    reach: float = 6.0
    """… and of the path length of the new session that they cover [m]."""
    rival: float = 0.5
    """Largest size of a second consistent set of other loop closures, as a share of the first."""
    heard: int = 10
    """Minimum number of other places near each other in the alignment for a further test …"""
    borne: float = 0.1
    """… and minimum share of them that must match, because blocks of houses look alike in part."""

    def __post_init__(self) -> None:
        ranges = {"≥ 1": "top keep least heard", "in (0, 1)": "level", "≥ 0": "*"}
        check_options(self, "loop closures of sessions: ", ranges)


class SessionMap:
    """One session as a chain of nodes with the maps around them.

    Parameters
    ----------
    submaps : sequence of Submap
        Dense, with paths and maps.
    spacing : float
        Of the nodes [m]; node k is node k of a graph that starts with these submaps at this spacing.
    """

    def __init__(self, submaps: Sequence[Submap], spacing: float = 3.0) -> None:
        if not submaps:
            raise DataError("a session without submaps cannot be placed", wanted="at least one submap")
        self.submaps = list(submaps)
        nodes, which, poses, path_lengths, times, steps, covariances = [], [], [], [], [], [], []
        node, begin = 0, 0.0
        for k, s in enumerate(self.submaps):
            if s.landmarks is not None or not has_dense_view(s) or s.trajectory is None or not len(s.trajectory):
                raise DataError(f"submap {s.key} cannot be placed", wanted="a dense submap with a path and a map")
            cut = cut_submap(s, spacing)
            n = len(cut.increments)
            path = s.trajectory
            along = arc_length(path.positions)
            nodes.append(node + np.arange(n))
            which.append(np.full(n, k))
            poses.append(cut.T_base_node[:-1])
            times.append(cut.times[:-1])
            path_lengths.append(begin + np.interp(cut.times[:-1], path.times, along))
            steps.append(cut.increments)
            covariances.append(cut.covariances)
            node, begin = node + n, begin + float(along[-1])
        self.places = Places(
            np.concatenate(nodes).astype(np.int64),
            np.concatenate(which).astype(np.int64),
            np.concatenate(poses),
            np.concatenate(path_lengths),
            np.concatenate(times),
        )
        self.increments, self.covariances = np.concatenate(steps), np.concatenate(covariances)
        self.length = begin
        """Path length [m]."""

    @cached_property
    def descriptors(self) -> PlaceDescriptors:
        """Of the places; computed at first use."""
        config, out = DescriptorConfig(), []
        for k, s in enumerate(self.submaps):
            T = self.places.T_base_node[self.places.of_submap(k)]
            out.append(describe_places(dense_view(s), T, config))
        return concatenate_descriptors(out)


@dataclass(frozen=True, slots=True, kw_only=True)
class InterSessionLoops:
    """Candidates of loop closures between two sessions, with results.

    Parameters
    ----------
    loops : tuple of Loop
        Every candidate as measured; ``i`` is a node of the map's chain, ``j`` one of the session's own chain.
    accepted : (n,) bool
        Pairwise consistent ones.
    reasons : tuple of str
        Text for each.
    why : str
        Why the set as a whole is rejected; empty if it is accepted.
    rival : int
        Size of the largest consistent set of other loop closures.
    """

    loops: tuple[Loop, ...]
    accepted: Mask
    reasons: tuple[str, ...]
    why: str
    rival: int

    @property
    def chosen(self) -> list[Loop]:
        """The consistent loop closures; empty if the set is rejected."""
        return [x for x, yes in zip(self.loops, self.accepted) if yes] if not self.why else []

    def rows(self) -> list[dict[str, object]]:
        """One row per candidate: submaps, nodes, score, decision, reason, and the values of its gates."""
        return [
            {
                "submap_map": x.submaps[0],
                "submap_here": x.submaps[1],
                "i": x.i,
                "j": x.j,
                "source": x.source,
                "score": x.score,
                "accepted": bool(yes) and not self.why,
                "why": reason,
                "gates": x.gates,
            }
            for x, yes, reason in zip(self.loops, self.accepted, self.reasons)
        ]


class TwoSessions:
    """Two sessions: candidates between them, registration, consistency.

    Parameters
    ----------
    known, new : SessionMap
        The map, and the session to align with it.
    pairs : PairConfig, optional
        Options of the registration.
    """

    def __init__(self, known: SessionMap, new: SessionMap, pairs: PairConfig | None = None) -> None:
        self.known, self.new = known, new
        a, b = known.places, new.places
        if group_of(a.T_base_node).dim != group_of(b.T_base_node).dim:
            raise DataError("a 2-D and a 3-D session cannot be aligned")
        self.offset = len(known.increments) + 1
        """Offset of the new session's nodes in the chain of both; the end of the known session is a node, too."""
        self.places = Places(
            np.concatenate([a.node, self.offset + b.node]),
            np.concatenate([a.submap, len(known.submaps) + b.submap]),
            np.concatenate([a.T_base_node, b.T_base_node]),
            np.concatenate([a.arc, known.length + _APART + b.arc]),
            np.concatenate([a.time, b.time]),
        )
        self.measurer = LoopMeasurer([*known.submaps, *new.submaps], self.places, pairs)
        bridge, d = group_of(a.T_base_node).identity[None], known.covariances.shape[1]
        joined = np.ones(self.offset + len(new.increments), dtype=np.bool_)
        joined[self.offset - 1] = False  # the increment between the sessions is unknown
        self.chain = OdometryChain.of(
            np.concatenate([known.increments, bridge, new.increments]),
            np.concatenate([known.covariances, np.eye(d)[None], new.covariances]),
            joined,
        )

    @property
    def within(self) -> set[tuple[int, int]]:
        """Pairs of submaps of the same session, which are not compared."""
        n = len(self.known.submaps)
        m = n + len(self.new.submaps)
        return {*combinations(range(n), 2), *combinations(range(n, m), 2)}

    def candidates(self, config: InterSessionConfig) -> list[LoopCandidate]:
        """Places of the new session that look like places of the map."""
        appearance = AppearanceConfig(top=config.top, least=config.alike, lead=0.0, stretch=config.stretch)
        both = concatenate_descriptors([self.known.descriptors, self.new.descriptors])
        return appearance_candidates(self.places, both, appearance, exclude=self.within)[: config.keep]

    def measure(self, candidates: Sequence[LoopCandidate], *, progress: bool = False) -> list[Loop]:
        """Register candidates; ``i`` and ``j`` are nodes of the chain of both."""
        found = self.measurer.measure(candidates, progress=progress)
        node = self.places.node
        loops = [replace(x, i=int(node[x.i]), j=int(node[x.j])) for x in found]
        seen: set[tuple[int, int]] = set()
        for k, x in enumerate(loops):
            if x.why:
                continue
            if (x.i, x.j) in seen:  # two candidates with the same result are one measurement
                loops[k] = replace(x, why="the same as another candidate")
            seen.add((x.i, x.j))
        return loops

    def agree(self, loops: Sequence[Loop], config: InterSessionConfig) -> InterSessionLoops:
        """The largest consistent set of measured loop closures, and whether it is accepted.

        Parameters
        ----------
        loops : sequence of Loop
            From :meth:`measure`.

        Returns
        -------
        InterSessionLoops
            Its nodes ``j`` are those of the new session's own chain.
        """
        good = np.array([k for k, x in enumerate(loops) if not x.why], dtype=np.int64)
        accepted: Mask = np.zeros(len(loops), dtype=np.bool_)
        reasons = [f"registration: {x.why}" if x.why else "" for x in loops]
        rival, why, reach = 0, "", 0.0
        if len(good):
            D = self._disagreement([loops[k] for k in good])
            limit = chi2_quantile(config.level, self.chain.tangent_dim)
            best = largest_consistent_set(D, limit, against_chain=False)
            accepted[good[best.accepted]] = True
            for k, text in zip(good, best.reasons):
                reasons[int(k)] = f"pairwise: {text}"
            others = np.flatnonzero(~best.accepted)
            if len(others):
                rival = int(largest_consistent_set(D[np.ix_(others, others)], limit, against_chain=False).clique.sum())
            along = self.new.places.arc[self._rows([x for x, yes in zip(loops, accepted) if yes])]
            reach = float(np.ptp(along))
        n = int(accepted.sum())
        counts = f"{len(loops)} places looked alike, {len(good)} of them passed the registration, {n} agree"
        if n < config.least:
            why = f"{counts}, wanted {config.least}"
        elif reach < config.reach:
            why = f"{counts}, but over {reach:.1f} m of the path only, wanted {config.reach:g} m"
        elif rival > config.rival * n:
            why = f"{counts}, but {rival} others agree on another pose: this could be two places"
        own = [replace(x, j=x.j - self.offset) for x in loops]
        return InterSessionLoops(loops=tuple(own), accepted=accepted, reasons=tuple(reasons), why=why, rival=rival)

    def find(self, config: InterSessionConfig | None = None, *, progress: bool = False) -> InterSessionLoops:
        """Candidates by appearance, registered and tested for consistency."""
        c = InterSessionConfig() if config is None else config
        return self.agree(self.measure(self.candidates(c), progress=progress), c)

    def thinned(self, loops: Sequence[Loop], stretch: float) -> list[Loop]:
        """The most similar loop closures, at most one per stretch [m] and target submap (same surroundings).

        Parameters
        ----------
        loops : sequence of Loop
            Of :class:`InterSessionLoops`.
        stretch : float
            [m]
        """
        if not loops:
            return []
        target = self.known.places.submap[[x.i for x in loops]]
        along = self.new.places.arc[[x.j for x in loops]]
        chosen = thin_candidates(target, along, np.array([x.score for x in loops]), stretch, len(loops))
        return [loops[k] for k in sorted(chosen)]

    def _rows(self, loops: Sequence[Loop]) -> Ints:
        """Places of the new session at the ends of loop closures."""
        return np.array([x.j - self.offset for x in loops], dtype=np.int64)

    def _disagreement(self, loops: Sequence[Loop]) -> Array:
        """``D²`` of every pair of loop closures; single loop closures cannot be tested."""
        ends = np.array([[x.i, x.j] for x in loops], dtype=np.int64)
        arrays = LoopArrays.of(
            self.chain, ends, np.stack([x.T_ij for x in loops]), np.stack([x.covariance for x in loops])
        )
        n = len(loops)
        a, b = np.triu_indices(n, 1)
        D = np.zeros((n, n))
        D[a, b] = D[b, a] = pair_chi2(self.chain, arrays, a, b)
        return D


def session_start(loops: Sequence[Loop], known: Array, new: Array) -> Array:
    """Initial pose of a session in the map: the medoid of the poses from its loop closures.

    Parameters
    ----------
    known : (n, 7|3)
        Nodes of the map, in its frame.
    new : (m, 7|3)
        Nodes of the session, in that of its first base.

    Returns
    -------
    (7,) or (3,)
        From the loop closure with the smallest sum of distances to the others.
    """
    g = group_of(known)
    starts = np.stack([g.compose(g.compose(known[x.i], x.T_ij), g.inverse(new[x.j])) for x in loops])
    apart = np.linalg.norm(starts[:, None, : g.dim] - starts[None, :, : g.dim], axis=2)
    return np.asarray(starts[int(np.argmin(apart.sum(axis=1)))])
