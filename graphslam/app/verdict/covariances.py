"""Are the covariances consistent? Tests without and with ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from graphslam.app.verdict.chi_square import chi_square_test, nees_tests, of_the_start
from graphslam.app.verdict.figures import (
    CERTAIN,
    CERTAIN_OVER_CONFIDENT,
    RunMetrics,
    class_rows,
    is_finite_number,
    whole_chi2,
)
from graphslam.core.findings import Finding
from graphslam.evaluate.covariance_assessment import (
    LEVEL,
    MAX_NONLINEARITY,
    TOLERANCE,
    ConsistencyTest,
    CovarianceAssessment,
    assess_covariances,
    consistency_tests_of_json,
)
from graphslam.evaluate.residual_consistency import CORRELATED, two_sided_bounds


def covariance_assessment(figures: RunMetrics) -> CovarianceAssessment | None:
    """Assessment of the covariances by tests without ground truth; None for run folders without their results."""
    if figures.report.get("evidence") is None:
        return None
    rows = consistency_tests_of_json(figures.report.get("evidence"))
    fixes = any(r.of == "fixes" for r in rows) or any(c.get("class") == "gps" for c in class_rows(figures))
    bend: Any = figures.report.get("nonlinearity")
    return assess_covariances(rows, fixes=fixes, nonlinearity=float(bend) if is_finite_number(bend) else 0.0)


def check_chi2(figures: RunMetrics) -> list[Finding]:
    """Do the residuals of the graph match the noise model?"""
    if j := chi_square_test(figures):
        if of_the_start(figures, j):
            text = f"chi-square of the initial graph: {j.text}. The refined path does not depend on it."
            return [Finding("", "chi2", text)]
        return [Finding(j.level, "chi2", f"chi-square of the graph: {j.text}.")]
    if whole_chi2(figures) is None:
        text = "chi-square of the graph: not tested — no redundant measurements, or degrees of freedom unknown."
    else:
        text = "chi-square of the graph: not tested — no measurement in this log is redundant."
    return [Finding("", "chi2", text)]


def check_trust(figures: RunMetrics) -> list[Finding]:
    """Are the covariances consistent? The line lists the tests; none of them uses ground truth."""
    found = covariance_assessment(figures)
    if found is None:
        return []
    tests = "; ".join(_test_text(r) for r in found.speaking[:4]) + ("; …" if len(found.speaking) > 4 else "")
    rest = "Tested with residuals and withheld data, without ground truth"
    if figures.report.get("identities") == "run" and figures.metrics.get("landmarks", 0.0) > 0:
        rest += "; correct data association is assumed"
    if found.verdict == "overconfident":
        text = f"covariances: overconfident — above the bounds: {tests}. {rest}."
        return [Finding("bad" if found.chance < 1.0 - CERTAIN else "look", "trust", text)]
    if found.verdict == "not tested":
        held = f" Available tests: {tests}." if tests else ""
        causes = []
        if found.missing:
            errors = " and ".join(found.missing)
            causes.append(f"no redundant measurement in this log can show larger errors of {errors} than assumed")
        if found.bent:
            causes.append(
                "bearing noise is much larger than range noise, so submap posteriors are not Gaussian "
                f"(nonlinearity {figures.report['nonlinearity']:.2g} [< {MAX_NONLINEARITY:g}])"
            )
        text = f"covariances: not tested — {'; '.join(causes)}.{held}"
        if figures.part("refine"):
            text += " The noise of the refined path was estimated from its own residuals, so they cannot test it."
        if found.missing:
            text += f" Use {'' if 'fixes' in found.missing else 'GPS (gps.use), '}control points or loop closures."
        return [Finding("", "trust", text)]
    if found.verdict == "conservative":
        text = f"covariances: conservative — below the bounds: {tests}; residuals are not time-correlated. {rest}."
        return [Finding("look", "trust", text)]
    power = f"power {min(found.power, 0.99):.0%} against covariances half as large as they should be"
    text = f"covariances: consistent [{power}] — {tests}. {rest}."
    return [Finding("good", "trust", text)]


def _test_text(row: ConsistencyTest) -> str:
    """One test with its value."""
    if row.correlated and row.dof == 1.0:
        return f"{row.name} ({row.value:.1f} σ)"
    return f"{row.name} ({row.value:.3g} at {row.dof:.3g} degrees of freedom)"


def check_nees(figures: RunMetrics) -> list[Finding]:
    """Do the errors relative to ground truth match the covariances?"""
    lines = [(j, f"NEES ({j.about}): {j.text}. One run is one sample.") for j in nees_tests(figures)]
    none = "NEES: not tested — no ground truth for this result."
    return [Finding(j.level, "nees", text) for j, text in lines] or [Finding("", "nees", none)]


def check_classes(figures: RunMetrics) -> list[Finding]:
    """Failed tests without ground truth, by class of factors; passed tests are only in the metrics."""
    out: list[Finding] = []

    def check(what: str, value: Any, dof: Any, cause: str) -> None:
        if not (is_finite_number(value) and is_finite_number(dof) and dof > 0):
            return
        high = TOLERANCE * two_sided_bounds(float(value), float(dof), CERTAIN)[1]
        if value > high:
            bounds = f"[≤ {high:.3g} in 999 of 1000 consistent runs]"
            out.append(Finding("bad", "consistency-test", f"{what}: {value:.3g} {bounds} — {cause}"))

    for row in class_rows(figures):
        cause = "these measurements contradict the others, or their assumed noise is too small."
        last = row.get("correlation_time")
        dof = (
            float(row["dof"]) / (float(last or 1.0) if is_finite_number(last) else 1.0)
            if is_finite_number(row.get("dof"))
            else None
        )
        check(f"χ²/dof of factors “{row.get('class')}”", row.get("chi2_per_dof"), dof, cause)
        # a refined path contains GPS factors; the other factors of the graph only gave its initial value
        if row.get("verdict") == CORRELATED and (row.get("class") == "gps" or not figures.part("refine")):
            out.append(_correlated(row))
    m = figures.metrics
    cause = "GPS errors are larger or more correlated than assumed, or the map is wrong."
    check("NIS/dof of withheld GPS fixes", m.get("gps_nis_joint_value"), m.get("gps_nis_joint_dof"), cause)
    median, expected, chance = (m.get(f"gps_distance_{k}") for k in ("median", "expected", "chance"))
    if median is not None and expected is not None and chance is not None and chance < LEVEL:
        text = (
            f"distance of unused GPS fixes from the path: median {median:.3g} m [{expected:.2g} m expected] — {cause} "
            "Use the fixes with --set gps.use=all."
        )
        out.append(Finding("bad" if chance < 1.0 - CERTAIN else "look", "gps-contradicts", text))
    alike, white = m.get("gps_nis_joint_autocorrelation"), m.get("gps_nis_joint_white")
    if alike is not None and white is not None and abs(alike) > white * CERTAIN_OVER_CONFIDENT:
        text = f"autocorrelation of withheld GPS errors: {alike:.2f} [± {white:.2f}] — {_LASTS}"
        out.append(Finding("look", "gps-correlated", text))
    cause = "submaps with common landmarks disagree; noise, mounting or data association is wrong."
    check("disagreement of loop closures, relative to its expectation", m.get("loops_value"), m.get("loops_dof"), cause)
    return out


_LASTS = (
    "receiver errors are correlated over more than one fix interval, but every fix counts as independent. Set "
    "gps.bias_sigma, or a larger gps.sigma."
)


def _correlated(row: Mapping[str, Any]) -> Finding:
    """Autocorrelated residuals: the map follows time-correlated errors."""
    text = (
        f"autocorrelation of “{row.get('class')}” residuals: {float(row['lag1']):.2f}, that is "
        f"{float(row['lag1_score']):.1f} σ (correlation length {float(row['correlation_time']):.3g} residuals, χ²/dof "
        f"{float(row['chi2_per_dof']):.3g}) — the map follows time-correlated errors and is overconfident"
    )
    if row.get("class") == "gps":
        return Finding("look", "gps-correlated", f"{text}: {_LASTS}")
    return Finding("look", "correlated", f"{text}. Add these errors to the noise model.")
