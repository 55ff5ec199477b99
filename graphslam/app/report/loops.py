"""Sections of a report: loop ledger, loop closures between sessions, alternative hypotheses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from graphslam.app.report.folder import ReportFolder
from graphslam.app.report.markup import folded_section, missing_note, page_section, remark
from graphslam.core.markup import Markup, Row, html_element, html_table, is_numeric, join_parts, value_text

ORDER = ("accepted", "switched-off", "undone", "rejected")
COLUMNS = {
    **{"loop": "loop", "verdict": "verdict", "source": "source", "submap_i": "submap i", "submap_j": "submap j"},
    **{"i": "node i", "j": "node j", "score": "score", "gain": "gain", "fitness": "fitness", "margin": "margin"},
    **{"sigma": "σ [m]", "chi2": "χ²", "weight": "weight", "effect_predicted": "effect foreseen", "effect": "effect"},
    **{"effect_earlier": "on earlier factors", "factor_id": "factor", "why": "why", "gates": "gates"},
}
"""Keys as in ``graphslam loops --json``, with their headings."""


def loops_section(folder: ReportFolder) -> Markup:
    """Every loop with its current decision: accepted, switched off, undone, rejected."""
    title = "Loops"
    if folder.loops is None:
        why = folder.problems.get("events.jsonl", "does not say")
        return page_section(
            "loops", title, missing_note("the ledger of loops; events.jsonl ", why, "."), *_session_table(folder)
        )
    if not folder.loop_rows:
        return page_section("loops", title, _none(folder), *_session_table(folder))
    counts = folder.loops.counts()
    summary = ", ".join(f"{counts[v]} {v}" for v in (*ORDER, *sorted(set(counts) - set(ORDER))) if v in counts)
    rows = sorted(folder.loop_rows, key=_rank)
    # candidates that the registration rejected are the most frequent and the least interesting
    short = [r for r in rows if not str(r["why"]).startswith("registration")]
    hidden = [r for r in rows if str(r["why"]).startswith("registration")]
    parts: list[Any] = [
        remark(f"Loop closures: {len(rows)}; {summary}. `graphslam loops` lists them; --undo removes one.")
    ]
    parts.append(_ledger(short) if short else remark("Only those below."))
    if hidden:
        parts.append(folded_section(f"{len(hidden)} rejected by registration", _ledger(hidden)))
    parts += _history(folder)
    parts.append(
        remark(
            "χ²: against the graph without this loop closure. weight: of the robust kernel at the solution, 0 if it is "
            "not in the graph. effect: predicted and measured increase of the cost, and the part of earlier factors. "
            "– : not measured (front-end matches have a support and no registration). The gates are explained in the "
            "documentation of loop closures."
        )
    )
    return page_section("loops", title, *parts, *_session_table(folder))


def _none(folder: ReportFolder) -> Markup:
    backend = folder.config.get("backend", {})
    asked = backend.get("loops") is True if isinstance(backend, Mapping) else False
    if folder.kind == "merged":
        return remark("No loop closures within sessions. Loop closures between sessions are below.")
    if asked:
        return remark("No candidates were found.")
    return remark(
        "None: the search is off (backend.loops), and the front end gave no matches. Landmarks that are observed again "
        "close loops as factors of their submaps."
    )


def _rank(row: Mapping[str, Any]) -> tuple[int, int]:
    v = str(row["verdict"])
    return ORDER.index(v) if v in ORDER else len(ORDER), int(row["loop"])


def _ledger(rows: list[dict[str, Any]]) -> Markup:
    return html_table([Row(r, str(r["verdict"]), {"loop": r["loop"]}) for r in rows], COLUMNS, class_="loops")


def _history(folder: ReportFolder) -> list[Markup]:
    """All decisions on loops that have more than one."""
    assert folder.loops is not None
    times = Counter(d.loop for d in folder.loops.decisions)
    rows = [
        {"loop": d.loop, "verdict": d.verdict, "chi2": d.chi2, "weight": d.weight, "effect": d.effect, "why": d.why}
        for d in folder.loops.decisions
        if times[d.loop] > 1
    ]
    if not rows:
        return []
    columns = {k: COLUMNS[k] for k in ("loop", "verdict", "chi2", "weight", "effect", "why")}
    of = sum(n > 1 for n in times.values())
    return [folded_section(f"{of} loop closures with several decisions, in order", html_table(rows, columns))]


def _session_table(folder: ReportFolder) -> list[Markup]:
    """Candidates of loop closures between sessions, accepted or rejected."""
    if folder.kind != "merged":
        return []
    rows = []
    for s in folder.sessions:
        found = s.get("candidates")
        for c in found if isinstance(found, list) else []:
            if isinstance(c, Mapping):
                verdict = "accepted" if c.get("accepted") else "rejected"
                rows.append(Row({**c, "session": s.get("name"), "verdict": verdict}, verdict))
    if not rows:
        return [
            html_element("h3", "Loop closures between sessions"),
            remark("No places were compared. See the sessions above."),
        ]
    columns = {
        **{"session": "session", "verdict": "verdict", "submap_map": "submap in the map", "submap_here": "submap here"},
        **{"i": "node i", "j": "node j", "source": "source", "score": "score", "why": "why", "gates": "gates"},
    }
    return [html_element("h3", "Loop closures between sessions"), html_table(rows, columns, class_="links")]


def hypotheses_section(folder: ReportFolder) -> Markup:
    """Alternative graphs that were solved: topologies, or choices of matches and loops."""
    title = "Hypotheses and runners-up"
    found = {} if folder.clearest is None else folder.clearest
    candidates = [c for c in found.get("candidates", ()) if isinstance(c, Mapping)]
    if not candidates:
        return page_section("hypotheses", title, missing_note("other hypotheses: none were solved in this folder."))
    columns = {
        **{"verdict": "verdict", "choice": "choice", "support": "support", "withdrawn": "entry withdrawn"},
        **{"submaps": "submaps", "entries": "entries", "matches": "matches", "loops": "loops"},
        **{"objective": "objective", "chi2": "χ²", "dof": "dof", "contradicted": "contradicted"},
        **{"entropy": "entropy [nat m³]", "known_volume": "known [m³]", "why": "why"},
    }
    shown = {k: v for k, v in columns.items() if any(k in c for c in candidates)}
    why = remark(join_parts(["Why: ", str(found.get("why", "not said")), "."]))
    parts = [html_table(candidates, shown), why]
    entropy = found.get("refined_entropy")
    if is_numeric(entropy):
        text = "All are judged by the maps of their graphs; the chosen one was then refined by its scans: entropy "
        parts.append(remark(text, value_text(entropy), "."))
    return page_section("hypotheses", title, *parts)
