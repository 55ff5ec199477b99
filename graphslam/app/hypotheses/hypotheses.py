"""Several graphs of one SegMap: what particles disagree on, each optimised, the clearest chosen, the others kept.

Particles that entered different older maps, or none, tell different topologies; and of each entry it may be asked what
the map would be without it, which is the null match that every particle could have drawn. Each is settled into submaps,
made a graph of its own with loops of its own, and only then compared: the entropy of a map sample says more of how its
segments happen to hang together than of which topology is right. SegSLAM's authors take the sample of least entropy;
here the choice is made after optimisation, among those that their own graph does not contradict
(:mod:`graphslam.app.hypotheses.alternatives`, which also has the choice among the matches and loops of a finished run).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from graphslam.app.hypotheses.alternatives import CONTRADICTION, Alternative, Choice, built, choose
from graphslam.backend.config import BackEndConfig
from graphslam.core.errors import ConfigError
from graphslam.core.submap import Submap
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.frontends.grid.filter_drift import FilterDrift
from graphslam.frontends.segslam.config import HandoverConfig
from graphslam.frontends.segslam.result import SegSlamResult
from graphslam.frontends.segslam.segmap import KINDS, MATCH, SegMap
from graphslam.frontends.segslam.submaps import drift_by_path, sampled_chain, settle, settled_chain
from graphslam.graph.pose_graph import PoseGraph
from graphslam.loops.find_loops import FindConfig, find_loops
from graphslam.loops.ledger import LoopLedger
from graphslam.maps.entropy import Clarity
from graphslam.maps.fuse import FusedMap
from graphslam.maps.minimum_entropy import Candidate
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.segslam_evidence import own_evidence_of
from graphslam.maps.submaps import DividedSubmaps, divide_submaps
from graphslam.solve.solution import Solution

if TYPE_CHECKING:
    import pandas as pd

Ints = npt.NDArray[np.int64]
Topology = tuple[tuple[int, int, str, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class HypothesesConfig:
    """Which topologies become graphs, and how they are compared."""

    most: int = 5
    """Hypotheses that are looked at: topologies by weight, then those that withdraw an entry."""
    samples: int = 0
    """Beside them so many map samples, whose segments come from different particles."""
    least_support: float = 0.02
    """Share of the particles' weight below which one is left out."""
    spacing: float = 3.0
    """Between nodes [m]."""
    level_sigma: float = 0.006
    """Of levelled bases, in space [rad]; 0: exits say it."""
    find: FindConfig = field(default_factory=lambda: FindConfig(front_end=True))
    """Loops of each graph; entries of the front end are decided on like all others."""
    division: DivisionConfig = field(default_factory=DivisionConfig)
    """How maps are cut into pieces; give the sensor's reach."""
    withdraw: bool = True
    """Also what would be without each of the first topology's entries, the least supported first."""
    placements: int = 1
    """Ways in which the grid stands when entropies are taken."""
    contradiction: float = CONTRADICTION
    """A graph whose χ² is greater than an honest one's with this probability is no choice while others are."""

    def __post_init__(self) -> None:
        if self.most < 1 or self.placements < 1 or self.samples < 0:
            raise ConfigError(f"hypotheses: most = {self.most}, placements = {self.placements}; wanted at least 1")
        if not 0.0 <= self.least_support <= 1.0 or not 0.0 < self.contradiction < 1.0:
            raise ConfigError("hypotheses: least_support and contradiction are probabilities")


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One topology, optimised.

    Parameters
    ----------
    number : int
        By weight: 0 has most.
    particle : int
        Whose chain speaks for it: the heaviest; -1 of a map sample.
    support : float
        Share of the particles' weight that tells this topology; of one that withdraws an entry, the share that did not
        make it when it was made; of a map sample the share that tells the same.
    withdrawn : (int, int) or None
        Keys of the submaps whose entry is withdrawn.
    chain : (m,) int64
        Segments.
    entries : tuple of (int, int)
        Entries into older maps that its particles made: keys of the submaps entered and of those that entered.
    submaps, graph, solution, ledger
        What was made of it.
    clarity : Clarity
        Of its fused map.
    chi2 : float
        Of its graph, loops without their kernels.
    contradicted : bool
        By that.
    """

    number: int
    particle: int
    support: float
    withdrawn: tuple[int, int] | None
    chain: Ints
    entries: tuple[tuple[int, int], ...]
    submaps: list[Submap]
    graph: PoseGraph
    solution: Solution
    ledger: LoopLedger
    clarity: Clarity
    chi2: float
    contradicted: bool

    @property
    def loops(self) -> int:
        """Loops that its graph holds."""
        return self.ledger.counts().get("accepted", 0)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Topologies of a SegMap, the chosen one first.

    Parameters
    ----------
    order : tuple of Hypothesis
        As they were judged.
    choice : Choice
        The same as alternative graphs.
    left_out : int
        Topologies with too little weight, or beyond the number that was asked for.
    """

    order: tuple[Hypothesis, ...]
    choice: Choice
    left_out: int

    @property
    def best_map(self) -> FusedMap:
        """The map of the chosen one."""
        return self.choice.best_map

    @property
    def best(self) -> Hypothesis:
        """The chosen one."""
        return self.order[0]

    def why(self) -> str:
        """Why the first was chosen, in a sentence."""
        a = self.best
        if len(self.order) == 1:
            return f"all particles that count tell one topology (support {a.support:.2f})"
        b = self.order[1]
        said = f"hypothesis {a.number} before {b.number} (supports {a.support:.2f} and {b.support:.2f})"
        return f"{said}: {self.choice.why()}"

    def table(self) -> pd.DataFrame:
        """One row a hypothesis, the chosen one first."""
        import pandas as pd

        return pd.DataFrame([facts(h) for h in self.order])

    def events(self) -> list[dict[str, Any]]:
        """For a run's ``events.jsonl``: every hypothesis, and which one was chosen and why."""
        chosen = {"event": "hypothesis-chosen", "hypothesis": self.best.number, "why": self.why()}
        rows: list[dict[str, Any]] = [{"event": "hypothesis", **facts(h)} for h in self.order]
        return [*rows, {**chosen, "left_out": self.left_out}]


def facts(h: Hypothesis) -> dict[str, Any]:
    """Figures of a hypothesis, JSON-serialisable."""
    return {
        "hypothesis": h.number,
        "support": round(h.support, 6),
        "withdrawn": None if h.withdrawn is None else list(h.withdrawn),
        "submaps": len(h.submaps),
        "entries": [list(e) for e in h.entries],
        "loops": h.loops,
        "chi2": h.chi2,
        "dof": h.solution.score.dof,
        "contradicted": h.contradicted,
        "entropy": h.clarity.entropy,
        "known_volume": h.clarity.volume,
    }


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
        chain = settled_chain(result.segmap, int(result.closed[p]))
        groups.setdefault(topology(result.segmap, chain), []).append((float(result.weights[p]), p, chain))
    found = [(members[0][1], sum(w for w, *_ in members), members[0][2]) for members in groups.values()]
    return sorted(found, key=lambda x: (-x[1], x[0]))


def find_hypotheses(
    result: SegSlamResult,
    drift: FilterDrift,
    config: HypothesesConfig | None = None,
    *,
    handover: HandoverConfig | None = None,
    model: BeamModel | None = None,
    progress: bool = False,
) -> Hypotheses:
    """Make a graph of every topology that particles tell, optimise each, and choose.

    Parameters
    ----------
    result : SegSlamResult
    drift : FilterDrift
        Of exits.
    config : HypothesesConfig, optional
    handover : HandoverConfig, optional
        How segments become submaps.
    model : BeamModel, optional
        Whose clamp bounds the fused maps.
    progress : bool
        Show a bar.

    Raises
    ------
    GraphSlamError
        Segments that make no submaps, or a graph that cannot be solved.
    """
    c = HypothesesConfig() if config is None else config
    found = topologies(result)
    kept = [x for x in found if x[1] >= c.least_support][: c.most] or found[:1]
    told: list[_Told] = []
    for particle, support, chain in kept:
        submaps = settle(result.segmap, chain, drift_by_path(result.segmap, chain, drift), handover)
        told.append(_Told(particle, support, None, chain, submaps, own_evidence_of(result.segmap, chain, submaps)))
    for chain in _sampled(result, c.samples, [h.chain for h in told]):
        support = sum(w for _, w, other in found if topology(result.segmap, other) == topology(result.segmap, chain))
        submaps = settle(result.segmap, chain, drift_by_path(result.segmap, chain, drift), handover)
        told.append(_Told(-1, support, None, chain, submaps, own_evidence_of(result.segmap, chain, submaps)))
    if c.withdraw:
        told += _withdrawn(told[0])[: c.most - len(kept)]
    alternatives, ledgers = [], []
    pieces: dict[int, DividedSubmaps] = {}
    for number, h in enumerate(tqdm(told, "hypotheses", disable=not progress, leave=False)):
        # what is withdrawn must not come back by registration: that is the other hypothesis
        find = c.find if h.withdrawn is None else replace(c.find, rounds=0, appearance=None)
        graph, solution, ledger = _solved(h.submaps, c, find)
        if id(h.grids) not in pieces:  # hypotheses of one chain share their pieces
            nodes = {s.key: np.asarray(s.times[:-1]) for s in graph.submaps}
            pieces[id(h.grids)] = divide_submaps(h.submaps, config=c.division, grids=h.grids, nodes=nodes)
        divided = pieces[id(h.grids)]
        name = f"hypothesis {number}"
        candidate = Candidate(divided.pieces, divided.along(solution.trajectory()), name)
        alternatives.append(Alternative(name, graph, solution, candidate))
        ledgers.append(ledger)
    choice = choose(alternatives, model=model, placements=c.placements, contradiction=c.contradiction)
    order = []
    for j in choice.order:
        h, a = told[j.number], j.alternative
        order.append(
            Hypothesis(
                j.number, h.particle, h.support, h.withdrawn, h.chain, _entries(h.submaps), h.submaps, a.graph,
                a.solution, ledgers[j.number], j.clarity, j.chi2, j.contradicted,
            )
        )  # fmt: skip
    return Hypotheses(tuple(order), choice, len(found) - len(kept))


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
class _Told:
    """A topology before it is a graph."""

    particle: int
    support: float
    withdrawn: tuple[int, int] | None
    chain: Ints
    submaps: list[Submap]
    grids: dict[int, EvidenceGrid]


def _withdrawn(told: _Told) -> list[_Told]:
    """A topology without each of its entries in turn, the least supported entry first."""
    out = []
    for k, s in enumerate(told.submaps):
        for m in s.matches:
            rest = replace(s, matches=tuple(x for x in s.matches if x is not m))
            submaps = [*told.submaps[:k], rest, *told.submaps[k + 1 :]]
            support = told.support * max(1.0 - m.support, 0.0)
            out.append(_Told(told.particle, support, (m.target, s.key), told.chain, submaps, told.grids))
    return sorted(out, key=lambda x: -x.support)


def _solved(submaps: Sequence[Submap], c: HypothesesConfig, find: FindConfig) -> tuple[PoseGraph, Solution, LoopLedger]:
    # no match is a factor at once: `find_loops` decides on them
    options = BackEndConfig(node_spacing=c.spacing, level_sigma=c.level_sigma, match_support=math.inf)
    back = built(submaps, options)
    back.solver.solve_to_optimum()
    closer = find_loops(back.graph, back.solver, submaps, find)
    return back.graph, back.solver.solution(), closer.ledger


def _entries(submaps: Sequence[Submap]) -> tuple[tuple[int, int], ...]:
    """Of the chain itself, not of particles that tell another topology."""
    return tuple((s.matches[0].target, s.key) for s in submaps if s.report.get("entered") == "match" and s.matches)
