"""Verdict on the covariances of a map without ground truth, and the tests that it is based on.

Each test is a `ConsistencyTest`: a statistic, its degrees of freedom, and the probabilities of such a large or such a
small value in a consistent run. All tests together give one verdict:

- *overconfident*: errors are too large in a test, by more than :data:`TOLERANCE` allows, or they are correlated: from
  one residual to the next, from window to window, or as a constant calibration error. The tests share one significance
  level (Bonferroni): a consistent run is called overconfident in at most :data:`LEVEL` of the cases;
- *not tested*: no test of motion and observations, or none of the fixes if the graph has any, had the power
  :data:`LEAST_POWER` to show covariances that are half as large as they should be, or could exclude variances that are
  :data:`DETECTABLE_VARIANCE_RATIO` times as large as reported; or the posteriors of submaps are not Gaussian
  (:data:`MAX_NONLINEARITY`), which all tests assume;
- *conservative*: errors are too small in a test, by a factor :data:`DETECTABLE_VARIANCE_RATIO`, and none of the above;
- *consistent*: otherwise.

The first rule has priority over the third: a map follows correlated errors, so its residuals can be small although it
is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy import special

from graphslam.core.gaussian import chi2_quantile
from graphslam.evaluate.bias_test import BiasTest

Verdict = Literal["consistent", "conservative", "not tested", "overconfident"]
Of = Literal["map", "fixes", "other"]
LEVEL = 0.05
"""Largest share of consistent runs that are called overconfident."""
TOLERANCE = 1.1
"""Ratio of true to reported variances that counts as consistent: 5 % in σ. Linearised covariances are not more
accurate, and a test with a thousand degrees of freedom does not detect less."""
HALF = 2.0
"""Ratio of true to reported variances at which the power of a test is computed."""
LEAST_POWER = 0.8
"""Least power against covariances that are too small by :data:`HALF` for the verdict *consistent*."""
DETECTABLE_VARIANCE_RATIO = 1.5
"""Ratio of true to reported variances that a test must exclude."""
CONFIDENCE = 0.975
"""Confidence with which it is excluded."""
MAX_NONLINEARITY = 0.006
"""Squared shift by curvature per unknown, mean over submaps, above which the verdict is *not tested*. In 80 simulated
worlds with correct noise models NEES/n of all nodes was 1.06 on average below 0.001, 1.20 from there to 0.006, and 1.37
above."""
LEAST_DOF = 4.0
"""Tests with fewer degrees of freedom are ignored."""


@dataclass(frozen=True, slots=True)
class ConsistencyTest:
    """One test without ground truth.

    Parameters
    ----------
    name : str
        Name in the report: “χ² of gps”.
    of : "map", "fixes" or "other"
        What it covers: motion and observations, fixes, or something else that the verdict does not require.
    value : float
        1 if the noise model is right.
    dof : float
        Number of independent residuals.
    too_large, too_small : float
        Probability of at least this value if variances are at most :data:`TOLERANCE` times the reported ones, and of at
        most this value in a consistent run.
    correlated : bool
        The test is for time-correlated errors, not for their size.
    """

    name: str
    of: Of
    value: float
    dof: float
    too_large: float
    too_small: float
    correlated: bool = False

    @property
    def upper(self) -> float:
        """Largest ratio of true to reported variances that the test does not exclude."""
        return self.value * self.dof / max(chi2_quantile(1.0 - CONFIDENCE, self.dof), 1e-12)

    def power(self, tests: int) -> float:
        """Probability that this test, one of ``tests``, detects covariances that are too small by :data:`HALF`."""
        if self.correlated:
            return 0.0
        return detection_power(self.dof, TOLERANCE * chi2_quantile(1.0 - LEVEL / tests, self.dof))


def detection_power(dof: float, limit: float) -> float:
    """Probability that χ² exceeds ``limit`` if the covariances are too small by :data:`HALF`."""
    return float(special.chdtrc(dof, limit / HALF))


def chi_square_ratio_test(name: str, of: Of, value: float, dof: float) -> list[ConsistencyTest]:
    """A test of χ²/dof; empty if it has fewer than :data:`LEAST_DOF` degrees of freedom."""
    if not (np.isfinite(value) and np.isfinite(dof) and dof >= LEAST_DOF):
        return []
    chi2 = value * dof
    large, small = float(special.chdtrc(dof, chi2 / TOLERANCE)), float(special.chdtr(dof, chi2))
    return [ConsistencyTest(name, of, float(value), float(dof), large, small)]


def largest_score_test(name: str, of: Of, score: float, *, tests: int = 1) -> ConsistencyTest:
    """Test of the largest of ``tests`` scores, each N(0, 1) if there is no systematic error."""
    p = min(1.0, tests * float(special.ndtr(-score)))
    return ConsistencyTest(name, of, float(score), 1.0, p, 1.0, correlated=True)


def short_window_tests(found: BiasTest | None) -> list[ConsistencyTest]:
    """Tests on the short windows of landmark front ends: total noise, calibration errors, time correlation."""
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
        out.append(ConsistencyTest(worst.name, "map", worst.value, worst.dof, chance, 1.0, correlated=True))
    return out


@dataclass(frozen=True, slots=True)
class CovarianceAssessment:
    """The verdict, and the tests that it is based on.

    Parameters
    ----------
    verdict : str
    speaking : tuple of ConsistencyTest
        Tests that decided it: those that are too large or too small; for the other verdicts those with enough power.
    chance : float
        Probability that a consistent run has a test like the worst, all tests counted.
    missing : tuple of str
        What could not be tested with this log.
    bent : bool
        Posteriors of submaps are not Gaussian.
    power : float
        Least power of the required tests against covariances that are too small by :data:`HALF`.
    """

    verdict: Verdict
    speaking: tuple[ConsistencyTest, ...]
    chance: float
    missing: tuple[str, ...] = ()
    bent: bool = False
    power: float = 0.0


def assess_covariances(
    rows: Sequence[ConsistencyTest], *, fixes: bool, nonlinearity: float = 0.0
) -> CovarianceAssessment:
    """Verdict of all tests.

    Parameters
    ----------
    fixes : bool
        The graph has fixes: a test of them is required, too.
    nonlinearity : float
        See :func:`pooled_nonlinearity`; 0 if submaps are not smoothed.
    """
    m = max(1, sum(1 if r.correlated else 2 for r in rows))
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
    """Squared shift between optimum and mean of submaps, caused by curvature, per unknown.

    See :meth:`graphslam_frontends.landmarks.summarise.SmoothingResult.nonlinearity`; 0 if no report contains it.
    """
    rows = [(float(r["nonlinearity"]), float(r["unknowns"])) for r in reports if "nonlinearity" in r]
    return sum(v * n for v, n in rows) / sum(n for _, n in rows) if rows else 0.0


def consistency_tests_of_json(value: Any) -> list[ConsistencyTest]:
    """Tests from the list in a report; entries of another form are ignored."""
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
