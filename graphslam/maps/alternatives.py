"""Selection among alternative graphs of one log, each at its optimum: least map entropy among those that pass a χ²
test.

SegSLAM selects the map sample of least entropy. Here each alternative is optimised first, because an unsolved sample is
blurred by errors that its graph would remove. The χ² test has priority over the entropy: a map that is folded onto
itself has less known volume, and therefore less entropy.
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

CONSTRAINTS = ("match", "loop", "overlap")
"""Classes of factors that close loops."""


CONTRADICTION = 1e-4
"""A graph is contradicted if a χ² at least this large has a smaller probability than this."""


MANY = 5
"""Least number of submap pairs with loop constraints for an estimate of the noise scale …"""


KEPT = 0.75
"""… from the alternatives that keep at least this share of the largest number of pairs."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """A solved graph and its map pieces with poses.

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
    def links(self) -> int:
        """Number of submap pairs with matches or loops; several constraints of one pair count once."""
        submap = {n: k for k, s in enumerate(self.graph.submaps) for n in s.nodes[:-1]}
        links = [r for r in self.graph.records.values() if r.group in CONSTRAINTS and isinstance(r, BetweenRecord)]
        last = len(self.graph.submaps) - 1  # the last exit has its own node
        return len({frozenset((submap.get(r.i, last), submap.get(r.j, last))) for r in links})


@dataclass(frozen=True, eq=False)
class ScoredMap:
    """Metrics of an alternative.

    Parameters
    ----------
    number : int
        Index of the alternative in the input.
    chi2, dof : float, int
        Of its graph; matches and loops without robust kernels, which would hide a false one.
    contradicted : bool
        Whether that χ² is too large (:data:`CONTRADICTION`).
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
        """χ²/dof; NaN without redundancy."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class RankedAlternatives:
    """Alternatives, the chosen one first.

    Parameters
    ----------
    order : tuple of ScoredMap
        Those that pass the χ² test, by entropy; then the others by χ²/dof, smallest first.
    best_map : FusedMap
        Fused map of the first.
    scale : float
        Variance factor by which every χ² was divided (:func:`noise_scale`).
    """

    order: tuple[ScoredMap, ...]
    best_map: FusedMap
    scale: float = 1.0

    @property
    def best(self) -> ScoredMap:
        """The chosen one."""
        return self.order[0]

    def why(self) -> str:
        """Reason for the choice, one sentence."""
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
        """One row per alternative, the chosen one first; JSON-serialisable."""
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
    """Rank alternatives by the χ² of their graphs, then by the entropy of their maps.

    Parameters
    ----------
    alternatives : sequence of Alternative
        Of the same submaps, or of the same log.
    model : BeamModel, optional
        Its clamp limits the log-odds of the fused maps.
    """
    if not alternatives:
        raise DataError("there are no graphs to choose from", wanted="one at least")
    candidates = [a.candidate for a in alternatives]
    ranking = rank_by_entropy(candidates, model=model, progress=progress)
    clarity = {r.index: r.clarity for r in ranking.order}
    fits = [(chi2_of(a.graph), a.solution.score.dof) for a in alternatives]
    scale = noise_scale([a.links for a in alternatives], fits)
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
    """χ² of a graph at its current values, with matches and loops without robust kernels."""
    score = graph.objective()
    blocks = graph.flat().factor_blocks(graph.values)
    bare = sum(float(d2) for r, d2 in zip(blocks.records, blocks.d2) if r.group in CONSTRAINTS)
    return score.total + bare - sum(score[g].chi2 for g in CONSTRAINTS if g in score)


def noise_scale(counts: Sequence[int], fits: Sequence[tuple[float, int]]) -> float:
    """Common variance factor of the graphs, at least 1: the odometry chain of a recorded log can be overconfident.

    Parameters
    ----------
    counts : sequence of int
        Number of submap pairs with loop constraints, per alternative.
    fits : sequence of (float, int)
        χ² and degrees of freedom.

    Notes ----- With fewer than :data:`MANY` pairs a false loop cannot be distinguished from an overconfident chain; the
    scale is 1. Otherwise it is the least χ²/dof of the alternatives that keep :data:`KEPT` of the pairs: a false loop
    increases χ² only in the alternatives that contain it.
    """
    most = max(counts)
    if most < MANY:
        return 1.0
    return max(1.0, min(chi2 / dof for n, (chi2, dof) in zip(counts, fits) if n >= KEPT * most and dof > 0))


def _contradiction(j: ScoredMap) -> str:
    return f"contradicted by its own graph (χ² {j.chi2:.1f} of {j.dof})"


def _dimmer(j: ScoredMap, best: ScoredMap) -> str:
    if best.contradicted:
        return _contradiction(j)
    return f"entropy {j.clarity.entropy - best.clarity.entropy:+.1f} nat m³"
