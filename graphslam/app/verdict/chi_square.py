"""Tests of a ratio that is 1 for consistent covariances: χ²/dof of the graph, NEES/dof with ground truth."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam.app.verdict.figures import CERTAIN, CONFIDENCE, RunMetrics, is_finite_number, whole_chi2
from graphslam.core.findings import Level
from graphslam.evaluate.covariance_assessment import TOLERANCE, detection_power
from graphslam.evaluate.residual_consistency import two_sided_bounds

IN_WORDS = {
    "consistent": "errors match the covariances",
    "overconfident": "errors are larger than the covariances (overconfident)",
    "conservative": "errors are smaller than the covariances (conservative)",
}
RESIDUALS_IN_WORDS = {
    "consistent": "residuals match the noise model",
    "overconfident": "residuals are larger than the noise model explains",
    "conservative": "residuals are smaller than the noise model expects",
}
"""For the χ² of residuals; :data:`IN_WORDS` is for the NEES."""
EXACT = 1e-12
"""χ²/dof below this is numerically zero: no redundant measurement, as in a chain without loop closures."""


@dataclass(frozen=True, slots=True)
class ChiSquareTest:
    """A ratio that is 1 for consistent covariances, and its bounds.

    Parameters
    ----------
    code : {"chi2", "nees"}
    name : str
        ``χ²/dof``.
    about : str
        Subject of the test.
    tests : int
        Number of tests that share the significance level (Bonferroni).
    """

    code: str
    name: str
    ratio: float
    dof: float
    about: str = ""
    tests: int = 1

    def bounds(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Two-sided bounds of the ratio; for χ² the upper one is multiplied by :data:`TOLERANCE`."""
        low, high, _ = two_sided_bounds(self.ratio, self.dof, 1.0 - (1.0 - confidence) / self.tests)
        return low, high * (TOLERANCE if self.code == "chi2" else 1.0)

    @property
    def verdict(self) -> str:
        """``consistent``, ``overconfident`` or ``conservative``."""
        low, high = self.bounds()
        return "overconfident" if self.ratio > high else "conservative" if self.ratio < low else "consistent"

    @property
    def power(self) -> float:
        """Probability that the test detects covariances that are half as large as the true ones."""
        return detection_power(self.dof, self.bounds()[1] * self.dof)

    @property
    def level(self) -> Level:
        """``good`` within the bounds; ``bad`` above those at confidence :data:`CERTAIN`; otherwise ``look``."""
        if self.verdict == "consistent":
            return "good"
        return "bad" if self.ratio > self.bounds(CERTAIN)[1] else "look"

    @property
    def text(self) -> str:
        """``1.02 per degree of freedom [0.94, 1.06; 4321 dof] — residuals match the noise model``."""
        low, high = self.bounds()
        meaning = (IN_WORDS if self.code == "nees" else RESIDUALS_IN_WORDS)[self.verdict]
        return f"{self.ratio:.3g} per degree of freedom [{low:.3g}, {high:.3g}; {self.dof:.4g} dof] — {meaning}"


def chi_square_test(figures: RunMetrics) -> ChiSquareTest | None:
    """χ² of the whole graph; None without redundant measurements or if the degrees of freedom are unknown."""
    found = whole_chi2(figures)
    if found is None or found[0] < EXACT * found[1]:
        return None
    return ChiSquareTest("chi2", "χ²/dof", found[0] / found[1], found[1])


def of_the_start(figures: RunMetrics, chi2: ChiSquareTest) -> bool:
    """Is the run refined, and is the χ² of its initial graph conservative? Then it is not a fault of the result."""
    return bool(figures.part("refine")) and chi2.verdict == "conservative"


def nees_tests(figures: RunMetrics) -> list[ChiSquareTest]:
    """NEES with ground truth: in each gauge for which it was computed, and of single axes that are overconfident."""
    m = dict(figures.metrics)
    gauges = [("nees", "first base fixed"), ("nees_aligned_landmarks", "landmarks, after alignment")]
    bases = [f"{s.get('name')}_base_nees" for s in figures.sessions]
    if bases := [k for k in bases if m.get(f"{k}_dof", 0.0) > 0 and is_finite_number(m.get(k))]:
        m |= {f"{k}_per_dof": m[k] / m[f"{k}_dof"] for k in bases}
        gauges += [(k, f"base of {k.removesuffix('_base_nees')} in the common frame") for k in bases]
    axes = [k for k in ("x", "y", "z", "roll", "pitch", "heading") if f"nees_{k}_dof" in m]
    known = [
        ChiSquareTest("nees", "NEES/dof", m[f"{key}_per_dof"], m[f"{key}_dof"], about, n)
        for key, about, n in [(*g, 1) for g in gauges] + [(f"nees_{k}", f"{k} of all nodes", len(axes)) for k in axes]
        if is_finite_number(m.get(f"{key}_per_dof")) and m.get(f"{key}_dof", 0.0) > 0
    ]
    return [j for j in known if j.tests == 1 or j.verdict == "overconfident"]
