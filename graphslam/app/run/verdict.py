"""The verdict of a run: is it solved, is it consistent, is it complete, and was all requested data used.

"Reported" means: a line here, of the form ``subject: value [bounds] — meaning`` and, where something is to be done,
one imperative sentence. The command line prints the lines, ``--json`` and ``run.json`` hold them, the report
shows them. What follows from the stored figures is worked out anew wherever it is shown
(:func:`findings_from_metrics`); what only the run itself saw (:func:`findings_from_run`) is read from ``run.json``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from graphslam.app.run.stream_use import StreamUse
from graphslam.core.findings import Finding, Level, findings_of_json
from graphslam.core.submap import Submap
from graphslam.evaluate.covariance_assessment import (
    LEVEL,
    MAX_NONLINEARITY,
    TOLERANCE,
    ConsistencyTest,
    CovarianceAssessment,
    assess_covariances,
    consistency_tests_of_json,
    detection_power,
)
from graphslam.evaluate.intervals import by_chance, two_sided_width
from graphslam.evaluate.residual_consistency import LASTING, NOT_TESTED, two_sided_bounds
from graphslam.evaluate.stream_checks import StreamFinding
from graphslam.maps.contradictions import LOOK

TWO_MAPS_DO = "check which of the two is right there, or add GPS there and run again"
"""Of two maps that explain a log."""
CONFIDENCE = 0.95
CERTAIN = 0.999
"""A test that a consistent run fails less often than once in a thousand runs is no accident."""
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
"""Of fitted residuals; the line on the covariances is about the errors of the map."""
CERTAIN_OVER_CONFIDENT = two_sided_width(CERTAIN) / two_sided_width(CONFIDENCE)
"""Ratio of the two-sided bounds of a normal variable at the two levels."""
EXACT = 1e-12
"""χ²/dof below which all measurements are met to the last digit, as in a chain that never closes."""
SMALL_GAP = 1e-6
"""Of the objective: an objective above the optimum by less is at it."""
FLAGGED = 0.05
"""Share of the submaps of consistent runs that front ends may flag by chance."""
QUARTER = 0.25
"""Share of the records of a stream that was asked for and of which a part may be kept back; below, as for MOSTLY."""
ALIKE = 2
"""Submaps whose equal findings are shown in full; of further ones only the keys are listed."""
DENIED = 0.1
"""Share of occupied voxels contradicted by overlapping submaps from which a map is bad."""
MOSTLY = 0.95
"""Share of the records of a stream below which the verdict asks to look at what became of the others."""


@dataclass(frozen=True)
class RunMetrics:
    """What the figures of a finished run are read from, in memory or from its folder.

    Parameters
    ----------
    report : mapping
        ``run.json`` or ``merge.json``.
    metrics : mapping of str to float
    sessions : sequence of mapping
        Of a merge.
    """

    report: Mapping[str, Any]
    metrics: Mapping[str, float]
    events: Sequence[Mapping[str, Any]] = ()
    sessions: Sequence[Mapping[str, Any]] = field(default_factory=tuple)

    @classmethod
    def of_table(cls, report: Mapping[str, Any], metrics: Any, events: Sequence[Mapping[str, Any]] = ()) -> RunMetrics:
        """Those of a table of metrics (``key``, ``value``)."""
        return cls(report, dict(zip(metrics["key"], metrics["value"])), events)

    def part(self, name: str) -> Mapping[str, Any]:
        """A mapping inside the report; empty where it is none."""
        found = self.report.get(name)
        return found if isinstance(found, Mapping) else {}


def run_findings(figures: RunMetrics) -> list[Finding]:
    """All lines of a finished run.

    Lines that the run saw itself are those of ``report["verdict"]`` that do not follow from the figures.
    """
    return findings_from_metrics(figures) + [
        f for f in findings_of_json(figures.report.get("verdict")) if f.code not in _STATED
    ]


def findings_from_metrics(figures: RunMetrics) -> list[Finding]:
    """Lines that follow from the stored figures."""
    return [
        _state(figures),
        _chi2(figures),
        *_trust(figures),
        *_nees(figures),
        *_tests(figures),
        _certificate(figures),
        *_two_maps(figures.part("two_maps")),
        *_left_out(figures),
    ]


_STATED = frozenset(
    {
        "state",
        "chi2",
        "trust",
        "nees",
        "consistency-test",
        "certificate",
        "two-maps",
        "map-left-out",
        "map-coarser",
        "passes",
        "passes-attempts",
        "flagged",
        "imu-axes",
        "imu-and-path",
    }
    | {"imu-contradicted", "session"}
)


def findings_from_run(
    streams: Sequence[StreamUse],
    noticed: Sequence[StreamFinding] = (),
    submaps: Sequence[Submap] = (),
    events: Sequence[Mapping[str, Any]] = (),
) -> list[Finding]:
    """Lines on the use of every stream, on anomalies in it, and the findings of the front end.

    Parameters
    ----------
    noticed : sequence of StreamFinding
        Of the raw streams; what is bad in one that was not used is only worth a look.
    submaps : sequence of Submap
        Their reports may hold ``findings``: rows of :meth:`Finding.as_row`, of the run as a whole or of the submap.
    events : sequence of mapping
        Of the graph; ``outlier``, ``beacon-not-placed`` and ``readings-dropped`` become lines.
    """
    counts = "; ".join(s.in_words() for s in streams)
    out = [Finding("", "streams", f"records used: {counts}.")] if streams else []
    for s in streams:
        if s.used == 0 and s.asked:
            out.append(
                Finding(
                    "bad",
                    f"{s.role}-not-used",
                    f"{s.name}: 0 of {s.offered} records used, although requested — {s.why}.",
                )
            )
        elif s.used == 0 and s.role == "input":
            text = f"{s.name}: 0 of {s.offered} records used — {s.why}."
            out.append(Finding("look", "stream-not-used", text))
        elif (s.asked and s.used < QUARTER * s.offered) or (s.role == "input" and s.used < MOSTLY * s.offered):
            out.append(
                Finding("look", "stream-part-used", f"{s.name}: {s.used} of {s.offered} records used — {s.why}.")
            )
    used = {s.name for s in streams if s.used}
    for n in noticed:
        level: Level = "look" if n.finding.level == "bad" and n.stream not in used else n.finding.level
        out.append(replace(n.finding, level=level))
    return [*out, *_shares(submaps), *_of_events(events), *_of_submaps(submaps)]


def _shares(submaps: Sequence[Submap]) -> list[Finding]:
    """Which front end mapped which interval of a mixed run."""
    spans: dict[str, list[tuple[float, float]]] = {}
    for s in submaps:
        name = s.report.get("front_end")
        if name is None:
            continue
        here = spans.setdefault(name, [])
        if here and here[-1][1] == s.interval[0]:
            here[-1] = here[-1][0], s.interval[1]
        else:
            here.append(s.interval)
    if not spans:
        return []
    streams = {s.report["front_end"]: ", ".join(sorted(s.uses)) for s in submaps if "front_end" in s.report}
    each = [f"{n} ({streams[n]}) {', '.join(f'{a:.1f} to {b:.1f} s' for a, b in t)}" for n, t in spans.items()]
    return [Finding("", "front-ends", f"intervals of the front ends: {'; '.join(each)}.")]


def _of_submaps(submaps: Sequence[Submap]) -> list[Finding]:
    """Findings of front ends on submaps; of equal ones the first in full and the keys of the others."""
    said = [(s.key, f) for s in submaps for row in s.report.get("findings", ()) if (f := Finding.from_row(row))]
    told: dict[tuple[Level, str], list[int]] = {}
    out = []
    for key, f in said:
        keys = told.setdefault((f.level, f.code), [])
        if key not in keys:
            keys.append(key)
        if len(keys) <= ALIKE:
            out.append(f)
    for (level, code), keys in told.items():
        if more := keys[ALIKE:]:
            some = ", ".join(map(str, more[:12])) + (", …" if len(more) > 12 else "")
            text = f"{code}: {len(more)} more submaps ({some}) — details are in their reports."
            out.append(Finding(level, code, text))
    return out


def _of_events(events: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Measurements that the graph left out."""
    out = []
    taken = Counter(str(e["group"]) for e in events if e.get("event") == "outlier")
    if taken:
        counts = ", ".join(f"{n} of class {group}" for group, n in sorted(taken.items()))
        text = f"outliers: {taken.total()} factors ({counts}) — removed by graduated non-convexity; see events."
        out.append(Finding("look", "outliers", text))
    out += [_fix_errors(e) for e in events if e.get("event") == "gps-errors"]
    for e in events:
        if e.get("event") == "no-effect":
            out.append(Finding("look", "no-effect", f"{e['option']} has no effect — {e['why']}."))
        if e.get("event") == "beacon-not-placed":
            text = f"beacon {e['beacon']}: no position after {e['distances']} distances — {e['why']}."
            out.append(Finding("look", "beacon-not-placed", text))
    return out


def _fix_errors(e: Mapping[str, Any]) -> Finding:
    """Estimated errors of the GPS fixes, and how the graph models them."""
    text = ""
    if e.get("wild"):
        text = f"GPS outliers: {e['wild']} of {e['fixes']} fixes — far from the map and from the other fixes; removed. "
    if e.get("bias_sigma"):
        text += (
            f"GPS errors: a time-correlated part (σ {e['bias_sigma']:.3g} m, time constant {e['bias_time']:.3g} s) and "
            f"a white part of {e['white']:.2g} times the receiver's σ — log-likelihood +{e['gain'] / 2:.3g} nats over "
            "white noise; the graph estimates a bias for every fix. Use --set gps.errors=stated to keep the receiver's "
            "σ."
        )
    elif e.get("white", 1.0) > 1.0:
        text += f"GPS errors: {e['white']:.2g} times the receiver's σ — the σ of every fix was scaled by it."
    return Finding("look", "gps-correlated" if e.get("bias_sigma") else "gps-errors", text.strip())


def class_rows(figures: RunMetrics) -> list[dict[str, Any]]:
    """χ² of each class of factors with its bounds: from the report, or as far as metrics of older runs hold it."""
    found = figures.part("graph").get("classes")
    if isinstance(found, list):
        return [r for r in found if isinstance(r, dict)]
    m = figures.metrics
    out = []
    for key, ratio in m.items():
        if not (key.startswith("honesty_") and key.endswith("_chi2_per_dof")):
            continue
        stem = key.removesuffix("_chi2_per_dof")
        dof = m.get(f"{stem}_dof", math.nan)
        row = {"class": stem.removeprefix("honesty_"), "dof": dof, "chi2": ratio * dof, "chi2_per_dof": ratio}
        if dof > 0:
            row["low"], row["high"], row["verdict"] = two_sided_bounds(ratio, dof, CONFIDENCE)
        out.append(row | {"mean_weight": m.get(f"{stem}_mean_weight")})
    return out


def whole_chi2(figures: RunMetrics) -> tuple[float, float] | None:
    """χ² and degrees of freedom of all classes that test anything; None where there are none, or not known."""
    rows = [
        r for r in class_rows(figures) if is_finite_number(r.get("dof")) and is_finite_number(r.get("chi2_per_dof"))
    ]
    chi2 = dof = 0.0
    for r in rows:
        dof += float(r["dof"])
        if r["class"] in NOT_TESTED:  # without it the graph has fewer residuals, and fewer unknowns
            dof -= max(float(r.get("rows", 0)) - NOT_TESTED[r["class"]], 0.0)
        elif is_finite_number(r.get("chi2")):
            chi2 += float(r["chi2"])
    return (chi2, dof) if dof > 0.5 else None  # less than one degree of freedom is rounding


@dataclass(frozen=True, slots=True)
class ChiSquareTest:
    """A ratio that is 1 where covariances are consistent, and its bounds.

    Parameters
    ----------
    code : {"chi2", "nees"}
    name : str
        ``χ²/dof``.
    about : str
        Of what.
    tests : int
        That share the significance level (Bonferroni).
    """

    code: str
    name: str
    ratio: float
    dof: float
    about: str = ""
    tests: int = 1

    def bounds(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Two-sided bounds of the ratio; above those of residuals there is the tolerance of their tests."""
        low, high, _ = two_sided_bounds(self.ratio, self.dof, 1.0 - (1.0 - confidence) / self.tests)
        return low, high * (TOLERANCE if self.code == "chi2" else 1.0)

    @property
    def word(self) -> str:
        """``consistent``, ``overconfident`` or ``conservative``."""
        low, high = self.bounds()
        return "overconfident" if self.ratio > high else "conservative" if self.ratio < low else "consistent"

    @property
    def power(self) -> float:
        """Probability that the test detects covariances that are half as large as they should be."""
        return detection_power(self.dof, self.bounds()[1] * self.dof)

    @property
    def level(self) -> Level:
        """One consistent run in forty is outside on either side; bad is less likely than one in a thousand."""
        if self.word == "consistent":
            return "good"
        return "bad" if self.ratio > self.bounds(CERTAIN)[1] else "look"

    @property
    def text(self) -> str:
        """``1.02 per degree of freedom [0.94, 1.06; 4321 dof] — residuals match the noise model``."""
        low, high = self.bounds()
        meaning = (IN_WORDS if self.code == "nees" else RESIDUALS_IN_WORDS)[self.word]
        return f"{self.ratio:.3g} per degree of freedom [{low:.3g}, {high:.3g}; {self.dof:.4g} dof] — {meaning}"


def chi_square_test(figures: RunMetrics) -> ChiSquareTest | None:
    """χ² of the whole graph; None where nothing is redundant that could contradict, or that is not known."""
    found = whole_chi2(figures)
    if found is None or found[0] < EXACT * found[1]:
        return None
    return ChiSquareTest("chi2", "χ²/dof", found[0] / found[1], found[1])


def of_the_start(figures: RunMetrics, chi2: ChiSquareTest) -> bool:
    """Does it say of the start of a refined path only that its noise was stated too large?"""
    return bool(figures.part("refine")) and chi2.word == "conservative"


def nees_tests(figures: RunMetrics) -> list[ChiSquareTest]:
    """NEES against the truth, where it is known: in each gauge in which it was taken, and of overconfident axes."""
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
    return [j for j in known if j.tests == 1 or j.word == "overconfident"]


def is_finite_number(value: Any) -> bool:
    """Is it a finite number?"""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _state(figures: RunMetrics) -> Finding:
    m = figures.metrics
    converged = figures.report.get("converged", m.get("converged"))
    if converged is None:
        return Finding(
            "bad", "state", "solution: unknown — the run folder does not record whether the solver converged."
        )
    if not converged:
        return Finding("bad", "state", "solution: not converged — the graph is not at its optimum.")
    objective, gap = m.get("objective", m.get("join_chi2")), m.get("gap")
    value = "at the optimum" if objective is None else f"cost {objective:.6g} (Σ rᵀ P⁻¹ r)"
    if gap is None:
        text = f"solution: {value} — converged by the solver's own test; not compared with a batch solution."
        return Finding("good", "state", text)
    scale = max(abs(objective or 0.0), 1.0)
    small = gap <= SMALL_GAP * scale
    text = "a batch solution from there is no lower" if small else f"a batch solution from there is lower by {gap:.3g}"
    return Finding("good" if small else "look", "state", f"solution: {value} — converged; {text}.")


def _chi2(figures: RunMetrics) -> Finding:
    if j := chi_square_test(figures):
        if of_the_start(figures, j):
            text = f"chi-square of the initial graph: {j.text}. The refined path does not depend on it."
            return Finding("", "chi2", text)
        return Finding(j.level, "chi2", f"chi-square of the graph: {j.text}.")
    if whole_chi2(figures) is None:
        text = "chi-square of the graph: not tested — no redundant measurements, or degrees of freedom unknown."
    else:
        text = "chi-square of the graph: not tested — no measurement in this log is redundant."
    return Finding("", "chi2", text)


def _said(row: ConsistencyTest) -> str:
    """One test with its value."""
    if row.lasting and row.dof == 1.0:
        return f"{row.name} ({row.value:.1f} σ)"
    return f"{row.name} ({row.value:.3g} at {row.dof:.3g} degrees of freedom)"


def covariance_assessment(figures: RunMetrics) -> CovarianceAssessment | None:
    """Are the covariances consistent, by the tests that need no ground truth? None in folders without their results."""
    if figures.report.get("evidence") is None:
        return None
    rows = consistency_tests_of_json(figures.report.get("evidence"))
    fixes = any(r.of == "fixes" for r in rows) or any(c.get("class") == "gps" for c in class_rows(figures))
    bend: Any = figures.report.get("nonlinearity")
    return assess_covariances(rows, fixes=fixes, nonlinearity=float(bend) if is_finite_number(bend) else 0.0)


def _trust(figures: RunMetrics) -> list[Finding]:
    """Are the covariances consistent? The line names the tests; none of them uses ground truth."""
    found = covariance_assessment(figures)
    if found is None:
        return []
    said = "; ".join(_said(r) for r in found.speaking[:4]) + ("; …" if len(found.speaking) > 4 else "")
    rest = "Tested with residuals and withheld data, without ground truth"
    if figures.report.get("identities") == "run" and figures.metrics.get("landmarks", 0.0) > 0:
        rest += "; correct data association is assumed"
    if found.word == "overconfident":
        text = f"covariances: overconfident — above the bounds: {said}. {rest}."
        return [Finding("bad" if found.chance < 1.0 - CERTAIN else "look", "trust", text)]
    if found.word == "not tested":
        held = f" Available tests: {said}." if said else ""
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
            text += " Add loop closures, GPS or control points."
        return [Finding("", "trust", text)]
    if found.word == "conservative":
        text = f"covariances: conservative — below the bounds: {said}; residuals are not time-correlated. {rest}."
        return [Finding("look", "trust", text)]
    power = f"power {min(found.power, 0.99):.0%} against covariances half as large as they should be"
    text = f"covariances: consistent [{power}] — {said}. {rest}."
    return [Finding("good", "trust", text)]


def _nees(figures: RunMetrics) -> list[Finding]:
    said = [(j, f"NEES ({j.about}): {j.text}. One run is one sample.") for j in nees_tests(figures)]
    none = "NEES: not tested — no ground truth for this result."
    return [Finding(j.level, "nees", text) for j, text in said] or [Finding("", "nees", none)]


def _tests(figures: RunMetrics) -> list[Finding]:
    """Failed tests without ground truth; those that a run passes are in the metrics."""
    out: list[Finding] = []

    def judge(what: str, value: Any, dof: Any, cause: str) -> None:
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
        judge(f"χ²/dof of factors “{row.get('class')}”", row.get("chi2_per_dof"), dof, cause)
        # a refined path holds fixes; the other factors of the graph were its start
        if row.get("verdict") == LASTING and (row.get("class") == "gps" or not figures.part("refine")):
            out.append(_lasting(row))
    m = figures.metrics
    cause = "GPS errors are larger or more correlated than assumed, or the map is wrong."
    judge("NIS/dof of withheld GPS fixes", m.get("gps_nis_joint_value"), m.get("gps_nis_joint_dof"), cause)
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
    judge("disagreement of loop closures, relative to its expectation", m.get("loops_value"), m.get("loops_dof"), cause)
    return out


_LASTS = (
    "receiver errors are correlated over more than one fix interval, but every fix counts as independent. Set "
    "gps.bias_sigma, or a larger gps.sigma."
)


def _lasting(row: Mapping[str, Any]) -> Finding:
    """Autocorrelated residuals: the map follows time-correlated errors."""
    text = (
        f"autocorrelation of “{row.get('class')}” residuals: {float(row['lag1']):.2f}, that is "
        f"{float(row['lag1_score']):.1f} σ (correlation length {float(row['correlation_time']):.3g} residuals, χ²/dof "
        f"{float(row['chi2_per_dof']):.3g}) — the map follows time-correlated errors and is overconfident"
    )
    if row.get("class") == "gps":
        return Finding("look", "gps-correlated", f"{text}: {_LASTS}")
    return Finding("look", "correlated", f"{text}. Add these errors to the noise model.")


def _certificate(figures: RunMetrics) -> Finding:
    found = figures.report.get("certificate")
    if found is None:
        text = "global optimum: not tested — no certificate was requested."
        return Finding("", "certificate", text)
    text = str(found.get("verdict", found) if isinstance(found, Mapping) else found)
    return Finding("good" if text.startswith("certified") else "look", "certificate", f"global optimum: {text}")


def _flagged(figures: RunMetrics) -> list[Finding]:
    """Submaps that the front end flags; consistent ones are flagged now and then, by chance."""
    counts = figures.part("flagged_submaps")
    flagged, n = counts.get("any", 0), figures.metrics.get("submaps", 0.0)
    if not (is_finite_number(flagged) and flagged):
        return []
    why = ", ".join(f"{v:g} for {k}" for k, v in counts.items() if k != "any" and is_finite_number(v))
    text = f"submaps flagged by the front end: {flagged:g} of {n:g} ({why})"
    usual = by_chance(int(n), FLAGGED, CERTAIN)
    if flagged <= usual:
        return [Finding("", "flagged", f"{text} [≤ {usual:g} by chance] — no more than chance.")]
    return [Finding("look", "flagged", f"{text} [≤ {usual:g} by chance] — more than chance.")]


def _passes(found: Mapping[str, Any]) -> list[Finding]:
    """Do overlapping submaps of independent traversals agree?"""
    share, points, doubted = found.get("share"), found.get("points"), found.get("doubted")
    if not (isinstance(share, float) and isinstance(points, int) and points and isinstance(doubted, list)):
        return []
    text = f"map overlap: {1 - share:.1%} of {points} occupied voxels agree [≥ {1 - LOOK:.0%}]"
    if share <= LOOK and len(doubted) < 2:
        return [Finding("good", "passes", f"{text} — no contradiction found.")]
    pairs = ", ".join(f"{p[0]} and {p[1]}" for p in doubted[:3] if isinstance(p, list) and len(p) == 2)
    most = f" (most in submaps {pairs})" if pairs else ""
    text += (
        f" — {share:.1%} are free space in other submaps{most}: a loop closure is wrong or missing, or objects moved. "
        "Look for double walls in the map; try another seed (--seed 1) or --set calibrate.use=none."
    )
    return [Finding("bad" if share > DENIED else "look", "passes", text)]


def _attempts(rows: Any) -> list[Finding]:
    """Which of several solved graphs is the result, and why."""
    if not (isinstance(rows, list) and len(rows) > 1 and all(isinstance(r, Mapping) for r in rows)):
        return []
    draws = len({r.get("draw") for r in rows})
    shares = []
    for r in rows:
        share = r.get("share")
        value = f"{share:.1%}" if isinstance(share, float) else "unknown"
        of = f" of draw {r.get('draw')}" if draws > 1 else ""
        shares.append(f"{'with searched loop closures' if r.get('loops') else 'with matches only'}{of} {value}")
    kept = next((k for k, r in enumerate(rows) if r.get("kept")), None)
    if kept is None:
        return []
    what = f"of {draws} draws of the particles" if draws > 1 else "of the same submaps"
    text = (
        f"graphs tried: {len(rows)} {what} — contradicted voxels {', '.join(shares)}. Number {kept + 1} is the result"
        + ("; `graphslam loops` lists its loop closures." if rows[kept].get("loops") else ".")
    )
    settled = isinstance(share := rows[kept].get("share"), float) and share <= LOOK
    return [Finding("" if settled else "look", "passes-attempts", text)]


def _two_maps(found: Mapping[str, Any]) -> list[Finding]:
    """Two groups of loop closures that exclude each other; neither is in the graph."""
    if not found:
        return []
    first, second = (_listed(loops) for loops in found["loops"])
    places = found["places"]
    spans = [" and ".join(f"{a:.0f} to {b:.0f} s" for a, b in p["times"]) for p in places]
    more = "; ".join(spans[:3]) + ("; …" if len(spans) > 3 else "")
    each = " Each of these places may follow either map." if len(places) > 1 else ""
    text = (
        f"ambiguous loop closures: two maps, one with {first}, one with {second} — both fit the log, only one can be "
        f"right. Nodes differ by up to {found['apart_max']:.2f} m (at {found['apart_max_time']:.0f} s; median "
        f"{found['apart_median']:.2f} m). Disputed is the relative pose of these stretches: {more}.{each} The map of "
        f"this run uses neither group and drifts there; both maps are in two_maps/ and in the report. "
        f"To do: {TWO_MAPS_DO}."
    )
    return [Finding("bad", "two-maps", text)]


def _listed(loops: Sequence[int]) -> str:
    shown = ", ".join(str(n) for n in loops[:6]) + (", …" if len(loops) > 6 else "")
    return f"loop{'s' * (len(loops) != 1)} {shown}" if loops else "none of these loops"


def _left_out(figures: RunMetrics) -> list[Finding]:
    out: list[Finding] = []
    if figures.report.get("map_left_out"):
        out.append(Finding("look", "map-left-out", f"fused map: not made — {figures.report['map_left_out']}"))
    if figures.report.get("map_coarser"):
        out.append(Finding("look", "map-coarser", str(figures.report["map_coarser"])))
    out += [*_passes(figures.part("map_passes")), *_attempts(figures.report.get("map_attempts")), *_flagged(figures)]
    for e in figures.events:
        if e.get("event") == "imu-axes" and e.get("verdict") == "wrong":
            out.append(Finding("bad", "imu-axes", f"IMU {e.get('stream')}: {e.get('words')}"))
        if e.get("event") == "imu-axes" and e.get("verdict") == "unlike":
            moved, missed = e["turns"]
            text = (
                f"IMU {e.get('stream')}: yaw rates of path and gyro differ by {missed:.2g} rad/s (gyro: {moved:.2g} "
                "rad/s) for any mounting — the path is wrong, or unit or clock of the gyro is."
            )
            out.append(Finding("bad", "imu-and-path", text))
        if e.get("event") == "imu-axes" and e.get("verdict") == "not checked":
            text = f"IMU {e.get('stream')}, axes: not tested — {e.get('why')}."
            out.append(Finding("", "imu-axes", text))
        if e.get("event") == "imu-contradicted":
            text = f"IMU {e.get('stream', '')}".strip()
            line = f"{text}: contradicts the submaps — the assumed noise of one of them is too small."
            out.append(Finding("bad", "imu-contradicted", line))
    for s in figures.sessions:
        common, rejected = s.get("common_landmarks"), s.get("rejected")
        if isinstance(common, int) and isinstance(rejected, int) and rejected > common:
            text = f"{common} common landmarks agree, {rejected} do not — it may be another place."
            out.append(Finding("bad", "session", f"session {s.get('name')}: {text}"))
    return out
