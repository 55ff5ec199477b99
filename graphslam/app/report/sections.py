"""Sections of a report: options, records, metrics, times, the graph, use of streams, events."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from graphslam.app.report.folder import ReportFolder
from graphslam.app.report.markup import compact_json, folded_section, missing_note, page_section, remark
from graphslam.app.run.files import RESUMED
from graphslam.app.run.summary import headline, summarise_run
from graphslam.app.verdict.checks import run_findings
from graphslam.app.verdict.figures import CONFIDENCE, RunMetrics, class_rows
from graphslam.core.config import dump_toml
from graphslam.core.findings import Finding
from graphslam.core.markup import (
    Markup,
    Row,
    html_element,
    html_table,
    is_numeric,
    item_list,
    join_parts,
    pair_list,
    value_text,
)
from graphslam.evaluate.metrics import is_time
from graphslam.evaluate.residual_consistency import two_sided_bounds
from graphslam.graph.ledger import EXCLUSIVE

BETTER = {"lower": "lower is better", "higher": "higher is better", "one": "1 is consistent"}
ROUTINE = frozenset(
    {"submap", "attitude", "between", "loop", "match-not-used"}
)  # reported elsewhere in the page, or once per submap
Rows = list[dict[str, Any]]
_UNFINISHED = "the run is not finished."


def what_was_run(folder: ReportFolder) -> Markup:
    """Names, seed, versions, and every option with its value."""
    r, options = folder.report, folder.config.get("run", {})
    parts: list[Any] = []
    if folder.kind == "merged":
        facts = {"merged by": r.get("by"), "solver": r.get("solver")}
        columns = {
            **{"name": "session", "source": "source", "submaps": "submaps", "hangs_on": "attached to"},
            **{"common_landmarks": "common landmarks", "rejected": "rejected", "alignment_rms": "alignment rms [m]"},
            **{"gps": "GPS", "links": "loop closures", "links_dropped": "loop closures dropped"},
            "T_world_first_base": "first base (x y θ, or x y z qx qy qz qw)",
        }
        shown = {k: v for k, v in columns.items() if any(k in s for s in folder.sessions)}
        parts += [
            pair_list(facts),
            html_table(folder.sessions, shown) if shown else missing_note("sessions in merge.json."),
        ]
        parts.append(remark("Options and versions are in the reports of the single runs."))
        return page_section("run", "What was run", *parts)
    options = options if isinstance(options, dict) else {}
    names = ("source", "frontend", "solver", "seed")
    parts.append(pair_list({k: r.get(k, options.get(k)) for k in names}))
    if folder.kind == "interrupted":
        parts.append(remark(stopping_line(folder)))
    versions = folder.part("versions")
    parts.append(pair_list(versions) if versions else missing_note("versions; ", _why(folder, "run.json")))
    if folder.config:
        parts.append(folded_section("All options (config.toml)", html_element("pre", dump_toml(folder.config))))
    else:
        parts.append(missing_note("options; ", _why(folder, "config.toml")))
    if folder.part("source_meta"):
        parts.append(folded_section("Metadata of the log", pair_list(_flat(folder.part("source_meta")))))
    return page_section("run", "What was run", *parts)


def records_section(folder: ReportFolder) -> Markup:
    """Numbers of records read and dropped with the reasons, and flagged submaps."""
    if folder.kind == "merged":
        return page_section("records", "Records", remark("A merge reads submaps, not records."))
    title = "Records read, dropped, flagged"
    if not folder.report:
        why = _UNFINISHED if folder.kind == "interrupted" else _why(folder, "run.json")
        return page_section("records", title, missing_note("counts of records; ", why))
    read, dropped = folder.part("records_read"), folder.part("records_dropped")
    flagged = {k: v for k, v in folder.part("flagged_submaps").items() if k != "any"}
    parts: list[Any] = [html_element("h3", "Read")]
    rows = [{"stream": stream, "records": n, "used": _use(stream, folder.ledger)} for stream, n in read.items()]
    parts.append(html_table(rows, ["stream", "records", "used"]) if rows else missing_note("counts of records read."))
    parts.append(html_element("h3", "Dropped"))
    lines = [{"what": k, "records": v} for k, v in dropped.items()]
    parts.append(html_table(lines, {"what": "stream and why", "records": "records"}) if lines else remark("Nothing."))
    parts.append(html_element("h3", "Submaps flagged by the front end"))
    marks = [{"why": k, "submaps": v} for k, v in flagged.items()]
    parts.append(html_table(marks, ["why", "submaps"]) if marks else remark("None."))
    return page_section("records", title, *parts)


def _use(stream: str, ledger: Rows | None) -> str:
    if ledger is None:
        return "unknown"
    n = _factors([r for r in ledger if r["stream"] == stream])
    return f"in {n} factor{'s' * (n != 1)}" if n else "in no factor (only for evaluation, or not used)"


def metrics_section(folder: ReportFolder) -> Markup:
    """Every metric except times, with its unit, the better direction, and bounds if there are any."""
    rows = [r for r in folder.metrics if not is_time(r.get("key")) and r.get("key") != RESUMED]
    if not rows:
        why = _UNFINISHED if folder.kind == "interrupted" else _why(folder, "metrics.json")
        return page_section("metrics", "Metrics", missing_note("metrics; ", why))
    bounds, folded_in = _bounds(folder.values())
    out = []
    for r in rows:
        key = str(r.get("key"))
        if key in folded_in:
            continue
        cells = {**r, "direction": BETTER.get(str(r.get("direction")), "")}
        out.append(cells | dict(zip(("bounds", "said"), bounds.get(key, ("", "")))))
    columns = {
        **{"key": "metric", "value": "value", "unit": "unit", "direction": "direction"},
        **{"bounds": f"{CONFIDENCE * 100:g} % bounds", "said": "verdict"},
    }
    return page_section(
        "metrics",
        "Metrics",
        remark("The metrics are explained in the documentation. – : no value."),
        html_table(out, columns),
    )


def _bounds(m: Mapping[str, float]) -> tuple[dict[str, tuple[str, str]], set[str]]:
    """Bounds and result of the test by metric; and the keys of the bounds, which get no row of their own."""
    out, folded_in = {}, set()
    for key in m:
        if not key.endswith("_low") or (stem := key.removesuffix("_low")) + "_high" not in m:
            continue
        owner = next((k for k in (f"{stem}_chi2_per_dof", f"{stem}_value") if k in m), None)
        if owner is None:
            continue
        low, high, value = m[key], m[f"{stem}_high"], m[owner]
        result = "overconfident" if value > high else "conservative" if value < low else "consistent"
        out[owner] = (f"{low:.3g} to {high:.3g}", result)
        folded_in |= {key, f"{stem}_high"}
    for key in m:
        stem = key.removesuffix("_per_dof")
        if stem != key and stem.startswith("nees") and m.get(f"{stem}_dof", 0.0) > 0:
            low, high, verdict = two_sided_bounds(m[key], m[f"{stem}_dof"], CONFIDENCE)
            out[key] = (f"{low:.3g} to {high:.3g}", verdict)
    return out, folded_in


def control_section(folder: ReportFolder) -> Markup:
    """Check points with their errors, and refused rows of control and check points."""
    checked, control = folder.part("check_points"), folder.part("control_points")
    if not checked and not control:
        return Markup("")
    parts: list[Any] = []
    if checked:
        names = ("verdict", "rmse", "nis_per_dof", "low", "high", "dof", "power", "aligned")
        parts += [html_element("h3", "Check points"), pair_list({k: checked.get(k) for k in names})]
        columns = {
            **{"line": "line", "name": "name", "place": "place", "frame": "frame", "error": "error [m]"},
            **{"sigma": "expected [m]", "nis": "NIS", "dof": "dof"},
        }
        parts.append(html_table(checked.get("rows", []), columns))
    if control:
        facts = {k: control.get(k) for k in ("source", "used", "frame")}
        facts["T_control_map"] = compact_json(control.get("T_control_map"))
        parts += [html_element("h3", "Control points"), pair_list(facts)]
    refused = [{"file": t["source"], **r} for t in (control, checked) if t for r in t.get("refused", [])]
    if refused:
        columns = {"file": "file", "line": "line", "why": "why"}
        parts += [html_element("h3", "Refused rows"), html_table(refused, columns)]
    return page_section("points", "Control and check points", *parts)


def times_section(folder: ReportFolder) -> Markup:
    """Seconds of each stage: the only part of the page that differs between two equal runs."""
    timed = [r for r in folder.metrics if is_time(r.get("key"))]
    seconds = {str(r["key"])[8:]: r.get("value") for r in timed if str(r["key"]).startswith("seconds_")}
    seconds = seconds or folder.part("seconds")
    rows = [r for r in timed if not str(r["key"]).startswith("seconds_")]
    if not seconds and not rows:
        why = _UNFINISHED if folder.kind == "interrupted" else "not in the folder."
        return page_section("times", "Times", missing_note("seconds of the stages; ", why))
    parts: list[Any] = [html_table([{"stage": k, "seconds": v} for k, v in seconds.items()], ["stage", "seconds"])]
    if rows:
        parts.append(html_table(rows, {"key": "metric", "value": "value", "unit": "unit"}))
    resumed = folder.values().get(RESUMED, folder.report.get(RESUMED))
    if is_numeric(resumed) and resumed:
        parts.append(remark(f"resumed run: {resumed:.0f} submaps were already finished."))
    return page_section("times", "Times", *parts)


def graph_section(folder: ReportFolder) -> Markup:
    """Number of nodes and factors, χ² by factor class with two-sided bounds."""
    if folder.kind == "interrupted":
        return page_section("graph", "Graph", missing_note("the graph; ", _UNFINISHED))
    m, g = folder.values(), folder.part("graph")
    facts = {
        "nodes": g.get("nodes"),
        "factors": g.get("factors"),
        "submaps": g.get("submaps", m.get("submaps")),
        "landmarks": g.get("landmarks", m.get("landmarks")),
        "free scalars": m.get("states"),
        "objective Σ rᵀ P⁻¹ r": m.get("objective", m.get("join_chi2")),
        "gap to the batch optimum": m.get("gap"),
    }
    parts: list[Any] = [pair_list(facts)]
    if not g:
        parts.append(missing_note("numbers of nodes and factors."))
    rows = class_rows(metrics_of_folder(folder))
    if not rows:
        return page_section("graph", "Graph", *parts, missing_note("χ² by class of factor."))
    columns = {
        **{"class": "class of factor", "factors": "factors", "rows": "scalars", "dof": "dof", "chi2": "χ²"},
        **{"chi2_per_dof": "χ²/dof", "low": f"{CONFIDENCE * 100:g} % from", "high": "to", "verdict": "verdict"},
        **{"mean_weight": "mean weight", "least_weight": "least weight"},
    }
    parts.append(html_table([Row(r, str(r.get("verdict", ""))) for r in rows], columns))
    parts.append(
        remark(
            "dof: number of scalars minus the unknowns determined by the class. χ²: without robust kernels. Weights: "
            "of the kernels. Above the bounds the assumed noise is too small, below them too large. Not tested: "
            "factors made of poses or of gravity that other factors contain already; their residuals are always small."
        )
    )
    return page_section("graph", "Graph", *parts)


def evidence_section(folder: ReportFolder) -> Markup:
    """Use of each stream by factors, and declared exceptions such as shared scans."""
    title = "Evidence: use of each stream"
    if folder.ledger is None:
        return page_section("evidence", title, missing_note("the ledger of evidence; ", _why(folder, "ledger.csv")))
    rows = [{**r, "factor": _kind_of_factor(r["factor"])} for r in folder.ledger]
    if not rows:
        return page_section("evidence", title, remark("No measurement was used."))
    groups = []
    for (stream, factor, kind), of in _grouped(rows, "stream", "factor", "kind"):
        first, last = min(r["t_start"] for r in of), max(r["t_end"] for r in of)
        groups.append(
            {"stream": stream, "factor": factor, "factors": _factors(of), "kind": kind}
            | {"first": first, "last": last, "seconds": sum(r["t_end"] - r["t_start"] for r in of)}
        )
    columns = {
        **{"stream": "stream", "factor": "used by", "factors": "factors", "kind": "kind", "first": "from [s]"},
        **{"last": "to [s]", "seconds": "seconds"},
    }
    return page_section(
        "evidence",
        title,
        html_table(groups, columns),
        html_element("h3", "Declared exceptions"),
        _exceptions([r for r in rows if r["kind"] != EXCLUSIVE]),
        remark("Kind “measurement”: used once; a second use is rejected. All rows are in ledger.csv."),
    )


def _exceptions(ledger: Rows) -> Markup:
    rows = [
        {"kind": kind, "factors": _factors(of), "note": note} for (kind, note), of in _grouped(ledger, "kind", "note")
    ]
    return html_table(rows, {"kind": "kind", "factors": "factors", "note": "reason"}) if rows else remark("None.")


def _grouped(rows: Rows, *columns: str) -> list[tuple[tuple[str, ...], Rows]]:
    """Rows by equal cells in some columns, sorted by them."""
    groups: dict[tuple[str, ...], Rows] = {}
    for r in rows:
        groups.setdefault(tuple(r[c] for c in columns), []).append(r)
    return sorted(groups.items(), key=lambda g: g[0])


def _factors(ledger: Rows) -> int:
    return len({r["factor_id"] for r in ledger})


def _kind_of_factor(label: str) -> str:
    """``levelled of x20 (factor 21)`` → ``levelled``: words before the first one with a digit."""
    words: list[str] = []
    for w in label.split():
        if any(c.isdigit() for c in w):
            break
        words.append(w)
    while words and words[-1] in ("of", "at", "to"):
        words.pop()
    return " ".join(words) or label


def events_section(folder: ReportFolder) -> Markup:
    """Other decisions and dropped data, one line per event; routine events only as counts."""
    if folder.events is None:
        why = _UNFINISHED if folder.kind == "interrupted" else _why(folder, "events.jsonl")
        return page_section("events", "Events", missing_note("events; ", why))
    counts = Counter(str(e.get("event", "?")) for e in folder.events)
    rows = [{"event": k, "times": n} for k, n in sorted(counts.items())]
    lines = [_line(e) for e in folder.events if str(e.get("event")) not in ROUTINE]
    parts: list[Any] = [html_table(rows, ["event", "times"]) if rows else remark("None.")]
    if lines:
        listed = item_list(lines)
        parts.append(listed if len(lines) <= 20 else folded_section(f"All {len(lines)} other events", listed))
    else:
        parts.append(remark("No other events."))
    return page_section("events", "Events", *parts)


def _line(event: Mapping[str, Any]) -> Markup:
    facts = [f"{k} {value_text(v)}" for k, v in event.items() if k != "event"]
    return join_parts([html_element("b", event.get("event", "?")), ": ", ", ".join(facts)])


def problems_section(folder: ReportFolder) -> Markup:
    """Parts that are missing in the page, and why."""
    lines = [join_parts([html_element("code", name), " ", why]) for name, why in sorted(folder.problems.items())]
    body = item_list(lines) if lines else remark("Nothing.")
    return page_section("missing", "What is missing", body)


def _why(folder: ReportFolder, name: str) -> str:
    return f"{name} {folder.problems.get(name, 'has no entry')}."


def _flat(values: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for k, v in values.items():
        name = f"{where}.{k}" if where else str(k)
        if isinstance(v, Mapping):
            out |= _flat(v, name)
        else:
            out[name] = compact_json(v) if isinstance(v, list) else v
    return out


def metrics_of_folder(folder: ReportFolder) -> RunMetrics:
    """Input of the verdict."""
    return RunMetrics(folder.report, folder.values(), folder.events or [], folder.sessions)


def verdict_lines(folder: ReportFolder) -> tuple[Finding, list[Finding]]:
    """First line of the verdict, and the others."""
    if folder.kind == "interrupted":
        found = interruption_lines(folder)
        return headline(found, [stopping_line(folder)]), found
    found = run_findings(metrics_of_folder(folder))
    if damage := folder.damage():
        found.insert(0, Finding("bad", "folder-damaged", f"files of the result are missing or damaged: {damage}."))
    return summarise_run(metrics_of_folder(folder), found), found


def interruption_lines(folder: ReportFolder) -> list[Finding]:
    """Findings on a run that was not finished."""
    return [
        Finding("bad", "interrupted", f"run: not finished — {stopping_line(folder)}"),
        Finding("", "resume", "resume: run the same command again (`graphslam run` with --resume)."),
    ]


def stopping_line(folder: ReportFolder) -> str:
    """Submap and time at which an interrupted run stopped."""
    if not folder.submaps:
        return "it stopped before the first submap was finished."
    last = folder.submaps[-1]
    try:
        until = f"{float(last['interval'][1]):.2f} s"
        first = f"{float(folder.submaps[0]['interval'][0]):.2f} s"
    except (KeyError, TypeError, ValueError, IndexError):
        until = first = "an unknown time"
    return (
        f"it stopped after submap {last.get('key')} ({len(folder.submaps)} submaps, {first} to {until} of the log); "
        "there is no solution yet."
    )
