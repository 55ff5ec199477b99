"""Other graphs of the same log: topologies that SegSLAM's particles tell, and choices of a run's matches and loops.

Each becomes a graph of its own; which of them is right is judged only then (:mod:`graphslam.maps.alternatives`): the
entropy of a map sample says more of how its segments happen to hang together than of which topology is right. SegSLAM's
authors take the sample of least entropy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.backend.back_end import BackEnd, find_config
from graphslam.backend.config import BackEndConfig, GpsOptions
from graphslam.backend.streams import ImuSource
from graphslam.core.control import ControlTable
from graphslam.core.errors import ConfigError
from graphslam.core.progress import Bar
from graphslam.core.records import Gps
from graphslam.core.submap import Match, Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.loops.candidates import TIE
from graphslam.loops.find_loops import FindConfig, find_loops
from graphslam.loops.graph_loops import GraphLoops
from graphslam.loops.ledger import LoopDecision
from graphslam.loops.measure import Loop
from graphslam.loops.overlap_constraints import overlap_entries
from graphslam.loops.rules import LoopConfig
from graphslam.maps.alternatives import Alternative
from graphslam.maps.minimum_entropy import MapHypothesis
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.segslam_evidence import own_evidence_of
from graphslam.maps.submaps import DividedSubmaps, divide_submaps
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.segslam.config import HandoverConfig
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segmap import SegMap
from graphslam_frontends.segslam.segment import KINDS, MATCH
from graphslam_frontends.segslam.submaps import common_ancestor_chain, drift_by_path, sampled_chain, submaps_of_segments


def build_back_end(
    submaps: Sequence[Submap],
    config: BackEndConfig,
    *,
    fixes: Gps | None = None,
    gps: GpsOptions | None = None,
    imu: ImuSource | None = None,
    control: ControlTable | None = None,
) -> BackEnd:
    """A back end with a graph of submaps, not yet at its optimum.

    Parameters
    ----------
    fixes : Gps, optional
        Those that count.
    imu, control : ImuSource, ControlTable, optional
        Of this graph alone; control rows, which enter when the graph is finished.
    """
    back = BackEnd(config, "batch", imu=imu, control=control)
    if fixes is not None:
        back.add_gps(fixes, GpsOptions() if gps is None else gps)
    for s in submaps:
        if fixes is None:
            back.append(s)
        else:  # where GPS begins is told by the graph as it is by then
            back.add(s)
    return back


LEAST_SUPPORT = 0.02
"""Share of the particles' weight below which a topology is left out."""
LOOP = -1
"""In place of the key of a submap: what follows is the number of a loop."""


Chosen = frozenset[tuple[int, int]]
"""Matches as (key of the submap, place among its matches), loops that were looked for as (LOOP, number)."""


def choices_of_matches(
    submaps: Sequence[Submap],
    support: float,
    *,
    loops: Sequence[LoopDecision] = (),
    undone: frozenset[tuple[int, int]] = frozenset(),
) -> dict[str, Chosen]:
    """Choices by name: the run's own, every threshold of support, and the run's own less each match and loop.

    Parameters
    ----------
    support : float
        The run's own threshold (``backend.match_support``).
    loops : sequence of LoopDecision
        Loops of the run's ledger that are in its graph and no matches of the front end.
    undone : frozenset of (int, int)
        Matches that are not in the run's graph, refused or taken out by hand: keys of the submap and of the one it
        entered.
    """
    every = {(s.key, i): m for s in submaps for i, m in enumerate(s.matches)}
    found_loops: Chosen = frozenset((LOOP, d.loop) for d in loops)
    taken: Chosen = frozenset(k for k, m in every.items() if m.support >= support and (k[0], m.target) not in undone)
    own = taken | found_loops
    found: dict[str, Chosen] = {"as the run": own, "no match or loop" if loops else "no match": frozenset()}
    found["matches alone"] = taken
    for least in sorted({m.support for m in every.values()}, reverse=True):
        at_least: Chosen = frozenset(k for k, m in every.items() if m.support >= least)
        found[f"support ≥ {least:.2g}"] = at_least | found_loops
    for key, i in sorted(taken):
        found[f"without {key} → {every[key, i].target}"] = own - {(key, i)}
    alone = [d for d in loops if d.source != TIE]
    for d in sorted(alone, key=lambda x: -x.chi2 if math.isfinite(x.chi2) else 0.0):  # the most doubtful first
        found[f"without loop {d.loop} ({d.submap_j} → {d.submap_i})"] = own - {(LOOP, d.loop)}
    needs = {(LOOP, d.loop): overlap_entries(d.gates) for d in loops}
    out: dict[str, Chosen] = {}
    for name, chosen in found.items():
        entries = {(every[k].target, k[0]) for k in chosen if k in every}
        kept = frozenset(k for k in chosen if needs.get(k, set()) <= entries)  # a tie goes with its match
        if kept not in out.values():
            out[name] = kept
    return out


def solve_choice(
    submaps: Sequence[Submap],
    chosen: Chosen,
    config: BackEndConfig,
    *,
    loops: Sequence[LoopDecision] = (),
    decided: Sequence[LoopDecision] = (),
    **streams: Any,
) -> BackEnd:
    """The graph of submaps with some of their matches and loops, solved to its optimum.

    Parameters
    ----------
    config : BackEndConfig
        The run's.
    loops : sequence of LoopDecision
        With their measurements; those that are chosen become factors as they were in the run.
    decided : sequence of LoopDecision
        Matches that the run decided on with its loops: in the graph as loops are, where they are chosen.
    **streams
        ``fixes``, ``gps``, ``imu`` and ``control`` of :func:`build_back_end`.
    """
    bare = []
    # two matches of one pair of submaps are told apart by their support
    as_loops = {(d.submap_j, d.submap_i, round(d.score, 9)): d for d in decided}
    taken = [d for d in loops if (LOOP, d.loop) in chosen]
    for s in submaps:
        kept: list[Match] = []
        for m in (m for i, m in enumerate(s.matches) if (s.key, i) in chosen):
            loop = as_loops.get((s.key, m.target, round(m.support, 9)))
            if loop is None:
                kept.append(m)
            else:
                taken.append(loop)
        bare.append(replace(s, matches=tuple(kept), grid=None))
    back = build_back_end(bare, replace(config, match_support=0.0, loops=False), **streams)
    back.solver.solve_to_optimum()
    if taken:
        graph = GraphLoops(back.graph, back.solver)
        for d in taken:
            C = np.array(d.covariance)
            measured = Loop(i=d.i, j=d.j, T_ij=np.array(d.T_ij), covariance=C, source=d.source)
            graph.add_loop(measured, LoopConfig().robust(len(C)))
    return back


Ints = npt.NDArray[np.int64]


Topology = tuple[tuple[int, int, str, int], ...]


def topology(segmap: SegMap, chain: Sequence[int] | Ints) -> Topology:
    """What makes chains of segments different maps: intervals, how each was entered, and whose map was entered.

    Segments of different particles are one where they say the same of that; of an entry into an older map counts when
    that map was begun.
    """
    t = segmap.table
    out = []
    for i in np.asarray(chain, dtype=np.int64).tolist():
        source = i
        while t.source[source] >= 0:
            source = int(t.source[source])
        begun = int(t.start[source]) if t.kind[i] == MATCH else -1
        out.append((int(t.start[i]), int(t.end[i]), KINDS[t.kind[i]], begun))
    return tuple(out)


def topologies(result: SegSlamResult) -> list[tuple[int, float, Ints]]:
    """Different topologies that particles tell: the heaviest particle of each, its support, its chain; by support."""
    groups: dict[Topology, list[tuple[float, int, Ints]]] = {}
    for p in np.argsort(-result.weights, kind="stable").tolist():
        chain = common_ancestor_chain(result.segmap, int(result.closed[p]))
        groups.setdefault(topology(result.segmap, chain), []).append((float(result.weights[p]), p, chain))
    found = [(members[0][1], sum(w for w, *_ in members), members[0][2]) for members in groups.values()]
    return sorted(found, key=lambda x: (-x[1], x[0]))


def _sampled(result: SegSlamResult, count: int, known: Sequence[Ints]) -> list[Ints]:
    """Chains of map samples that are different, and not known yet."""
    seen = {c.tobytes() for c in known}
    out = []
    for number in range(count):
        chain = sampled_chain(result.segmap, result.sample(number))
        if chain.tobytes() not in seen:
            seen.add(chain.tobytes())
            out.append(chain)
    return out


@dataclass(frozen=True, eq=False)
class TopologyHypothesis:
    """A topology that particles tell, as submaps.

    Parameters
    ----------
    particle : int
        Whose chain speaks for it: the heaviest; -1 of a map sample.
    support : float
        Share of the particles' weight that tells this topology; of one that withdraws an entry, the share that did not
        make it when it was made; of a map sample the share that tells the same.
    withdrawn : (int, int) or None
        Keys of the submaps whose entry is withdrawn.
    chain : (m,) int64
        Segments.
    grids : dict of int to EvidenceGrid
        By submap key, what it saw itself.
    """

    particle: int
    support: float
    withdrawn: tuple[int, int] | None
    chain: Ints
    submaps: list[Submap]
    grids: dict[int, EvidenceGrid]

    @property
    def entries(self) -> list[tuple[int, int]]:
        """Entries into older maps that its own chain makes: keys of the submap entered and of the one that entered."""
        return [(s.matches[0].target, s.key) for s in self.submaps if s.report.get("entered") == "match" and s.matches]

    def facts(self, loops: int) -> dict[str, Any]:
        """What is told of it beside the figures of its graph."""
        return {
            "support": round(self.support, 6),
            "withdrawn": None if self.withdrawn is None else list(self.withdrawn),
            "submaps": len(self.submaps),
            "entries": [list(e) for e in self.entries],
            "loops": loops,
        }


def _withdrawn(told: TopologyHypothesis) -> list[TopologyHypothesis]:
    """A topology without each of its entries in turn, the least supported entry first."""
    out = []
    for k, s in enumerate(told.submaps):
        for m in s.matches:
            rest = replace(s, matches=tuple(x for x in s.matches if x is not m))
            submaps = [*told.submaps[:k], rest, *told.submaps[k + 1 :]]
            support = told.support * max(1.0 - m.support, 0.0)
            out.append(TopologyHypothesis(told.particle, support, (m.target, s.key), told.chain, submaps, told.grids))
    return sorted(out, key=lambda x: -x.support)


def hypotheses_of(
    result: SegSlamResult,
    most: int,
    *,
    drift: FilterDrift,
    handover: HandoverConfig | None = None,
    samples: int = 0,
    least_support: float = LEAST_SUPPORT,
) -> tuple[list[TopologyHypothesis], int]:
    """Topologies of a SegMap: those that particles tell, by weight, then the first of them less each of its entries.

    Particles that entered different older maps, or none, tell different topologies; and of each entry it may be asked
    what the map would be without it, which is the null match that every particle could have drawn.

    Parameters
    ----------
    most : int
        Hypotheses that are looked at, at least one; the map samples come on top.
    drift : FilterDrift
        Of exits.
    handover : HandoverConfig, optional
        How segments become submaps.
    samples : int
        So many map samples are looked at, whose segments come from different particles.
    least_support : float
        Share of the particles' weight below which a topology is left out.

    Returns
    -------
    left_out : int
        Topologies with too little weight, or beyond the number that was asked for.
    """
    if most < 1:
        raise ConfigError(f"number of hypotheses = {most}; wanted at least 1")
    segmap, found = result.segmap, topologies(result)
    kept = [x for x in found if x[1] >= least_support][:most] or found[:1]
    chains = [(p, support, chain) for p, support, chain in kept]
    for chain in _sampled(result, samples, [chain for *_, chain in kept]):
        chains.append((-1, sum(w for _, w, c in found if topology(segmap, c) == topology(segmap, chain)), chain))
    told = []
    for particle, support, chain in chains:
        submaps = submaps_of_segments(
            segmap, chain, drift_by_path(segmap, chain, drift, result.steps), handover, uses=result.steps.uses
        )
        told.append(
            TopologyHypothesis(particle, support, None, chain, submaps, own_evidence_of(segmap, chain, submaps))
        )
    return [*told, *_withdrawn(told[0])[: most - len(kept)]], len(found) - len(kept)


def solve_hypotheses(
    told: Sequence[TopologyHypothesis],
    config: BackEndConfig,
    *,
    find: FindConfig | None = None,
    division: DivisionConfig | None = None,
    streams: Callable[[], Mapping[str, Any]] = dict,
    progress: bool = False,
) -> list[Alternative]:
    """A graph of each topology, with loops of its own, at its optimum; entries are decided on like all other loops.

    Parameters
    ----------
    config : BackEndConfig
        Of the run; nodes, level bases and scale are taken from it.
    find : FindConfig, optional
        How loops are looked for.
    division : DivisionConfig, optional
        How maps are cut into pieces; give the sensor's reach.
    streams : callable
        Makes ``fixes``, ``gps``, ``imu`` and ``control`` of one graph more; see :func:`build_back_end`.
    progress : bool
        Show a bar.
    """
    find = find_config(config) if find is None else find
    # no match is a factor at once: `find_loops` decides on them
    options = replace(config, match_support=math.inf, loops=False)
    pieces: dict[int, DividedSubmaps] = {}
    out = []
    for number, h in enumerate(Bar(told, "hypotheses", shown=progress)):
        back = build_back_end(h.submaps, options, **streams())
        back.solver.solve_to_optimum()
        # what is withdrawn must not come back by registration: that is the other hypothesis
        looked = find if h.withdrawn is None else replace(find, rounds=0, appearance=None)
        ledger = find_loops(back.graph, back.solver, h.submaps, looked).ledger
        solution = back.finish()
        if id(h.grids) not in pieces:  # hypotheses of one chain share their pieces
            nodes = {s.key: np.asarray(s.times[:-1]) for s in back.graph.submaps}
            pieces[id(h.grids)] = divide_submaps(h.submaps, config=division, grids=h.grids, nodes=nodes)
        divided = pieces[id(h.grids)]
        candidate = MapHypothesis(divided.pieces, divided.along(solution.trajectory()), f"hypothesis {number}")
        facts = h.facts(ledger.counts().get("accepted", 0))
        out.append(Alternative(candidate.name, back.graph, solution, candidate, facts))
    return out
