"""The verdict of a run: is it solved, is it honest, is it whole, and was everything used that was asked for.

"Reported" means: a line here. The command line prints the lines, ``--json`` and ``run.json`` hold them, the report
shows them. What follows from the stored figures is worked out anew wherever it is shown (:func:`stated`); what only the
run itself saw (:func:`observed`) is read from ``run.json``.
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
    ConsistencyTest,
    CovarianceAssessment,
    assess_covariances,
    tests_of_json,
)
from graphslam.evaluate.intervals import by_chance, two_sided_width
from graphslam.evaluate.residual_consistency import LASTING, two_sided_bounds
from graphslam.evaluate.stream_checks import StreamFinding
from graphslam.maps.contradictions import LOOK

TWO_MAPS_DO = "see which of both is right there, or give GPS there and run again"
"""Of two maps that explain a log."""
CONFIDENCE = 0.95
CERTAIN = 0.999
"""A test that an honest run fails less often than once in a thousand runs is no accident."""
IN_WORDS = {
    "consistent": "inside them: the errors are as large as the covariances say",
    "over-confident": "above them: the errors are larger than the covariances say (over-confident)",
    "pessimistic": "below them: the errors are smaller than the covariances say (pessimistic)",
}
RESIDUALS_IN_WORDS = {
    "consistent": "inside them: residuals are as large as the noise that was stated leaves them",
    "over-confident": "above them: residuals are larger than the noise that was stated leaves them",
    "pessimistic": "below them: residuals are smaller than the noise that was stated leaves them",
}
"""Of residuals, which were fitted: what they say of the errors of the map, the line on its covariances says."""
CERTAIN_OVER_CONFIDENT = two_sided_width(CERTAIN) / two_sided_width(CONFIDENCE)
"""Ratio of the two-sided bounds of a normal variable at the two levels."""
EXACT = 1e-12
"""χ²/dof below which all measurements are met to the last digit, as in a chain that never closes."""
SMALL_GAP = 1e-6
"""Of the objective: an objective above the optimum by less is at it."""
FLAGGED = 0.05
"""Share of the submaps of honest runs that front ends may flag by chance."""
QUARTER = 0.25
"""Share of the records of a stream that was asked for and of which a part may be kept back; below, as for MOSTLY."""
ALIKE = 2
"""Submaps of which the same is said in full; of more their keys are told."""
DENIED = 0.1
"""Share of solid points that another pass denies from which a map is to be distrusted."""
MOSTLY = 0.95
"""Share of the records of a stream below which the verdict asks to look at what became of the others."""


@dataclass(frozen=True)
class Figures:
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

    def part(self, name: str) -> Mapping[str, Any]:
        """A mapping inside the report; empty where it is none."""
        found = self.report.get(name)
        return found if isinstance(found, Mapping) else {}


def verdict(figures: Figures) -> list[Finding]:
    """All lines of a finished run.

    Lines that the run saw itself are those of ``report["verdict"]`` that do not follow from the figures.
    """
    return stated(figures) + [f for f in findings_of_json(figures.report.get("verdict")) if f.code not in _STATED]


def stated(figures: Figures) -> list[Finding]:
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


def observed(
    streams: Sequence[StreamUse],
    noticed: Sequence[StreamFinding] = (),
    submaps: Sequence[Submap] = (),
    events: Sequence[Mapping[str, Any]] = (),
) -> list[Finding]:
    """Lines on what became of every stream, what was noticed in it, and what the front end says.

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
    out = [Finding("", "streams", f"Records used of those offered: {counts}.")] if streams else []
    for s in streams:
        if s.used == 0 and s.asked:
            out.append(Finding("bad", f"{s.role}-not-used", f"{s.name} was asked for and not used: {s.why}."))
        elif s.used == 0 and s.role == "input":
            text = f"Nothing of {s.name} was used ({s.offered} records): {s.why}."
            out.append(Finding("look", "stream-not-used", text))
        elif (s.asked and s.used < QUARTER * s.offered) or (s.role == "input" and s.used < MOSTLY * s.offered):
            out.append(Finding("look", "stream-part-used", f"Only {s.in_words()}: {s.why}."))
    used = {s.name for s in streams if s.used}
    for n in noticed:
        level: Level = "look" if n.finding.level == "bad" and n.stream not in used else n.finding.level
        out.append(replace(n.finding, level=level))
    return [*out, *_of_events(events), *_of_submaps(submaps)]


def _of_submaps(submaps: Sequence[Submap]) -> list[Finding]:
    """What front ends say of submaps; of what they say of many, the first in full and the keys of the others."""
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
            text = f"The same ({code}) is said of {len(more)} more submaps: {some}; their reports have the figures."
            out.append(Finding(level, code, text))
    return out


def _of_events(events: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """What the graph left out by its own judgement."""
    out = []
    taken = Counter(str(e["group"]) for e in events if e.get("event") == "outlier")
    if taken:
        counts = ", ".join(f"{n} of class {group}" for group, n in sorted(taken.items()))
        text = (
            f"Graduated non-convexity took out {taken.total()} factors as outliers: {counts}. Each is named in events."
        )
        out.append(Finding("look", "outliers", text))
    out += [_fix_errors(e) for e in events if e.get("event") == "gps-errors"]
    for e in events:
        if e.get("event") == "beacon-not-placed":
            text = f"Beacon {e['beacon']} has no place after {e['distances']} distances: {e['why']}."
            out.append(Finding("look", "beacon-not-placed", text))
    return out


def _fix_errors(e: Mapping[str, Any]) -> Finding:
    """What the log told of the errors of its fixes, and what was made of it."""
    text = ""
    if e.get("wild"):
        text = f"{e['wild']} of {e['fixes']} fixes lie wide of the map and of the others, and were taken out. "
    if e.get("bias_sigma"):
        text += (
            f"Errors of the fixes last: a part of {e['bias_sigma']:.3g} m that fades over {e['bias_time']:.3g} s, and "
            f"a white part of {e['white']:.2g} times the stated σ, are likelier than white noise by "
            f"{e['gain'] / 2:.3g} nats. The graph has a bias for every fix (gps.errors=stated believes the receiver "
            "instead)."
        )
    elif e.get("white", 1.0) > 1.0:
        text += f"Errors of the fixes are {e['white']:.2g} times as large as stated, and are taken for so large."
    return Finding("look", "gps-correlated" if e.get("bias_sigma") else "gps-errors", text.strip())


def class_rows(figures: Figures) -> list[dict[str, Any]]:
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


def whole_chi2(figures: Figures) -> tuple[float, float] | None:
    """χ² and degrees of freedom of all classes that have any; None where that is not known."""
    rows = [r for r in class_rows(figures) if number(r.get("dof")) and number(r.get("chi2_per_dof"))]
    dof = sum(float(r["dof"]) for r in rows)
    return (sum(float(r["chi2"]) for r in rows if number(r.get("chi2"))), dof) if dof > 0 else None


@dataclass(frozen=True, slots=True)
class Judged:
    """A ratio that is 1 where covariances are honest, held against its bounds.

    Parameters
    ----------
    code : {"chi2", "nees"}
    name : str
        ``χ²/dof``.
    about : str
        Of what.
    """

    code: str
    name: str
    ratio: float
    dof: float
    about: str = ""

    @property
    def said(self) -> str:
        """``consistent``, ``over-confident`` or ``pessimistic``."""
        return two_sided_bounds(self.ratio, self.dof, CONFIDENCE)[2]

    @property
    def level(self) -> Level:
        """One honest run in forty is outside on either side: bad is what one in a thousand is not."""
        if self.said == "consistent":
            return "good"
        return "bad" if self.ratio > two_sided_bounds(self.ratio, self.dof, CERTAIN)[1] else "look"

    @property
    def text(self) -> str:
        """The ratio with its bounds, in words."""
        low, high, said = two_sided_bounds(self.ratio, self.dof, CONFIDENCE)
        bounds = f"{CONFIDENCE * 100:g} % bounds {low:.3g} to {high:.3g} ({self.dof:.4g} degrees of freedom)"
        return f"{self.ratio:.3g}, {bounds}; {(IN_WORDS if self.code == 'nees' else RESIDUALS_IN_WORDS)[said]}"


def judged_chi2(figures: Figures) -> Judged | None:
    """χ² of the whole graph; None where nothing is redundant that could contradict, or that is not known."""
    found = whole_chi2(figures)
    if found is None or found[0] < EXACT * found[1]:
        return None
    return Judged("chi2", "χ²/dof", found[0] / found[1], found[1])


def of_the_start(figures: Figures, chi2: Judged) -> bool:
    """Does it say of the start of a refined path only that its noise was stated too large?"""
    return bool(figures.part("refine")) and chi2.said == "pessimistic"


def judged_nees(figures: Figures) -> list[Judged]:
    """NEES against the truth, where it is known, in each gauge in which it was taken."""
    m = dict(figures.metrics)
    gauges = [("nees", "first base fixed"), ("nees_aligned_landmarks", "landmarks, after an alignment")]
    bases = [f"{s.get('name')}_base_nees" for s in figures.sessions]
    if bases := [k for k in bases if m.get(f"{k}_dof", 0.0) > 0 and number(m.get(k))]:
        m |= {f"{k}_per_dof": m[k] / m[f"{k}_dof"] for k in bases}
        gauges += [(k, f"base of {k.removesuffix('_base_nees')} in the common frame") for k in bases]
    return [
        Judged("nees", "NEES/dof", m[f"{key}_per_dof"], m[f"{key}_dof"], gauge)
        for key, gauge in gauges
        if number(m.get(f"{key}_per_dof")) and m.get(f"{key}_dof", 0.0) > 0
    ]


def number(value: Any) -> bool:
    """Is it a finite number?"""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _state(figures: Figures) -> Finding:
    m = figures.metrics
    converged = figures.report.get("converged", m.get("converged"))
    if converged is None:
        return Finding("bad", "state", "Whether it is solved is not known: the folder does not say.")
    if not converged:
        return Finding("bad", "state", "Not solved: the graph is not at its optimum.")
    objective, gap = m.get("objective", m.get("join_chi2")), m.get("gap")
    value = "" if objective is None else f", objective {objective:.6g} (Σ rᵀ P⁻¹ r)"
    if gap is None:
        text = f"Solved: at the optimum by the solver's own test{value}; no gap to a batch solution was measured."
        return Finding("good", "state", text)
    scale = max(abs(objective or 0.0), 1.0)
    small = gap <= SMALL_GAP * scale
    text = "no higher than" if small else f"{gap:.3g} above"
    return Finding(
        "good" if small else "look",
        "state",
        f"Solved: at the optimum{value}, {text} what a batch solution reaches from there.",
    )


def _chi2(figures: Figures) -> Finding:
    if j := judged_chi2(figures):
        if of_the_start(figures, j):
            text = (
                f"χ²/dof of the graph at which the refined path began: {j.text}. The refined path does not rest on it."
            )
            return Finding("", "chi2", text)
        return Finding(j.level, "chi2", f"χ²/dof of the whole graph: {j.text}.")
    if whole_chi2(figures) is None:
        text = "χ² of the whole graph against its bounds: not known, or nothing in it is redundant."
    else:
        text = "χ² of the whole graph is 0: nothing in it is redundant that could contradict."
    return Finding("", "chi2", text)


def _said(row: ConsistencyTest) -> str:
    """A row of evidence with its figures."""
    if row.lasting and row.dof == 1.0:
        return f"{row.name} ({row.value:.1f} σ)"
    return f"{row.name} ({row.value:.3g} at {row.dof:.3g} degrees of freedom)"


def judged_trust(figures: Figures) -> CovarianceAssessment | None:
    """Can the covariances be believed, by what the log itself holds? None in folders that do not say."""
    if figures.report.get("evidence") is None:
        return None
    rows = tests_of_json(figures.report.get("evidence"))
    fixes = any(r.of == "fixes" for r in rows) or any(c.get("class") == "gps" for c in class_rows(figures))
    bend: Any = figures.report.get("nonlinearity")
    return assess_covariances(rows, fixes=fixes, nonlinearity=float(bend) if number(bend) else 0.0)


def _trust(figures: Figures) -> list[Finding]:
    """Can the covariances be believed? Nothing here was held against a truth, and the line says what it rests on."""
    found = judged_trust(figures)
    if found is None:
        return []
    said = "; ".join(_said(r) for r in found.speaking[:4]) + ("; …" if len(found.speaking) > 4 else "")
    rest = "It rests on residuals and on what was withheld, not on a truth"
    if figures.report.get("identities") == "run" and figures.metrics.get("landmarks", 0.0) > 0:
        rest += ", and takes for granted that landmarks were told apart rightly"
    if found.word == "over-confident":
        text = f"Covariances are too small: over-confident. What speaks against them: {said}. {rest}."
        return [Finding("bad" if found.chance < 1.0 - CERTAIN else "look", "trust", text)]
    if found.word == "undecided":
        held = f" What is known: {said}." if said else ""
        causes = []
        if found.missing:
            errors = " and of ".join(found.missing)
            causes.append(f"nothing in it could have seen that errors of {errors} are larger than stated")
        if found.bent:
            causes.append(
                "bearings are so vague beside the ranges that a landmark may be anywhere on an arc, and no Gaussian "
                f"describes that (squared shift by curvature per unknown {figures.report['nonlinearity']:.2g}, from "
                f"{MAX_NONLINEARITY:g} on maps are surer of themselves than they should be)"
            )
        text = f"Whether the covariances can be believed cannot be decided from this log: {'; '.join(causes)}.{held}"
        if figures.part("refine"):
            text += " The refined path takes its noise from its own residuals, which therefore do not judge it."
        return [Finding("", "trust", text)]
    if found.word == "pessimistic":
        text = (
            f"Covariances are larger than they need be: pessimistic. Too small are {said}; nothing lasts from one "
            f"residual to the next. {rest}."
        )
        return [Finding("look", "trust", text)]
    text = f"Covariances are consistent with all that this log can check: {said}. {rest}."
    return [Finding("good", "trust", text)]


def _nees(figures: Figures) -> list[Finding]:
    one = "One run: a sample, not a proof."
    said = [(j, f"NEES/dof against the truth ({j.about}): {j.text}. {one}") for j in judged_nees(figures)]
    none = "No truth was known, or none to compare with: nothing is said of the true error."
    return [Finding(j.level, "nees", text) for j, text in said] or [Finding("", "nees", none)]


def _tests(figures: Figures) -> list[Finding]:
    """Tests without truth that an honest run hardly ever fails; those that it passes are in the metrics."""
    out: list[Finding] = []

    def judge(what: str, value: Any, dof: Any, cause: str) -> None:
        if not (number(value) and number(dof) and dof > 0):
            return
        high = two_sided_bounds(float(value), float(dof), CERTAIN)[1]
        if value > high:
            limit = f"an honest run exceeds {high:.3g} less than once in a thousand runs"
            out.append(Finding("bad", "consistency-test", f"{what} is {value:.3g}, and {limit}: {cause}"))

    for row in class_rows(figures):
        cause = "these measurements contradict the others, or state too little noise."
        last = row.get("correlation_time")
        dof = float(row["dof"]) / (float(last or 1.0) if number(last) else 1.0) if number(row.get("dof")) else None
        judge(f"χ²/dof of the factors of kind “{row.get('class')}”", row.get("chi2_per_dof"), dof, cause)
        # a refined path holds fixes; the other factors of the graph were its start
        if row.get("verdict") == LASTING and (row.get("class") == "gps" or not figures.part("refine")):
            out.append(_lasting(row))
    m = figures.metrics
    cause = "the fixes are wrong, more correlated or less exact than they say, or the map is."
    judge("NIS/dof of the withheld fixes", m.get("gps_nis_joint_value"), m.get("gps_nis_joint_dof"), cause)
    median, expected, chance = (m.get(f"gps_distance_{k}") for k in ("median", "expected", "chance"))
    if median is not None and expected is not None and chance is not None and chance < LEVEL:
        text = (
            f"The fixes, of which none was used, lie {median:.3g} m from the path (the median); the covariances of "
            f"path and fixes explain {expected:.2g} m: {cause} With --set gps.use=all they hold the map."
        )
        out.append(Finding("bad" if chance < 1.0 - CERTAIN else "look", "gps-contradicts", text))
    alike, white = m.get("gps_nis_joint_autocorrelation"), m.get("gps_nis_joint_white")
    if alike is not None and white is not None and abs(alike) > white * CERTAIN_OVER_CONFIDENT:
        text = f"Errors of withheld fixes are alike from one to the next (correlation {alike:.2f}; independent ones "
        text += f"stay within ± {white:.2f} in 95 % of the runs): {_LASTS}"
        out.append(Finding("look", "gps-correlated", text))
    cause = (
        "submaps that saw the same landmarks disagree by more than they say; noise, mounting or association is wrong."
    )
    judge("Disagreement of loops over its expectation", m.get("loops_value"), m.get("loops_dof"), cause)
    return out


_LASTS = (
    "errors of the receiver last for longer than the time between fixes, and every fix counts as new. State them with "
    "gps.bias_sigma, or a larger gps.sigma."
)


def _lasting(row: Mapping[str, Any]) -> Finding:
    """Residuals that are alike from one to the next: the map follows errors that last."""
    text = (
        f"Residuals of the factors of kind “{row.get('class')}” are alike from one to the next (correlation "
        f"{float(row['lag1']):.2f}, {float(row['lag1_score']):.1f} σ; it lasts for "
        f"{float(row['correlation_time']):.3g} of them), whatever their size (χ²/dof "
        f"{float(row['chi2_per_dof']):.3g}): the map follows errors that last and is over-confident. "
    )
    if row.get("class") == "gps":
        text += _LASTS[0].upper() + _LASTS[1:]
        return Finding("look", "gps-correlated", text)
    return Finding("look", "correlated", text)


def _certificate(figures: Figures) -> Finding:
    found = figures.report.get("certificate")
    if found is None:
        text = "Whether the optimum is the global one is not known: no certificate was asked for."
        return Finding("", "certificate", text)
    text = str(found.get("verdict", found) if isinstance(found, Mapping) else found)
    return Finding("good" if text.startswith("certified") else "look", "certificate", f"Global optimum: {text}")


def _flagged(figures: Figures) -> list[Finding]:
    """Submaps that the front end flags: honest ones are flagged now and then, by chance."""
    counts = figures.part("flagged_submaps")
    flagged, n = counts.get("any", 0), figures.metrics.get("submaps", 0.0)
    if not (number(flagged) and flagged):
        return []
    why = ", ".join(f"{v:g} for {k}" for k, v in counts.items() if k != "any" and number(v))
    text = f"{flagged:g} of {n:g} submaps were flagged by the front end ({why})"
    usual = by_chance(int(n), FLAGGED, CERTAIN)
    if flagged <= usual:
        return [Finding("", "flagged", f"{text}: not more than chance flags.")]
    return [Finding("look", "flagged", f"{text}; chance flags more than {usual:g} in one honest run of a thousand.")]


def _passes(found: Mapping[str, Any]) -> list[Finding]:
    """Do submaps that came to one place by two ways show the same?"""
    share, points, doubted = found.get("share"), found.get("points"), found.get("doubted")
    if not (isinstance(share, float) and isinstance(points, int) and points and isinstance(doubted, list)):
        return []
    text = f"{1 - share:.1%} of {points} solid points of submaps stand in others that came there by another way"
    if share <= LOOK and len(doubted) < 2:
        return [Finding("good", "passes", f"{text}.")]
    pairs = ", ".join(f"{p[0]} and {p[1]}" for p in doubted[:3] if isinstance(p, list) and len(p) == 2)
    most = f" (most in submaps {pairs})" if pairs else ""
    text += (
        f"; {share:.1%} lie where these saw nothing{most}. Walls stand twice in the map where a loop is wrong or was "
        "not closed, unless so much was moved between the passes: look at the map. Other seeds (--seed), or the noise "
        "that the log states (--set calibrate.use=none), may find the loops that this run did not."
    )
    return [Finding("bad" if share > DENIED else "look", "passes", text)]


def _attempts(rows: Any) -> list[Finding]:
    """Of several graphs that were solved, which one was kept, and why."""
    if not (isinstance(rows, list) and len(rows) > 1 and all(isinstance(r, Mapping) for r in rows)):
        return []
    draws = len({r.get("draw") for r in rows})
    told = []
    for r in rows:
        share = r.get("share")
        denied = f"{share:.1%}" if isinstance(share, float) else "an unknown share"
        of = f" of draw {r.get('draw')}" if draws > 1 else ""
        told.append(f"{'with loops that were looked for' if r.get('loops') else 'with matches alone'}{of} {denied}")
    kept = next((k for k, r in enumerate(rows) if r.get("kept")), None)
    if kept is None:
        return []
    what = f"of {draws} draws of the particles" if draws > 1 else "of the same submaps"
    text = (
        f"{len(rows)} graphs {what} were tried. Passes of their maps deny so much of each other's points: "
        f"{', '.join(told)}. Number {kept + 1} is the result"
        + ("; its loops are those of `graphslam loops`." if rows[kept].get("loops") else ".")
    )
    settled = isinstance(share := rows[kept].get("share"), float) and share <= LOOK
    return [Finding("" if settled else "look", "passes-attempts", text)]


def _two_maps(found: Mapping[str, Any]) -> list[Finding]:
    """Groups of loops that cannot both be right, of which neither is in the graph: with either it is another map."""
    if not found:
        return []
    first, second = (_listed(loops) for loops in found["loops"])
    places = found["places"]
    spans = [" and ".join(f"{a:.0f} to {b:.0f} s" for a, b in p["times"]) for p in places]
    more = "; ".join(spans[:3]) + ("; …" if len(spans) > 3 else "")
    each = " Each of these places by itself may be as in the one or as in the other." if len(places) > 1 else ""
    text = (
        f"Two maps explain this log: one with {first}, one with {second}. Both cannot be right, and neither submaps "
        f"nor path tell which is. Nodes lie up to {found['apart_max']:.2f} m apart in them (at "
        f"{found['apart_max_time']:.0f} s; median {found['apart_median']:.2f} m). In dispute is how these stretches "
        f"lie to each other: {more}.{each} The map of this run has neither group, so that it drifts there; the other "
        f"two are in two_maps/ and in the map of the report. To do: {TWO_MAPS_DO}."
    )
    return [Finding("bad", "two-maps", text)]


def _listed(loops: Sequence[int]) -> str:
    shown = ", ".join(str(n) for n in loops[:6]) + (", …" if len(loops) > 6 else "")
    return f"loop{'s' * (len(loops) != 1)} {shown}" if loops else "none of them"


def _left_out(figures: Figures) -> list[Finding]:
    out: list[Finding] = []
    if figures.report.get("map_left_out"):
        out.append(Finding("look", "map-left-out", f"No fused map was made: {figures.report['map_left_out']}"))
    if figures.report.get("map_coarser"):
        out.append(Finding("look", "map-coarser", str(figures.report["map_coarser"])))
    out += [*_passes(figures.part("map_passes")), *_attempts(figures.report.get("map_attempts")), *_flagged(figures)]
    for e in figures.events:
        if e.get("event") == "imu-axes" and e.get("verdict") == "wrong":
            out.append(Finding("bad", "imu-axes", f"IMU {e.get('stream')}: {e.get('words')}"))
        if e.get("event") == "imu-axes" and e.get("verdict") == "unlike":
            moved, missed = e["turns"]
            text = (
                f"IMU {e.get('stream')}: the path turns otherwise than the gyro does, whatever its axes are: by "
                f"{missed:.2g} rad/s, where the gyro turns by {moved:.2g} rad/s. The path follows something else than "
                "the place, or unit or clock of the gyro is wrong."
            )
            out.append(Finding("bad", "imu-and-path", text))
        if e.get("event") == "imu-axes" and e.get("verdict") == "not checked":
            why = f"could not be checked ({e.get('why')})"
            text = f"IMU {e.get('stream')}: whether its axes are those of its mounting {why}."
            out.append(Finding("", "imu-axes", text))
        if e.get("event") == "imu-contradicted":
            text = f"IMU {e.get('stream', '')}".strip()
            line = f"{text} and submaps contradict each other: one of them states too little noise."
            out.append(Finding("bad", "imu-contradicted", line))
    for s in figures.sessions:
        common, rejected = s.get("common_landmarks"), s.get("rejected")
        if isinstance(common, int) and isinstance(rejected, int) and rejected > common:
            text = f"{common} common landmarks agree, {rejected} do not: it may not be the same place."
            out.append(Finding("bad", "session", f"Session {s.get('name')}: {text}"))
    return out
