"""Acceptance of matches (A9): gates, weights, and a draw that always includes "no match".

A false match is far more harmful than a missed one, and later stages cannot repair it, so the gates are strict. Matches
that pass are sampled: particles represent several topologies, and those with a wrong one lose their weight
later.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.registration import gates
from graphslam.registration.config import RegistrationConfig
from graphslam.registration.gates import failed_match_gates, height_between, shift_between, tilt_between
from graphslam.registration.register import Registration
from graphslam_frontends.segslam.config import ChoiceConfig
from graphslam_frontends.segslam.localisation import ScanLocalisation
from graphslam_frontends.segslam.segmap import MATCH, SegmentEntry

NULL = -1
"""Result of a draw without a match."""
MODE_DISTANCE = 1.5
"""Poses farther apart than this are two modes of a match [m]."""
FITNESS_SIGMA = 0.15
"""Weight of the fitness of a match: ``exp(-½ ((1 - fitness) / this)²)``."""
ERROR_SIGMA = 0.4
"""Weight of the range error of localisation [m], in the same way."""
SPREAD_SIGMA = 0.3
"""Weight of the spread of localisation [m], in the same way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """One registration of the look-ahead window of a particle to an older map.

    Parameters
    ----------
    segment : int
        The older segment.
    registration : Registration
        ``T_map_body`` with its quality.
    T_prior : (7,) or (3,)
        Predicted pose of the body in that map, from the map sample.
    sigma : float
        σ of the path-length model for that place [m].
    rise : float
        Allowed height drift over the path from there to the body [m].
    localisation : ScanLocalisation or None
        Result of the temporary particle filter.
    """

    segment: int
    registration: Registration
    T_prior: Array
    sigma: float
    rise: float = 0.0
    localisation: ScanLocalisation | None = None

    @property
    def T(self) -> Array:
        """The match, ``T_map_body``; that of the localisation if there is one."""
        return self.registration.T_target_source if self.localisation is None else self.localisation.pose

    @property
    def fitness(self) -> float:
        """Share of the points it explains."""
        return self.registration.best_fitness

    @property
    def shift(self) -> float:
        """Horizontal distance from the prediction to the match [m]."""
        return shift_between(self.T, self.T_prior)

    @property
    def height(self) -> float:
        """Vertical distance from the prediction to the match [m]; 0 in 2-D."""
        return height_between(self.T, self.T_prior)

    @property
    def tilt(self) -> float:
        """Angle between the verticals of match and prediction [rad]; 0 in 2-D."""
        return tilt_between(self.T, self.T_prior)


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchPosterior:
    """Gates and weights of the proposals of one particle.

    Parameters
    ----------
    proposals : tuple of m Proposal
    why : tuple of m str
        The gates each fails, as text; empty for those that may be drawn.
    weights : (m,)
        Unnormalised (eq. 18, 19); 0 of those that fail.
    margins : (m,)
        Fitness minus that of the best other mode in the same map; 1 if there is none.
    null : float
        Weight of "no match".
    """

    proposals: tuple[Proposal, ...]
    why: tuple[str, ...]
    weights: Array
    margins: Array
    null: float

    @property
    def accepted(self) -> npt.NDArray[np.int64]:
        """Indices of those that may be drawn."""
        return np.flatnonzero(self.weights > 0).astype(np.int64)

    @property
    def probabilities(self) -> Array:
        """Of the proposals, and last of "no match" ``(m + 1,)``."""
        p = np.append(self.weights, self.null)
        return np.asarray(p / p.sum())

    def counts(self) -> dict[str, int]:
        """Number of proposals that failed each gate (one may fail several), and number accepted."""
        names = Counter(t.split()[0].rstrip(":") for text in self.why for t in text.split("; ") if t)
        return {**dict(sorted(names.items())), "accepted": len(self.accepted)}

    def draw(self, uniform: float) -> int:
        """The proposal for a uniform number in [0, 1), or `NULL`."""
        k = int(np.searchsorted(np.cumsum(self.probabilities), uniform, side="right"))
        # rounding of the sum must not choose a proposal of zero weight
        return k if k < len(self.proposals) and self.weights[k] > 0 else NULL

    def entry(self, k: int, config: ChoiceConfig) -> SegmentEntry:
        """Entry into the older segment for proposal ``k``."""
        p = self.proposals[k]
        return SegmentEntry(
            T_entry=p.T,
            kind=MATCH,
            source=p.segment,
            covariance=match_covariance(p, config),
            fitness=p.fitness,
        )


def match_posterior(
    proposals: Sequence[Proposal], config: ChoiceConfig, registration: RegistrationConfig | None = None
) -> MatchPosterior:
    """Gate and weight the proposals of one particle at one time (A9).

    Gates: those of the registration (fitness, degeneracy, tilt), a finite result, height and shift relative to the
    prediction, and a margin to the second mode in the same map, whether that passes its own gates or not. Weights:
    ``exp(-½ ((1 - fitness)/σ_f)²) exp(-½ (shift/σ)²)``, σ of the path-length model (eq. 18); with a localisation
    ``exp(-½ err_X/σ_e²) exp(-½ |Σ_X|/σ_s²)`` instead of, or in addition to, the fitness (eq. 19).

    Parameters
    ----------
    registration : RegistrationConfig, optional
        Its gates are used; default the standard ones.
    """
    rules = RegistrationConfig() if registration is None else registration
    margins = proposal_margins(proposals, MODE_DISTANCE)
    why, weights = [], np.zeros(len(proposals))
    for k, p in enumerate(proposals):
        fails = _fails(p, float(margins[k]), config, rules)
        why.append("; ".join(fails))
        if not fails:
            weights[k] = math.exp(_log_weight(p, config))
    return MatchPosterior(
        proposals=tuple(proposals), why=tuple(why), weights=weights, margins=margins, null=config.null_weight
    )


def proposal_margins(proposals: Sequence[Proposal], apart: float) -> Array:
    """Fitness of each proposal minus that of the best one in the same map ``apart`` [m] or more away ``(m,)``; see
    :func:`graphslam.registration.gates.match_margins`."""
    return gates.match_margins([p.registration for p in proposals], [p.segment for p in proposals], apart)


def match_covariance(p: Proposal, config: ChoiceConfig) -> Array:
    """Covariance of ``T_map_body`` of a match ``(d, d)``, right tangent: its own plus configured floors."""
    g = group_of(p.T)
    floor = np.full(g.dof, config.angle_sigma**2)
    floor[g.position] = config.position_sigma**2
    own = p.registration.covariance if p.localisation is None else p.localisation.covariance
    return np.asarray(own + np.diag(floor))


def _fails(p: Proposal, margin: float, c: ChoiceConfig, rules: RegistrationConfig) -> list[str]:
    found = replace(p.registration, T_target_source=p.T)
    vague = p.localisation is None
    fails = failed_match_gates(found, p.T_prior, c, rules, sigma=p.sigma, margin=margin, rise=p.rise, ask_vague=vague)
    if fails and fails[0].startswith("nothing"):
        return fails
    if c.method != "registration" and p.localisation is None:
        fails.append("localisation: there is none")
    return fails


def _log_weight(p: Proposal, c: ChoiceConfig) -> float:
    total = -0.5 * (p.shift / p.sigma) ** 2  # p(‖τ_m‖²)
    if c.method != "localisation":
        total += -0.5 * ((1.0 - p.fitness) / FITNESS_SIGMA) ** 2  # p(err_ICP | T_m), eq. 18
    if c.method != "registration" and p.localisation is not None:
        total += -0.5 * p.localisation.error / ERROR_SIGMA**2  # p(err_X), eq. 19
        total += -0.5 * (p.localisation.spread / SPREAD_SIGMA) ** 2  # p(|Σ_X|)
    return total
