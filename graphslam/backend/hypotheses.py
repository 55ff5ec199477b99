"""Alternative graphs of one log: topologies of SegSLAM's particles, and choices of a run's matches and loops.

Each becomes a graph; only solved graphs are compared (:mod:`graphslam.maps.alternatives`), because the entropy of a map
sample depends more on errors between its segments than on its topology. The authors of SegSLAM use the sample of lowest
entropy.
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
from graphslam.loops.candidates import OVERLAP
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
        Fixes that become factors.
    imu, control : ImuSource, ControlTable, optional
        For this graph only; control rows are added when the graph is finished.
    """
    back = BackEnd(config, "batch", imu=imu, control=control)
    if fixes is not None:
        back.add_gps(fixes, GpsOptions() if gps is None else gps)
    for s in submaps:
        if fixes is None:
            back.append(s)
        else:  # the start of GPS depends on the solved graph at that time
            back.add(s)
    return back


LEAST_SUPPORT = 0.02
"""Topologies with a smaller share of the particles' weight are not used."""
LOOP = -1
"""Used in place of a submap key; the second number is then that of a loop."""


Chosen = frozenset[tuple[int, int]]
"""Matches as (key of the submap, index among its matches), searched loops as (LOOP, number)."""


def choices_of_matches(
    submaps: Sequence[Submap],
    support: float,
    *,
    loops: Sequence[LoopDecision] = (),
    undone: frozenset[tuple[int, int]] = frozenset(),
) -> dict[str, Chosen]:
    """Choices by name: the run's own, every threshold of support, and the run's own without each match and loop.

    Parameters
    ----------
    support : float
        The run's own threshold (``backend.match_support``).
    loops : sequence of LoopDecision
        Accepted loops of the run's ledger that are not front-end matches.
    undone : frozenset of (int, int)
        Matches that are not in the run's graph, rejected or undone: keys of the submap and of the one that it entered.
    """
    every = {(s.key, i): m for s in submaps for i, m in enumerate(s.matches)}
    found_loops: Chosen = frozenset((LOOP, d.loop) for d in loops)
    matches: Chosen = frozenset(k for k, m in every.items() if m.support >= support and (k[0], m.target) not in undone)
    own = matches | found_loops
    found: dict[str, Chosen] = {"as the run": own, "no match or loop" if loops else "no match": frozenset()}
    found["matches alone"] = matches
    for least in sorted({m.support for m in every.values()}, reverse=True):
        at_least: Chosen = frozenset(k for k, m in every.items() if m.support >= least)
        found[f"support ≥ {least:.2g}"] = at_least | found_loops
    for key, i in sorted(matches):
        found[f"without {key} → {every[key, i].target}"] = own - {(key, i)}
    alone = [d for d in loops if d.source != OVERLAP]
    for d in sorted(alone, key=lambda x: -x.chi2 if math.isfinite(x.chi2) else 0.0):  # largest χ² first
        found[f"without loop {d.loop} ({d.submap_j} → {d.submap_i})"] = own - {(LOOP, d.loop)}
    needs = {(LOOP, d.loop): overlap_entries(d.gates) for d in loops}
    out: dict[str, Chosen] = {}
    for name, chosen in found.items():
        entries = {(every[k].target, k[0]) for k in chosen if k in every}
        kept = frozenset(k for k in chosen if needs.get(k, set()) <= entries)  # no overlap constraint without its match
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
        With their measurements; chosen ones become factors as in the run.
    decided : sequence of LoopDecision
        Front-end matches that the run decided on together with loops; if chosen, they are added like loops.
    **streams
        ``fixes``, ``gps``, ``imu`` and ``control`` of :func:`build_back_end`.
    """
    bare = []
    # two matches of one pair of submaps are distinguished by their support
    as_loops = {(d.submap_j, d.submap_i, round(d.score, 9)): d for d in decided}
    used = [d for d in loops if (LOOP, d.loop) in chosen]
    for s in submaps:
        kept: list[Match] = []
        for m in (m for i, m in enumerate(s.matches) if (s.key, i) in chosen):
            loop = as_loops.get((s.key, m.target, round(m.support, 9)))
            if loop is None:
                kept.append(m)
            else:
                used.append(loop)
        bare.append(replace(s, matches=tuple(kept), grid=None))
    back = build_back_end(bare, replace(config, match_support=0.0, loops=False), **streams)
    back.solver.solve_to_optimum()
    if used:
        graph = GraphLoops(back.graph, back.solver)
        for d in used:
            C = np.array(d.covariance)
            measured = Loop(i=d.i, j=d.j, T_ij=np.array(d.T_ij), covariance=C, source=d.source)
            graph.add_loop(measured, LoopConfig().robust(len(C)))
    return back


Ints = npt.NDArray[np.int64]


Topology = tuple[tuple[int, int, str, int], ...]


def topology(segmap: SegMap, chain: Sequence[int] | Ints) -> Topology:
    """Topology of a chain of segments: intervals, how each segment was entered, and which map was entered.

    Segments of different particles are the same if these are equal; for an entry into an older map the start of that
    map counts.
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
    """Different topologies of the particles: heaviest particle, support and chain of each; sorted by support."""
    groups: dict[Topology, list[tuple[float, int, Ints]]] = {}
    for p in np.argsort(-result.weights, kind="stable").tolist():
        chain = common_ancestor_chain(result.segmap, int(result.closed[p]))
        groups.setdefault(topology(result.segmap, chain), []).append((float(result.weights[p]), p, chain))
    found = [(members[0][1], sum(w for w, *_ in members), members[0][2]) for members in groups.values()]
    return sorted(found, key=lambda x: (-x[1], x[0]))


def _sampled(result: SegSlamResult, count: int, known: Sequence[Ints]) -> list[Ints]:
    """Chains of map samples that differ from each other and from the known ones."""
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
    """A topology of the particles, as submaps.

    Parameters
    ----------
    particle : int
        Heaviest particle with this topology; -1 for a map sample.
    support : float
        Share of the particles' weight with this topology; for a withdrawn entry times the share that did not make it;
        for a map sample the share with the same topology.
    withdrawn : (int, int) or None
        Keys of the submaps whose entry is withdrawn.
    chain : (m,) int64
        Segments.
    grids : dict of int to EvidenceGrid
        By submap key, only its own observations.
    """

    particle: int
    support: float
    withdrawn: tuple[int, int] | None
    chain: Ints
    submaps: list[Submap]
    grids: dict[int, EvidenceGrid]

    @property
    def entries(self) -> list[tuple[int, int]]:
        """Entries into older maps in its chain: keys of the entered submap and of the entering one."""
        return [(s.matches[0].target, s.key) for s in self.submaps if s.report.get("entered") == "match" and s.matches]

    def facts(self, loops: int) -> dict[str, Any]:
        """Facts for the report besides the values of its graph."""
        return {
            "support": round(self.support, 6),
            "withdrawn": None if self.withdrawn is None else list(self.withdrawn),
            "submaps": len(self.submaps),
            "entries": [list(e) for e in self.entries],
            "loops": loops,
        }


def _withdrawn(h: TopologyHypothesis) -> list[TopologyHypothesis]:
    """A topology without each of its entries in turn, the least supported entry first."""
    out = []
    for k, s in enumerate(h.submaps):
        for m in s.matches:
            rest = replace(s, matches=tuple(x for x in s.matches if x is not m))
            submaps = [*h.submaps[:k], rest, *h.submaps[k + 1 :]]
            support = h.support * max(1.0 - m.support, 0.0)
            out.append(TopologyHypothesis(h.particle, support, (m.target, s.key), h.chain, submaps, h.grids))
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
    """Topologies of a SegMap: those of the particles, by weight, then the first one without each of its entries.

    Particles that entered different older maps, or none, have different topologies. The map without an entry is that of
    the null match, which every particle could have sampled.

    Parameters
    ----------
    most : int
        Largest number of hypotheses, at least one; map samples are added to it.
    drift : FilterDrift
        Of end poses.
    handover : HandoverConfig, optional
        Options for converting segments to submaps.
    samples : int
        Number of map samples to add, whose segments come from different particles.
    least_support : float
        Topologies with a smaller share of the particles' weight are not used.

    Returns
    -------
    hypotheses : list of TopologyHypothesis
    left_out : int
        Number of topologies with too little weight, or beyond the requested number.
    """
    if most < 1:
        raise ConfigError(f"number of hypotheses = {most}; wanted at least 1")
    segmap, found = result.segmap, topologies(result)
    kept = [x for x in found if x[1] >= least_support][:most] or found[:1]
    chains = [(p, support, chain) for p, support, chain in kept]
    for chain in _sampled(result, samples, [chain for *_, chain in kept]):
        chains.append((-1, sum(w for _, w, c in found if topology(segmap, c) == topology(segmap, chain)), chain))
    hypotheses = []
    for particle, support, chain in chains:
        submaps = submaps_of_segments(
            segmap, chain, drift_by_path(segmap, chain, drift, result.steps), handover, uses=result.steps.uses
        )
        hypotheses.append(
            TopologyHypothesis(particle, support, None, chain, submaps, own_evidence_of(segmap, chain, submaps))
        )
    return [*hypotheses, *_withdrawn(hypotheses[0])[: most - len(kept)]], len(found) - len(kept)


def solve_hypotheses(
    hypotheses: Sequence[TopologyHypothesis],
    config: BackEndConfig,
    *,
    find: FindConfig | None = None,
    division: DivisionConfig | None = None,
    streams: Callable[[], Mapping[str, Any]] = dict,
    progress: bool = False,
) -> list[Alternative]:
    """Solve a graph of each topology with its own loops; entries are decided on like all other loops.

    Parameters
    ----------
    config : BackEndConfig
        Of the run: its nodes, attitude factors and covariance scale are used.
    find : FindConfig, optional
        Options of the loop search.
    division : DivisionConfig, optional
        Options for cutting maps into pieces; set the sensor's maximum range.
    streams : callable
        Returns ``fixes``, ``gps``, ``imu`` and ``control`` for a new graph; see :func:`build_back_end`.
    progress : bool
        Show a bar.
    """
    find = find_config(config) if find is None else find
    # no match is a factor at first: `find_loops` decides on them
    options = replace(config, match_support=math.inf, loops=False)
    pieces: dict[int, DividedSubmaps] = {}
    out = []
    for number, h in enumerate(Bar(hypotheses, "hypotheses", shown=progress)):
        back = build_back_end(h.submaps, options, **streams())
        back.solver.solve_to_optimum()
        # a withdrawn entry must not be found again by registration: that is the other hypothesis
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
