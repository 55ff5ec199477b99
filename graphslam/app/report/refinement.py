"""Section of a report on the refinement with scans: before and after, constants, rounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from graphslam.app.report.folder import ReportFolder
from graphslam.app.report.markup import missing_note, page_section, remark
from graphslam.app.report.sections import verdict_lines
from graphslam.core.markup import Markup, html_table, inline_picture, is_numeric, pair_list

MEANING = {
    "scale": ("wheel scale, distance too long by", "share"),
    "side": ("mounting: scanner yaw to the left of the path direction", "rad"),
    "rise": ("mounting: scanner pitch below the path direction", "rad"),
    "clock": ("odometry stamps early relative to the scans", "s"),
    "roll": ("constant error of the gravity direction, roll", "rad"),
    "pitch": ("constant error of the gravity direction, pitch", "rad"),
    "bend": ("wheel turn error per metre", "rad/m"),
    "turn": ("wheel turn error per radian", "share"),
}
"""Description and unit of each systematic error."""
PATHS = ("odometry", "graph", "refined")
CANDIDATES = (
    ("path error, aligned [m]", "", "path_rmse_aligned_graph", "path_rmse_aligned"),
    ("share of scan points that agree", "refine_agreement_odometry", "refine_agreement_graph", "refine_agreement"),
)
"""Compared quantities, with the metric of each path."""


def refinement_section(folder: ReportFolder) -> Markup:
    """Metrics of the path of the graph and of the refined one, and other quantities estimated from the scans."""
    title = "Refinement by scans"
    found = folder.part("refine")
    if folder.kind != "run":
        return page_section("refinement", title, remark("Only for finished single runs."))
    if not found:
        why = [remark(f.text) for f in verdict_lines(folder)[1] if f.code.startswith("refine-")]
        return page_section("refinement", title, remark("No refined path; the path is that of the graph."), *why)
    m = folder.values()
    rows = [{"": w} | {p: m.get(k) for p, k in zip(PATHS, keys)} for w, *keys in CANDIDATES if keys[-1] in m]
    parts: list[Any] = [html_table(rows, ("", *PATHS))] if rows else []
    parts += [_constants(found), *_bias(found)]
    rounds = found.get("rounds") or []
    columns = {
        **{"distance": "pairs within [m]", "range_sigma": "σ of a range [m]"},
        **{"surface_sigma": "σ of a surface [m]", "pairs": "pairs", "passes": "of other traversals"},
        **{"spread": "residual spread [m]", "moved": "path moved by [m]"},
    }
    parts.append(html_table(rounds, columns) if rounds else missing_note("rounds of the refinement."))
    apart = found.get("left_apart") or []
    if apart:
        listed = {f"{k + 1}": f"{a:.1f} s and {b:.1f} s" for k, (a, b) in enumerate(apart[:20])}
        parts += [remark(f"Pairs of places in the graph that contradict the scans ({len(apart)}):"), pair_list(listed)]
    parts.append(remark("The measurements of the refined path are listed under evidence."))
    return page_section("refinement", title, *parts)


def _constants(found: Mapping[str, Any]) -> Markup:
    rows = []
    for name, entry in (found.get("constants") or {}).items():
        words, unit = MEANING.get(name, (name, ""))
        rows.append({"what": words, "value": entry["value"], "sigma": entry["sigma"], "unit": unit})
    return html_table(rows, {"what": "systematic error", "value": "value", "sigma": "σ", "unit": "unit"})


def _bias(found: Mapping[str, Any]) -> list[Markup]:
    knots = [k for k in found.get("yaw_bias") or [] if all(is_numeric(v) for v in k)]
    if not knots:
        return []
    from graphslam.plots.refined import plot_yaw_bias
    from graphslam.plots.save import figure_png

    return [inline_picture(figure_png(plot_yaw_bias(None, knots)), "Yaw rate bias at its knots")]
