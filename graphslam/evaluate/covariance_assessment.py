"""Are the covariances of a map consistent, where no ground truth is known? One word, and the tests behind it.

Each test that a run has made without ground truth is a `ConsistencyTest`: a statistic, its degrees of freedom, and the
probability that a consistent run shows so large or so small a value. One word follows from all tests together:

- *overconfident*: errors are too large in a test, by more than :data:`TOLERANCE` allows, or they are correlated: from
  one residual to the next, from window to window, or as a constant calibration error. The tests share one significance
  level (Bonferroni): a consistent run is called overconfident in at most :data:`LEVEL` of the cases;
- *not tested*: no test of motion and observations, or none of the fixes if the graph has any, had the power
  :data:`LEAST_POWER` to show covariances that are half as large as they should be, or could exclude variances that are
  :data:`DETECTABLE_VARIANCE_RATIO` times as large as stated; or the posteriors of submaps are not Gaussian
  (:data:`MAX_NONLINEARITY`), which all tests assume;
- *conservative*: errors are too small in a test, by as much as matters, and none of the above;
- *consistent*: otherwise.

Small residuals alone never make a map conservative, because a map follows errors that are correlated: the first rule
comes before the third.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy import special

from graphslam.core.gaussian import chi2_quantile
from graphslam.evaluate.bias_test import BiasTest

Word = Literal["consistent", "conservative", "not tested", "overconfident"]
Of = Literal["map", "fixes", "other"]
LEVEL = 0.05
"""Largest share of consistent runs that are called overconfident."""
TOLERANCE = 1.1
"""Ratio of true to stated variances that is called consistent: 5 % of σ. Linearised covariances are no better, and a
test with a thousand degrees of freedom detects less."""
HALF = 2.0
"""Ratio of true to stated variances at which the power of a test is computed: covariances half as large as the true."""
LEAST_POWER = 0.8
"""Power against covariances that are too small by :data:`HALF`, below which a test cannot carry *consistent*."""
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
        Probability that a run whose variances are at most :data:`TOLERANCE` times as large as stated shows at least,
        or that a consistent run shows at most, this value.
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

    def power(self, tests: int) -> float:
        """Probability that this test, one of so many, detects covariances that are too small by :data:`HALF`."""
        if self.lasting:
            return 0.0
        return detection_power(self.dof, TOLERANCE * chi2_quantile(1.0 - LEVEL / tests, self.dof))


def detection_power(dof: float, limit: float) -> float:
    """Probability that χ² exceeds ``limit`` if the covariances are too small by :data:`HALF`."""
    return float(special.chdtrc(dof, limit / HALF))


def chi_square_ratio_test(name: str, of: Of, value: float, dof: float) -> list[ConsistencyTest]:
    """A statistic χ²/dof; none where it has hardly any degrees of freedom."""
    if not (np.isfinite(value) and np.isfinite(dof) and dof >= LEAST_DOF):
        return []
    chi2 = value * dof
    large, small = float(special.chdtrc(dof, chi2 / TOLERANCE)), float(special.chdtr(dof, chi2))
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
    p = len(found.reduction)
    out.append(largest_score_test("calibration errors", "map", float(np.sqrt(found.reduction.max())), tests=2 * p))
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
    """The word, and the tests behind it.

    Parameters
    ----------
    word : str
    speaking : tuple of ConsistencyTest
        Tests that decided it: those that are too large or too small; for the other words those with enough power.
    chance : float
        Probability that a consistent run has a test like the worst, all tests counted.
    missing : tuple of str
        What no test in this log could have shown.
    bent : bool
        Posteriors of submaps are not Gaussian.
    power : float
        Of the tests behind the word, against covariances that are too small by :data:`HALF`.
    """

    word: Word
    speaking: tuple[ConsistencyTest, ...]
    chance: float
    missing: tuple[str, ...] = ()
    bent: bool = False
    power: float = 0.0


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
        return CovarianceAssessment("overconfident", tuple(large), min(1.0, m * large[0].too_large))
    wanted: dict[Of, str] = {"map": "odometry and observations"}
    if fixes:
        wanted["fixes"] = "fixes"
    covers = {
        of: [r for r in rows if r.of == of and r.power(m) >= LEAST_POWER and r.upper <= DETECTABLE_VARIANCE_RATIO]
        for of in wanted
    }
    missing = tuple(what for of, what in wanted.items() if not covers[of])
    power = min((max((r.power(m) for r in found), default=0.0) for found in covers.values()), default=0.0)
    bent = nonlinearity > MAX_NONLINEARITY
    if missing or bent:
        return CovarianceAssessment(
            "not tested", tuple(r for found in covers.values() for r in found), 1.0, missing, bent, power
        )
    small = [r for r in rows if m * r.too_small < LEVEL and r.value < 1.0 / DETECTABLE_VARIANCE_RATIO]
    small.sort(key=lambda r: r.too_small)
    if small:
        return CovarianceAssessment("conservative", tuple(small), min(1.0, m * small[0].too_small), power=power)
    return CovarianceAssessment("consistent", tuple(r for found in covers.values() for r in found), 1.0, power=power)


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
