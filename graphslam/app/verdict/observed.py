"""Findings during a run: use of every stream, anomalies in it, findings of the front end, outliers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from graphslam.app.run.stream_use import StreamUse
from graphslam.core.findings import Finding, Level
from graphslam.core.submap import Submap
from graphslam.evaluate.stream_checks import StreamFinding

QUARTER = 0.25
"""Lower limit of the used fraction of a requested stream, part of which may be withheld; below, a line is written."""
ALIKE = 2
"""Number of submaps with the same finding that are shown in full; of further ones only the keys are listed."""
MOSTLY = 0.95
"""Lower limit of the used fraction of an input stream; below, a line is written."""


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
        Anomalies of the raw streams; ``bad`` becomes ``look`` if the stream was not used.
    submaps : sequence of Submap
        Their reports may contain ``findings``: rows of :meth:`Finding.as_row`, for the run or for the submap.
    events : sequence of mapping
        Events of the graph; ``outlier``, ``gps-errors``, ``no-effect`` and ``beacon-not-placed`` become lines.
    """
    counts = "; ".join(
        s.text() + (f" ({s.why})" if s.why and not (s.used or s.asked or s.role == "input") else "") for s in streams
    )
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
    """Findings of front ends on submaps; of equal ones, the first two in full and the keys of the others."""
    findings = [(s.key, f) for s in submaps for row in s.report.get("findings", ()) if (f := Finding.from_row(row))]
    submaps_of: dict[tuple[Level, str], list[int]] = {}
    out = []
    for key, f in findings:
        keys = submaps_of.setdefault((f.level, f.code), [])
        if key not in keys:
            keys.append(key)
        if len(keys) <= ALIKE:
            out.append(f)
    for (level, code), keys in submaps_of.items():
        if more := keys[ALIKE:]:
            some = ", ".join(map(str, more[:12])) + (", …" if len(more) > 12 else "")
            text = f"{code}: {len(more)} more submaps ({some}) — details are in their reports."
            out.append(Finding(level, code, text))
    return out


def _of_events(events: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Lines from events of the graph: outliers, GPS errors, options without effect, beacons without position."""
    out = []
    outliers = Counter(str(e["group"]) for e in events if e.get("event") == "outlier")
    if outliers:
        counts = ", ".join(f"{n} of class {group}" for group, n in sorted(outliers.items()))
        text = f"outliers: {outliers.total()} factors ({counts}) — removed by graduated non-convexity; see events."
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
