"""Alternative graphs of one log, each at its optimum: the clearest of those that nothing contradicts is chosen.

SegSLAM's authors take the map sample of least entropy. Here each alternative is optimised first, for an unsolved sample
is blurred by errors that its graph would have removed. The χ² of its graph comes before the entropy of its map: a map
that is folded onto itself knows less, and has less entropy for that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from scipy import special

from graphslam.core.errors import DataError
from graphslam.evidence.beams import BeamModel
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.maps.entropy import MapEntropy
from graphslam.maps.fuse import FusedMap
from graphslam.maps.minimum_entropy import MapHypothesis, rank_by_entropy
from graphslam.solve.solution import Solution

TIES = ("match", "loop", "tie")
"""Classes of factors that close loops."""


CONTRADICTION = 1e-4
"""A graph whose χ² is greater than an honest one's with this probability contradicts itself."""


MANY = 5
"""With so many pairs of submaps tied the noise of the chain can be told from a wrong tie …"""


KEPT = 0.75
"""… by the alternatives that keep this share of them: most are taken to be right."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """One graph, solved, and where it has the pieces of the map.

    Parameters
    ----------
    graph : FactorGraph
        At its solution.
    facts : mapping of str
        Further facts, JSON-serialisable.
    """

    name: str
    graph: FactorGraph
    solution: Solution
    candidate: MapHypothesis
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ties(self) -> int:
        """Pairs of submaps that matches and loops tie: constraints of one pair are accepted or rejected together."""
        submap = {n: k for k, s in enumerate(self.graph.submaps) for n in s.nodes[:-1]}
        tied = [r for r in self.graph.records.values() if r.group in TIES and isinstance(r, BetweenRecord)]
        last = len(self.graph.submaps) - 1  # whose exit is a node of its own
        return len({frozenset((submap.get(r.i, last), submap.get(r.j, last))) for r in tied})


@dataclass(frozen=True, eq=False)
class ScoredMap:
    """An alternative's figures.

    Parameters
    ----------
    number : int
        Of the alternative as given.
    chi2, dof : float, int
        Of its graph; of matches and loops without their kernels, under which a wrong one hardly counts.
    contradicted : bool
        By that χ².
    clarity : MapEntropy
        Of its fused map.
    """

    number: int
    alternative: Alternative
    chi2: float
    dof: int
    contradicted: bool
    clarity: MapEntropy

    @property
    def chi2_per_dof(self) -> float:
        """NaN where nothing is redundant."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class RankedAlternatives:
    """Alternatives, the chosen one first.

    Parameters
    ----------
    order : tuple of ScoredMap
        Those that nothing contradicts, by entropy; then the others, the least contradicted first.
    best_map : FusedMap
        Of the first.
    scale : float
        Variance of the chain by which every χ² was divided: 1, or what most ties say.
    """

    order: tuple[ScoredMap, ...]
    best_map: FusedMap
    scale: float = 1.0

    @property
    def best(self) -> ScoredMap:
        """The chosen one."""
        return self.order[0]

    def why(self) -> str:
        """Why the first was chosen, in a sentence."""
        a = self.best
        if len(self.order) == 1:
            return f"{a.alternative.name} is the only one"
        b = self.order[1]
        if a.contradicted:
            return (
                f"every graph contradicts itself, {a.alternative.name} least (χ²/dof {a.chi2_per_dof:.2f}, "
                f"{b.alternative.name} {b.chi2_per_dof:.2f})"
            )
        if b.contradicted:
            return f"{b.alternative.name} is {_contradiction(b)}"
        return (
            f"{a.alternative.name} has an entropy of {a.clarity.entropy:.1f} nat m³, the next one "
            f"({b.alternative.name}) {b.clarity.entropy:.1f}"
        )

    def rows(self) -> list[dict[str, Any]]:
        """One row an alternative, the chosen one first; JSON-serialisable."""
        out = []
        for k, j in enumerate(self.order):
            why = self.why() if k == 0 else _contradiction(j) if j.contradicted else _dimmer(j, self.best)
            out.append(
                {
                    "verdict": "runner-up" if k else "chosen",
                    "choice": j.alternative.name,
                    "objective": j.alternative.solution.objective,
                    "chi2": j.chi2,
                    "dof": j.dof,
                    "chi2_per_dof": j.chi2_per_dof,
                    "contradicted": j.contradicted,
                    "entropy": j.clarity.entropy,
                    "known_volume": j.clarity.volume,
                    **j.alternative.facts,
                    "why": why,
                }
            )
        return out


def rank_alternatives(
    alternatives: Sequence[Alternative],
    *,
    model: BeamModel | None = None,
    progress: bool = False,
) -> RankedAlternatives:
    """Judge alternatives: by the χ² of their graphs, then by the entropy of their maps.

    Parameters
    ----------
    alternatives : sequence of Alternative
        Of the same submaps, or of the same log.
    model : BeamModel, optional
        Whose clamp bounds the fused maps.
    """
    if not alternatives:
        raise DataError("there are no graphs to choose from", wanted="one at least")
    candidates = [a.candidate for a in alternatives]
    ranking = rank_by_entropy(candidates, model=model, progress=progress)
    clarity = {r.index: r.clarity for r in ranking.order}
    fits = [(chi2_of(a.graph), a.solution.score.dof) for a in alternatives]
    scale = noise_scale([a.ties for a in alternatives], fits)
    judged = [
        ScoredMap(k, a, chi2, dof, dof > 0 and float(special.chdtrc(dof, chi2 / scale)) < CONTRADICTION, clarity[k])
        for k, (a, (chi2, dof)) in enumerate(zip(alternatives, fits))
    ]
    order = sorted(judged, key=lambda j: (j.contradicted, j.chi2_per_dof if j.contradicted else 0.0,
                                          j.clarity.entropy, j.number))  # fmt: skip
    best = ranking.best
    if order[0].number != ranking.order[0].index:
        best = rank_by_entropy([candidates[order[0].number]], model=model).best
    return RankedAlternatives(tuple(order), best, scale)


def chi2_of(graph: FactorGraph) -> float:
    """χ² of a graph where it is, with matches and loops as if they had no kernel."""
    score = graph.objective()
    blocks = graph.flat().factor_blocks(graph.values)
    bare = sum(float(d2) for r, d2 in zip(blocks.records, blocks.d2) if r.group in TIES)
    return score.total + bare - sum(score[g].chi2 for g in TIES if g in score)


def noise_scale(ties: Sequence[int], fits: Sequence[tuple[float, int]]) -> float:
    """Variance of what most ties have in common, at least 1: the chain of a recorded log may overstate what it knows.

    Parameters
    ----------
    ties : sequence of int
        Pairs of submaps that are tied, of each alternative.
    fits : sequence of (float, int)
        χ² and degrees of freedom.

    Notes
    -----
    With less than :data:`MANY` ties a wrong one cannot be told from a chain that is worse than it says, and the scale
    is 1. Else it is the least χ²/dof of the alternatives that keep :data:`KEPT` of the ties: one that is wrong makes
    those worse that hold it, not the one without.
    """
    most = max(ties)
    if most < MANY:
        return 1.0
    return max(1.0, min(chi2 / dof for n, (chi2, dof) in zip(ties, fits) if n >= KEPT * most and dof > 0))


def _contradiction(j: ScoredMap) -> str:
    return f"contradicted by its own graph (χ² {j.chi2:.1f} of {j.dof})"


def _dimmer(j: ScoredMap, best: ScoredMap) -> str:
    if best.contradicted:
        return _contradiction(j)
    return f"entropy {j.clarity.entropy - best.clarity.entropy:+.1f} nat m³"
