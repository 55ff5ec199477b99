"""Can the covariances of a map be believed, where no truth is known? One word, and what it rests on.

Every test without truth that a run has made is one row of evidence: its statistic, the degrees of freedom that
independent residuals would have, and with these how probable it is that an honest run shows so large or so small a
value. The word follows from all of them together:

- *over-confident* if errors are too large in any of them, or last: alike from one residual to the next, from window to
  window, or as a constant error of calibration. Rows share one level (Bonferroni), so that an honest run is called
  wrong in at most :data:`LEVEL` of the cases however many tests it has;
- *cannot be decided from this log* where the rows could not have seen an error that matters: of motion and sightings,
  and of fixes if any were used, some row must exclude that variances are :data:`DETECTABLE_VARIANCE_RATIO` times as
  large as stated; and where submaps bend by more than :data:`MAX_NONLINEARITY`, so that no Gaussian describes them (all
  rows hold Gaussians);
- *pessimistic* if errors are too small in any of them, and by as much as matters, and none of the above;
- *consistent* else.

Small residuals alone never make a map pessimistic: the first rule comes before the third.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy import special

from graphslam.core.gaussian import chi2_quantile
from graphslam.evaluate.bias_test import BiasTest

Word = Literal["consistent", "over-confident", "pessimistic", "undecided"]
Of = Literal["map", "fixes", "other"]
LEVEL = 0.05
"""Share of honest runs that are called wrong, at most."""
DETECTABLE_VARIANCE_RATIO = 1.5
"""Ratio of true to stated variances that a decision must exclude."""
SURE = 0.975
"""Confidence with which it is excluded."""
MAX_NONLINEARITY = 0.006
"""Squared shift by curvature per unknown, mean over submaps, from which on nothing is promised. In 80 drawn worlds that
were as stated NEES/n of all nodes was 1.06 on average below 0.001, 1.20 from there to 0.006, and 1.37 above."""
LEAST_DOF = 4.0
"""Fewer degrees of freedom are no evidence."""


@dataclass(frozen=True, slots=True)
class ConsistencyTest:
    """One test without truth.

    Parameters
    ----------
    name : str
        What is said of it: “χ² of gps”.
    of : "map", "fixes" or "other"
        What it covers: motion and sightings, fixes, or something else that a decision need not rest on.
    value : float
        1 if stated noise is right.
    dof : float
        Of independent residuals.
    too_large, too_small : float
        Probability that an honest run shows at least, or at most, this value.
    lasting : bool
        It looks for errors that last, not for their size.
    """

    name: str
    of: Of
    value: float
    dof: float
    too_large: float
    too_small: float
    lasting: bool = False

    @property
    def upper(self) -> float:
        """Ratio of true to stated variances that is still possible."""
        return self.value * self.dof / max(chi2_quantile(1.0 - SURE, self.dof), 1e-12)


def chi_square_ratio_test(name: str, of: Of, value: float, dof: float) -> list[ConsistencyTest]:
    """A statistic χ²/dof; none where it has hardly any degrees of freedom."""
    if not (np.isfinite(value) and np.isfinite(dof) and dof >= LEAST_DOF):
        return []
    chi2 = value * dof
    large, small = float(special.chdtrc(dof, chi2)), float(special.chdtr(dof, chi2))
    return [ConsistencyTest(name, of, float(value), float(dof), large, small)]


def largest_score_test(name: str, of: Of, score: float, *, tests: int = 1) -> ConsistencyTest:
    """A score that is N(0, 1) if nothing lasts, the largest of so many."""
    p = min(1.0, tests * float(special.ndtr(-score)))
    return ConsistencyTest(name, of, float(score), 1.0, p, 1.0, lasting=True)


def short_window_tests(found: BiasTest | None) -> list[ConsistencyTest]:
    """What the short windows of landmark front ends say: of the size of all noise, of lasting errors and of drifts."""
    if found is None:
        return []
    out = chi_square_ratio_test("χ² of odometry and observations in short windows", "map", found.ratio, found.dof)
    p = len(found.taken)
    out.append(largest_score_test("calibration errors", "map", float(np.sqrt(found.taken.max())), tests=2 * p))
    drifts = [
        chi_square_ratio_test("time-correlated errors within windows", "map", v, d)
        for v, d in zip(found.drift, found.drift_dof)
    ]
    worst = min((e[0] for e in drifts if e), key=lambda e: e.too_large, default=None)
    if worst is not None:
        chance = min(1.0, p * worst.too_large)
        out.append(ConsistencyTest(worst.name, "map", worst.value, worst.dof, chance, 1.0, lasting=True))
    return out


@dataclass(frozen=True, slots=True)
class CovarianceAssessment:
    """The word, and what it rests on.

    Parameters
    ----------
    word : str
    speaking : tuple of ConsistencyTest
        Rows that decided it: those that are too large or too small; for the other words those that cover it.
    chance : float
        Probability that an honest run has a row like the worst, all rows counted.
    missing : tuple of str
        What nothing in this log could have seen.
    bent : bool
        Submaps are no Gaussians.
    """

    word: Word
    speaking: tuple[ConsistencyTest, ...]
    chance: float
    missing: tuple[str, ...] = ()
    bent: bool = False


def assess_covariances(
    rows: Sequence[ConsistencyTest], *, fixes: bool, nonlinearity: float = 0.0
) -> CovarianceAssessment:
    """The word on all rows.

    Parameters
    ----------
    fixes : bool
        Fixes are in the graph: a decision must rest on a row of them, too.
    nonlinearity : float
        See :func:`pooled_nonlinearity`; of submaps that are not smoothed nothing is known, and it is 0.
    """
    m = max(1, sum(1 if r.lasting else 2 for r in rows))
    large = sorted((r for r in rows if m * r.too_large < LEVEL), key=lambda r: r.too_large)
    if large:
        return CovarianceAssessment("over-confident", tuple(large), min(1.0, m * large[0].too_large))
    wanted: dict[Of, str] = {"map": "odometry and observations"}
    if fixes:
        wanted["fixes"] = "fixes"
    covers = {
        of: [r for r in rows if r.of == of and not r.lasting and r.upper <= DETECTABLE_VARIANCE_RATIO] for of in wanted
    }
    missing = tuple(what for of, what in wanted.items() if not covers[of])
    bent = nonlinearity > MAX_NONLINEARITY
    if missing or bent:
        return CovarianceAssessment(
            "undecided", tuple(r for found in covers.values() for r in found), 1.0, missing, bent
        )
    small = [r for r in rows if m * r.too_small < LEVEL and r.value < 1.0 / DETECTABLE_VARIANCE_RATIO]
    small.sort(key=lambda r: r.too_small)
    if small:
        return CovarianceAssessment("pessimistic", tuple(small), min(1.0, m * small[0].too_small))
    return CovarianceAssessment("consistent", tuple(r for found in covers.values() for r in found), 1.0)


def pooled_nonlinearity(reports: Sequence[Mapping[str, Any]]) -> float:
    """Squared shift by which curvature moves the optima of submaps from their means, per unknown.

    See :meth:`graphslam_frontends.landmarks.summarise.SmoothingResult.nonlinearity`; 0 where no submap's report says
    it.
    """
    said = [(float(r["nonlinearity"]), float(r["unknowns"])) for r in reports if "nonlinearity" in r]
    return sum(v * n for v, n in said) / sum(n for _, n in said) if said else 0.0


def consistency_tests_of_json(value: Any) -> list[ConsistencyTest]:
    """Rows as a report holds them; what is none of ours is left out."""
    out = []
    for row in value if isinstance(value, list) else []:
        if isinstance(row, Mapping) and set(row) == set(ConsistencyTest.__slots__):
            numbers = [row[k] for k in ("value", "dof", "too_large", "too_small")]
            if all(isinstance(v, (int, float)) for v in numbers) and row["of"] in ("map", "fixes", "other"):
                out.append(ConsistencyTest(**row))
    return out


def consistency_tests_as_json(rows: Iterable[ConsistencyTest]) -> list[dict[str, Any]]:
    """The same as JSON objects."""
    return [asdict(r) for r in rows]
