"""The first lines of a report: is it solved, is it honest, is it whole."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from graphslam.app.markup import Markup, element, figure_text, join
from graphslam.app.report_folder import ReportFolder
from graphslam.evaluate.without_truth import two_sided

GOOD, LOOK, BAD, PLAIN = "good", "look", "bad", ""
CONFIDENCE = 0.95
IN_WORDS = {
    "consistent": "inside them: the errors are as large as the covariances say",
    "over-confident": "above them: the errors are larger than the covariances say (over-confident)",
    "pessimistic": "below them: the errors are smaller than the covariances say (pessimistic)",
}
SMALL_GAP = 1e-6
"""Of the objective: an objective above the optimum by less is at it."""


def verdict(folder: ReportFolder) -> Markup:
    """Lines with a colour each; the words say the same as the colours."""
    lines = [*_state(folder)]
    if folder.kind != "interrupted":
        lines += [*_chi2(folder), *_nees(folder), _certificate(folder)]
        lines += _left_out(folder)
    return element("ul", *(element("li", text, class_=kind) for kind, text in lines), class_="verdict")


def class_rows(folder: ReportFolder) -> list[dict[str, Any]]:
    """χ² of each class of factors with its bounds: from the report, or as far as metrics of older runs hold it."""
    found = folder.part("graph").get("classes")
    if isinstance(found, list):
        return [r for r in found if isinstance(r, dict)]
    m = folder.values()
    out = []
    for key, ratio in m.items():
        if not (key.startswith("honesty_") and key.endswith("_chi2_per_dof")):
            continue
        stem = key.removesuffix("_chi2_per_dof")
        dof = m.get(f"{stem}_dof", math.nan)
        row = {"class": stem.removeprefix("honesty_"), "dof": dof, "chi2": ratio * dof, "chi2_per_dof": ratio}
        if dof > 0:
            row["low"], row["high"], row["verdict"] = two_sided(ratio, dof, CONFIDENCE)
        out.append(row | {"mean_weight": m.get(f"{stem}_mean_weight")})
    return out


def whole_chi2(folder: ReportFolder) -> tuple[float, float] | None:
    """χ² and degrees of freedom of all classes that have any; None where that is not known."""
    rows = [r for r in class_rows(folder) if _number(r.get("dof")) and _number(r.get("chi2_per_dof"))]
    dof = sum(float(r["dof"]) for r in rows)
    return (sum(float(r["chi2"]) for r in rows if _number(r.get("chi2"))), dof) if dof > 0 else None


def bounded(ratio: float, dof: float) -> tuple[str, str]:
    """A ratio with its bounds in words, and the colour of its line."""
    low, high, said = two_sided(ratio, dof, CONFIDENCE)
    text = f"{ratio:.3g}, {CONFIDENCE * 100:g} % bounds {low:.3g} to {high:.3g} ({dof:.4g} degrees of freedom); "
    return text + IN_WORDS[said], GOOD if said == "consistent" else BAD if said == "over-confident" else LOOK


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _state(folder: ReportFolder) -> list[tuple[str, Any]]:
    if folder.kind == "interrupted":
        return [
            (BAD, f"Not finished. {stopped(folder)}"),
            (PLAIN, "Go on with it: the same command once more, of “run” with --resume."),
        ]
    m = folder.values()
    converged = folder.report.get("converged", m.get("converged"))
    if converged is None:
        return [(BAD, "Whether it is solved is not known: the folder does not say.")]
    if not converged:
        return [(BAD, "Not solved: the graph is not at its optimum.")]
    objective, gap = m.get("objective", m.get("join_chi2")), m.get("gap")
    value = "" if objective is None else f", objective {figure_text(objective)} (Σ rᵀ P⁻¹ r)"
    if gap is None:
        return [
            (GOOD, f"Solved: at the optimum by the solver's own test{value}; no gap to a batch solution was measured.")
        ]
    scale = max(abs(objective or 0.0), 1.0)
    small = gap <= SMALL_GAP * scale
    text = "no higher than" if small else f"{gap:.3g} above"
    return [
        (GOOD if small else LOOK, f"Solved: at the optimum{value}, {text} what a batch solution reaches from there.")
    ]


def stopped(folder: ReportFolder) -> str:
    """Where an interrupted run stopped."""
    if not folder.submaps:
        return "It stopped before its first submap was finished."
    last = folder.submaps[-1]
    try:
        until = f"{float(last['interval'][1]):.2f} s"
        first = f"{float(folder.submaps[0]['interval'][0]):.2f} s"
    except (KeyError, TypeError, ValueError, IndexError):
        until = first = "an unknown time"
    return (
        f"It stopped after submap {last.get('key')} ({len(folder.submaps)} submaps, {first} to {until} of the log); "
        "nothing was solved yet that is on disk. How much of the log was left is not in the folder."
    )


def _chi2(folder: ReportFolder) -> list[tuple[str, Any]]:
    found = whole_chi2(folder)
    if found is None:
        return [(PLAIN, "χ² of the whole graph against its bounds: not known, or nothing in it is redundant.")]
    chi2, dof = found
    text, colour = bounded(chi2 / dof, dof)
    return [(colour, f"χ²/dof of the whole graph: {text}.")]


def _nees(folder: ReportFolder) -> list[tuple[str, Any]]:
    m = folder.values()
    judged = [("nees", "first base fixed"), ("nees_aligned_landmarks", "landmarks, after an alignment")]
    bases = [f"{s.get('name')}_base_nees" for s in folder.sessions]
    if bases := [k for k in bases if m.get(f"{k}_dof", 0.0) > 0 and _number(m.get(k))]:
        m |= {f"{k}_per_dof": m[k] / m[f"{k}_dof"] for k in bases}
        judged += [(k, f"base of {k.removesuffix('_base_nees')} in the common frame") for k in bases]
    out: list[tuple[str, Any]] = []
    for key, gauge in judged:
        if _number(m.get(f"{key}_per_dof")) and m.get(f"{key}_dof", 0.0) > 0:
            text, colour = bounded(m[f"{key}_per_dof"], m[f"{key}_dof"])
            out.append((colour, f"NEES/dof against the truth ({gauge}): {text}. One run: a sample, not a proof."))
    return out or [(PLAIN, "No truth was known, or none to compare with: nothing is said of the true error.")]


def _certificate(folder: ReportFolder) -> tuple[str, Any]:
    found = folder.report.get("certificate")
    if found is None:
        return PLAIN, "Whether the optimum is the global one is not known: no certificate was asked for."
    text = found.get("verdict", found) if isinstance(found, Mapping) else found
    return GOOD if str(text).startswith("certified") else LOOK, join(["Global optimum: ", figure_text(text)])


def _left_out(folder: ReportFolder) -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    if folder.report.get("map_left_out"):
        out.append((LOOK, f"No fused map was made: {folder.report['map_left_out']}"))
    flagged = folder.part("flagged_submaps").get("any", 0)
    if _number(flagged) and flagged:
        out.append((LOOK, f"{flagged:g} of the submaps were flagged by the front end."))
    for e in folder.events or []:
        if e.get("event") == "imu-axes" and e.get("verdict") == "wrong":
            out.append((BAD, f"IMU {e.get('stream')}: {e.get('words')}"))
    for s in folder.sessions:
        common, rejected = s.get("common_landmarks"), s.get("rejected")
        if isinstance(common, int) and isinstance(rejected, int) and rejected > common:
            text = f"{common} common landmarks agree, {rejected} do not: it may not be the same place."
            out.append((BAD, f"Session {s.get('name')}: {text}"))
    return out
