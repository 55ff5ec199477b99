"""Loops between the submaps of a solved graph: found, measured, decided on; the graph is solved with those it keeps."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.submap import Submap
from graphslam.graph.pose_graph import PoseGraph
from graphslam.loops.appearance import AppearanceConfig, appearance_candidates
from graphslam.loops.candidates import (
    FRONT_END,
    Candidate,
    CandidateConfig,
    front_end_candidates,
    proximity_candidates,
    sharing_maps,
)
from graphslam.loops.graph_loops import GraphLoops, GraphSolver, chain_of_graph
from graphslam.loops.judge import settled_loops
from graphslam.loops.loops import LoopCloser, LoopConfig
from graphslam.loops.measure import LoopMeasurer
from graphslam.loops.ties import Entry, TieConfig, tie_candidates, ties_entries
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.place_descriptor import DescriptorConfig, describe, join

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class FindConfig:
    """How loops are looked for."""

    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    """Proximity, and which of the front end's matches count."""
    pairs: PairConfig = field(default_factory=PairConfig)
    """Registration and its gates."""
    decisions: LoopConfig = field(default_factory=LoopConfig)
    """What is believed."""
    appearance: AppearanceConfig | None = None
    """Also by what places look like; None: not."""
    descriptors: DescriptorConfig = field(default_factory=DescriptorConfig)
    """Of the places, for that."""
    front_end: bool = False
    """Also the front end's matches; not where they are factors of the graph already."""
    ties: TieConfig | None = field(default_factory=TieConfig)
    """Along submaps, where they were in a map that holds them (with ``front_end``: by its matches that are believed);
    None: not. They come last, and one is worth as much as the match by which it is in that map."""
    rounds: int = 3
    """Proximity is asked, again after loops were taken, at most so often: the graph knows more by then (0: never)."""

    def __post_init__(self) -> None:
        if self.rounds < 0:
            raise ConfigError(f"find loops: rounds = {self.rounds}; wanted at least 0")


def find_loops(
    graph: PoseGraph,
    solver: GraphSolver,
    submaps: Sequence[Submap],
    config: FindConfig | None = None,
    *,
    progress: bool = False,
) -> LoopCloser:
    """Find loops and add them to a graph.

    Parameters
    ----------
    graph : PoseGraph
        Of one chain of dense submaps, solved.
    solver : GraphSolver
        Of that graph.
    submaps : sequence of Submap
        Those of the graph in their order, with dense maps.
    config : FindConfig, optional
    progress : bool
        Show a bar.

    Returns
    -------
    LoopCloser
        Its ``ledger`` holds every decision; the graph holds what was accepted, and stands at its optimum.

    Raises
    ------
    DataError
        The submaps are not those of the graph, one has no map, or the graph is no chain.

    Examples
    --------
    >>> graph = gs.PoseGraph(3)
    >>> found = gs.find_loops(graph, solver, submaps)
    >>> found.ledger.table()
    """
    c = FindConfig() if config is None else config
    if [s.key for s in submaps] != [s.key for s in graph.submaps]:
        raise DataError("the submaps are not those of the graph", got=len(submaps), wanted=len(graph.submaps))
    ours = GraphLoops(graph, solver)
    closer = LoopCloser(ours, *chain_of_graph(graph), c.decisions, judge=settled_loops)
    measurer = LoopMeasurer(submaps, ours.places, c.pairs)
    shared = sharing_maps(submaps)
    tried: list[tuple[int, int]] = []

    def go(candidates: Sequence[Candidate]) -> int:
        before = len(closer.accepted)
        closer.propose(measurer.measure(candidates, progress=progress))
        return len(closer.accepted) - before

    if c.front_end:
        go(front_end_candidates(submaps, ours.places, c.candidates))
    for _ in range(c.rounds):
        near = proximity_candidates(ours.places, ours.relative, c.candidates, exclude=shared, tried=tried)
        tried += [(x.i, x.j) for x in near]
        if go(near) <= 0:
            break
    if c.appearance is not None and len(submaps) > 1:
        p = ours.places
        parts = [
            describe(measurer.prepared(k).view, p.T_base_node[p.of_submap(k)], c.descriptors)
            for k in range(len(submaps))
        ]
        seen = {(int(p.submap[i]), round(float(p.way[j]), 1)) for i, j in tried}
        alike = appearance_candidates(p, join(parts), c.appearance, exclude=shared)
        go([x for x in alike if (int(p.submap[x.i]), round(float(p.way[x.j]), 1)) not in seen])
    if c.ties is not None and c.front_end:
        go(tie_candidates(submaps, ours.places, _believed(closer), c.ties))
        _drop_orphans(closer)
    logger.info("loops: %s", closer.ledger.counts() or "no candidates")
    return closer


def _believed(closer: LoopCloser) -> set[Entry]:
    """Entries of the front end that are in the graph, by keys of submaps."""
    inside = (closer.loops[n] for n in closer.accepted)
    return {x.submaps for x in inside if x.source == FRONT_END}


def _drop_orphans(closer: LoopCloser) -> None:
    """Ties whose entry was switched off, perhaps by their company, go too."""
    believed = _believed(closer)
    for n in closer.accepted:
        if not ties_entries(closer.loops[n].gates) <= believed:
            closer.switch_off(n, "the match by which it is in that map is not believed")
