"""Find loops between the submaps of a solved graph: candidates, registration, decisions, and a new solution."""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field

from graphslam.core.config import check_options
from graphslam.core.errors import DataError
from graphslam.core.submap import Submap
from graphslam.evidence.views import has_dense_view
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.appearance import AppearanceConfig, appearance_candidates
from graphslam.loops.candidates import (
    FRONT_END,
    CandidateConfig,
    LoopCandidate,
    front_end_candidates,
    pairs_sharing_scans,
    proximity_in_slices,
)
from graphslam.loops.graph_loops import GraphLoops, chain_of_graph
from graphslam.loops.loops import LoopCloser, LoopConfig
from graphslam.loops.measure import LoopMeasurer
from graphslam.loops.overlap_constraints import Entry, OverlapConfig, overlap_candidates, overlap_entries
from graphslam.loops.places import Places
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.place_descriptor import DescriptorConfig, concatenate_descriptors, describe_places
from graphslam.registration.search import last_value
from graphslam.solve.registry import Solver

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class FindConfig:
    """Options of the loop search."""

    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    """Proximity, and minimum support of front-end matches."""
    pairs: PairConfig = field(default_factory=PairConfig)
    """Registration and its gates."""
    decisions: LoopConfig = field(default_factory=LoopConfig)
    """Tests for accepting loops."""
    appearance: AppearanceConfig | None = None
    """Options of candidates by appearance; None: off."""
    descriptors: DescriptorConfig = field(default_factory=DescriptorConfig)
    """Descriptors of places for appearance."""
    front_end: bool = False
    """Include the front end's matches; not if they are factors of the graph already."""
    overlaps: OverlapConfig | None = field(default_factory=OverlapConfig)
    """Overlap constraints along submaps that continued in an older map (with ``front_end``: by accepted matches); None:
    off. They are added last, and removed together with the match that they depend on."""
    rounds: int = 3
    """Largest number of proximity rounds; repeated while loops are accepted, which improve the estimate (0: off)."""

    def __post_init__(self) -> None:
        check_options(self, "find loops: ", {"≥ 0": "rounds"})


def find_loops(
    graph: FactorGraph,
    solver: Solver,
    submaps: Sequence[Submap],
    config: FindConfig | None = None,
    *,
    progress: bool = False,
) -> LoopCloser:
    """Find loops and add them to a graph.

    Parameters
    ----------
    graph : FactorGraph
        Of one chain of dense submaps, solved.
    solver : Solver
        Of that graph.
    submaps : sequence of Submap
        Those of the graph in their order, with dense maps.
    config : FindConfig, optional
    progress : bool
        Show a progress bar.

    Returns
    -------
    LoopCloser
        Its ``ledger`` has every decision; the graph has the accepted loops and is at its optimum.

    Raises
    ------
    DataError
        The submaps are not those of the graph, one has no map, or the graph is not a chain.

    Examples
    --------
    >>> from graphslam.solve.registry import make_solver
    >>> court = gs.simulate("court", preset="light", seed=1, progress=False)
    >>> hall = gs.run(court, frontend="scan-window", progress=False)
    >>> found = gs.find_loops(hall.graph, make_solver("batch", hall.graph), hall.submaps)
    >>> len(found.ledger.table()) >= 0
    True
    """
    return last_value(LoopSearch(config).look_in_slices(graph, solver, submaps, last=True, progress=progress))


class LoopSearch:
    """Repeated loop search in a growing graph; earlier decisions are revised with new loops.

    A search compares the submaps added since the previous search with all of them. The last search compares all pairs,
    also rejected ones, because the estimate has improved; it also includes the parts that need the whole chain:
    appearance and overlap constraints.
    """

    def __init__(self, config: FindConfig | None = None) -> None:
        self.config = FindConfig() if config is None else config
        self.closer: LoopCloser | None = None
        self._measurer: LoopMeasurer | None = None
        self._seen = 0

    def look_in_slices(
        self,
        graph: FactorGraph,
        solver: Solver,
        submaps: Sequence[Submap],
        *,
        last: bool = False,
        progress: bool = False,
    ) -> Generator[None, None, LoopCloser]:
        """Search in slices of bounded work; the graph must not be changed in between.

        Parameters and errors as in :func:`find_loops`; ``last``: no more submaps follow.
        """
        c = self.config
        if [s.key for s in submaps] != [s.key for s in graph.submaps]:
            raise DataError("the submaps are not those of the graph", got=len(submaps), wanted=len(graph.submaps))
        ours = GraphLoops(graph, solver)
        p = ours.places
        if self.closer is None or self._measurer is None:
            self._measurer = m = LoopMeasurer(submaps, p, c.pairs)
            self.closer = LoopCloser(ours, *chain_of_graph(graph), c.decisions, map_check=m.contradictions)
        closer, measurer = self.closer, self._measurer
        closer.extend_chain(ours, *chain_of_graph(graph))
        measurer.extend_chain(submaps, p)
        bare = [k for k, s in enumerate(submaps) if s.landmarks is not None and not has_dense_view(s)]
        shared = pairs_sharing_scans(submaps) | {(min(a, b), max(a, b)) for a in bare for b in range(len(submaps))}
        since = 0 if last else self._seen

        def go(candidates: Sequence[LoopCandidate]) -> Generator[None, None, int]:
            before = len(closer.accepted)
            found = yield from measurer.measure_in_slices(candidates, progress=progress)
            yield
            yield from closer.propose_in_slices(found, joint=last)
            return len(closer.accepted) - before

        if c.front_end:
            matches = front_end_candidates(submaps, p, c.candidates)
            yield from go([x for x in matches if p.submap[x.j] >= self._seen])
        # pairs that failed the registration may be tried again at another place
        tried = [(x.i, x.j) for x in closer.loops.values() if not x.why]
        for _ in range(c.rounds):
            near = yield from proximity_in_slices(
                p, ours.relative, c.candidates, exclude=shared, tried=tried, since=since
            )
            tried += [(x.i, x.j) for x in near]
            yield
            if (yield from go(near)) <= 0:
                break
        self._seen = len(submaps)
        if last:
            yield from go(self._look_alike(p, shared, tried))
            if c.overlaps is not None and c.front_end:
                yield from go(overlap_candidates(submaps, p, _believed(closer), c.overlaps))
                _drop_orphans(closer)
            measurer.forget()
        logger.info("loops: %s", closer.ledger.counts() or "no candidates")
        return closer

    def _look_alike(
        self,
        p: Places,
        shared: set[tuple[int, int]],
        tried: Sequence[tuple[int, int]],
    ) -> list[LoopCandidate]:
        """Candidates by appearance, at any distance."""
        c, measurer = self.config, self._measurer
        if c.appearance is None or measurer is None or len(measurer.submaps) < 2:
            return []
        parts = []
        for k, s in enumerate(measurer.submaps):
            # a dense submap without a map raises an error there; landmark submaps have no map
            view = None if s.landmarks is not None and not has_dense_view(s) else measurer.prepared(k).view
            parts.append(describe_places(view, p.T_base_node[p.of_submap(k)], c.descriptors))
        seen = {(int(p.submap[i]), round(float(p.arc[j]), 1)) for i, j in tried}
        alike = appearance_candidates(p, concatenate_descriptors(parts), c.appearance, exclude=shared)
        return [x for x in alike if (int(p.submap[x.i]), round(float(p.arc[x.j]), 1)) not in seen]


def _believed(closer: LoopCloser) -> set[Entry]:
    """Front-end matches that are in the graph, by keys of submaps."""
    inside = (closer.loops[n] for n in closer.accepted)
    return {x.submaps for x in inside if x.source == FRONT_END}


def _drop_orphans(closer: LoopCloser) -> None:
    """Remove overlap constraints whose match was rejected."""
    believed = _believed(closer)
    for n in closer.accepted:
        if not overlap_entries(closer.loops[n].gates) <= believed:
            closer.switch_off(n, "its match in that map is rejected")
