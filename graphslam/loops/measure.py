"""Register candidates, test the result, and attach the loops to the nearest places."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.progress import Bar
from graphslam.core.submap import Submap
from graphslam.evidence.views import dense_view
from graphslam.loops.candidates import FRONT_END, OVERLAP, LoopCandidate
from graphslam.loops.places import Places
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.search import last_value
from graphslam.registration.submap_pairs import PreparedMap, contradiction_share, match_pair_in_slices


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """A measured loop before the decision.

    Parameters
    ----------
    i, j : int
        Places, which are nodes of the chain.
    T_ij : (7,) or (3,)
    covariance : (d, d)
        Right tangent; NaN if the registration failed.
    source : str
        Source of the candidate.
    score, gain : float
        Of the candidate.
    why : str
        Failed gates of the registration; empty if it passed.
    gates : dict
        Values that were tested; JSON-serialisable.
    submaps : (int, int)
        Keys of the submaps of i and j.
    """

    i: int
    j: int
    T_ij: Array
    covariance: Array
    source: str
    score: float = float("nan")
    gain: float = float("nan")
    why: str = ""
    gates: dict[str, Any] = field(default_factory=dict)
    submaps: tuple[int, int] = (-1, -1)


ROOM = 256_000_000
"""Largest memory of prepared maps [bytes]."""


class LoopMeasurer:
    """Registers candidates; prepared maps are cached up to :data:`ROOM`.

    Parameters
    ----------
    submaps : sequence of Submap
        With dense maps.
    """

    def __init__(self, submaps: Sequence[Submap], places: Places, config: PairConfig | None = None) -> None:
        self.submaps, self.places = submaps, places
        self.config = PairConfig() if config is None else config
        self._maps: dict[int, PreparedMap] = {}

    def extend_chain(self, submaps: Sequence[Submap], places: Places) -> None:
        """Continue with a longer chain; prepared maps are kept."""
        self.submaps, self.places = submaps, places

    def forget(self) -> None:
        """Free the prepared maps; they are computed again when needed."""
        self._maps.clear()

    def prepared(self, k: int) -> PreparedMap:
        """The prepared map of submap ``k`` of the chain."""
        found = self._maps.pop(k, None)
        self._maps[k] = found = PreparedMap(dense_view(self.submaps[k]), self.config) if found is None else found
        return found

    def _let_go(self) -> None:
        """Free the least recently used maps above the memory limit."""
        held = sum(m.nbytes for m in self._maps.values())
        for k in list(self._maps):
            if held <= ROOM:
                break
            held -= self._maps.pop(k).nbytes

    def measure(self, candidates: Sequence[LoopCandidate], *, progress: bool = False) -> list[Loop]:
        """Loops of candidates, in their order; front-end matches and overlap constraints are measured already."""
        return last_value(self.measure_in_slices(candidates, progress=progress))

    def measure_in_slices(
        self, candidates: Sequence[LoopCandidate], *, progress: bool = False
    ) -> Generator[None, None, list[Loop]]:
        """:meth:`measure` in slices of bounded work."""
        found = []
        for c in Bar(candidates, "matching submaps", shown=progress):
            found.append((yield from self._one(c)))
        return found

    def _one(self, c: LoopCandidate) -> Generator[None, None, Loop]:
        """The loop of one candidate, whether it passes the gates or not."""
        p = self.places
        a, b = int(p.submap[c.i]), int(p.submap[c.j])
        keys = (self.submaps[a].key, self.submaps[b].key)
        if c.source in (FRONT_END, OVERLAP):
            return Loop(
                i=c.i, j=c.j, T_ij=c.T_ij, covariance=c.covariance, source=c.source, score=c.score, gain=c.gain,
                gates=dict(c.facts), submaps=keys,
            )  # fmt: skip
        g = group_of(c.T_ij)
        target_prior = g.compose(p.T_base_node[c.i], c.T_ij)
        source, target = self.prepared(b), self.prepared(a)
        m = yield from match_pair_in_slices(source, p.T_base_node[c.j], target, target_prior, c.covariance)
        self._let_go()
        i = c.i
        if m.registration is not None:
            # the map there was built from the nearest part of the target's path
            i = p.nearest(a, m.T_target_source[: g.dim])
        return Loop(
            i=i, j=c.j, T_ij=g.between(p.T_base_node[i], m.T_target_source), covariance=m.covariance, source=c.source,
            score=c.score, gain=c.gain, why=m.why, gates={**m.gates(), **c.facts}, submaps=keys,
        )  # fmt: skip

    def contradictions(self, loops: Sequence[Loop], T_ij: Array) -> Array:
        """Share of contradiction between the maps of loops ``(k,)``, at relative poses of their ends ``(k, 7|3)``."""
        p, g, out = self.places, group_of(T_ij), []
        for x, T in zip(loops, T_ij):
            source, target = self.prepared(int(p.submap[x.j])), self.prepared(int(p.submap[x.i]))
            at_j, at_i = p.T_base_node[x.j], p.T_base_node[x.i]
            out.append(contradiction_share(source, at_j, target, g.compose(at_i, T), source.around(at_j)))
            self._let_go()
        return np.array(out)
