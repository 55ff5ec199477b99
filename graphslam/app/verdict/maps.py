"""Is the map complete, and do its parts agree? Fused map, alternative graphs, two contradicting maps, sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.findings import Finding
from graphslam.maps.contradictions import LOOK

TWO_MAPS_DO = "check which of the two is right there, or add GPS there and run again"
"""Advice if two maps explain a log."""
CONTRADICTED = 0.1
"""A map is bad if overlapping submaps contradict more than this fraction of its occupied voxels."""


def check_map(figures: RunMetrics) -> list[Finding]:
    """Was the fused map made, and do its overlapping parts agree?"""
    out: list[Finding] = []
    if figures.report.get("map_left_out"):
        out.append(Finding("look", "map-left-out", f"fused map: not made — {figures.report['map_left_out']}"))
    if figures.report.get("map_coarser"):
        out.append(Finding("look", "map-coarser", str(figures.report["map_coarser"])))
    return [*out, *_passes(figures.part("map_passes")), *_attempts(figures.report.get("map_attempts"))]


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
    return [Finding("bad" if share > CONTRADICTED else "look", "passes", text)]


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
    clear = isinstance(share := rows[kept].get("share"), float) and share <= LOOK
    return [Finding("" if clear else "look", "passes-attempts", text)]


def check_two_maps(figures: RunMetrics) -> list[Finding]:
    """Two groups of loop closures that exclude each other; neither is in the graph."""
    found = figures.part("two_maps")
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
        f"{found['apart_median']:.2f} m). The relative pose of these stretches is unclear: {more}.{each} The map of "
        f"this run uses neither group and drifts there; both maps are in two_maps/ and in the report. "
        f"To do: {TWO_MAPS_DO}."
    )
    return [Finding("bad", "two-maps", text)]


def _listed(loops: Sequence[int]) -> str:
    shown = ", ".join(str(n) for n in loops[:6]) + (", …" if len(loops) > 6 else "")
    return f"loop{'s' * (len(loops) != 1)} {shown}" if loops else "none of these loops"


def check_sessions(figures: RunMetrics) -> list[Finding]:
    """Are the sessions of a merge from one place?"""
    out: list[Finding] = []
    for s in figures.sessions:
        common, rejected = s.get("common_landmarks"), s.get("rejected")
        if isinstance(common, int) and isinstance(rejected, int) and rejected > common:
            text = f"{common} common landmarks agree, {rejected} do not — it may be another place."
            out.append(Finding("bad", "session", f"session {s.get('name')}: {text}"))
    return out
