"""Report and verdict of a run on its control points and check points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from graphslam.app.verdict.figures import CERTAIN
from graphslam.core.control import ControlTable
from graphslam.core.findings import Finding, Level
from graphslam.evaluate.check_points import CheckPoints
from graphslam.evaluate.covariance_assessment import LEAST_POWER
from graphslam.evaluate.metrics import Metrics
from graphslam.evaluate.residual_consistency import two_sided_bounds
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.control import ControlRecord, DistanceRecord
from graphslam.graph.sensors.control import ControlFactors

MEANINGS = {
    "consistent": "errors match the covariances",
    "conservative": "errors are smaller than the covariances",
    "overconfident": "errors are larger than the covariances",
    "wrong": "errors are more than three standard deviations on average; the map or the rows are wrong",
    "not tested": "the rows are too few or too uncertain to show a covariance that is too small by two",
}
"""Meaning of each result of the test."""
SHOWN = 5
"""Largest number of refused rows in a finding; the report lists all."""


def control_facts(graph: FactorGraph, table: ControlTable) -> dict[str, Any]:
    """The control rows in ``run.json``."""
    events = [e for e in graph.events if e.get("event") == "control-refused"]
    refused = sorted([*table.refused, *((int(e["line"]), str(e["why"])) for e in events)])
    used = [r for r in graph.records.values() if isinstance(r, (ControlRecord, DistanceRecord))]
    out: dict[str, Any] = {
        "source": table.source,
        "used": len(used),
        "refused": [{"line": line, "why": why} for line, why in refused],
    }
    frame = ControlFactors.of(graph).frame
    if frame and graph.values.datum is not None:
        datum = graph.values.datum.copy()
        datum[: graph.dim] += ControlFactors.of(graph).origin
        out |= {"frame": frame, "T_control_map": datum.tolist()}
    return out


def check_metrics(out: Metrics, found: CheckPoints) -> None:
    """Add the metrics of the test on check points."""
    out.add("check_rows", len(found.rows))
    if not found.rows:
        return
    out.add("check_rmse", found.rmse, "m", "lower")
    if found.dof > 0:
        low, high = found.bounds
        out.add("check_nis_value", found.nis / found.dof, "", "one")
        out.add("check_nis_low", low)
        out.add("check_nis_high", high)
        out.add("check_nis_dof", found.dof)
        out.add("check_power", found.power, "", "higher")


def left_out_of_refinement(held: int, used: int) -> Finding:
    """Finding: control rows of the graph that do not constrain the refined path."""
    text = (
        f"control points: {held} of {used} rows hold the refined path — landmarks, distances, and rows beside GPS "
        "fixes are in the initial graph only. To do: compare with a run without refinement (--set refine.use=false)."
    )
    return Finding("look", "control-points-refined", text)


def control_findings(report: Mapping[str, Any]) -> list[Finding]:
    """Lines of the verdict."""
    out = []
    for kind in ("control", "check"):
        what, key = f"{kind} points", f"{kind}_points"
        if (facts := report.get(key)) is None:
            continue
        n = facts["used"] if key == "control_points" else len(facts["rows"])
        refused: Sequence[Mapping[str, Any]] = facts["refused"]
        if refused or not n:
            lines = "; ".join(f"line {r['line']}: {r['why']}" for r in refused[:SHOWN])
            more = "; …" if len(refused) > SHOWN else ""
            text = f"{what} ({facts['source']}): {n} of {n + len(refused)} rows used — refused: {lines}{more}."
            out.append(Finding("look", f"{kind}-points-refused", text))
        elif key == "control_points":
            frame = f"; their frame ({facts['frame']}) is a variable of the graph" if "frame" in facts else ""
            out.append(Finding("", "control-points", f"{what} ({facts['source']}): {n} rows used{frame}."))
    checked = report.get("check_points")
    return [*out, _tested(checked)] if checked is not None and checked["rows"] else out


def _tested(facts: Mapping[str, Any]) -> Finding:
    """``check points: NIS …``."""
    verdict, n, dof, ratio = facts["verdict"], len(facts["rows"]), facts["dof"], facts["nis_per_dof"]
    head = f"check points ({facts['source']}): RMSE {facts['rmse']:.3g} m at {n} rows"
    if ratio is None:
        text = f"{head}; not tested — the rows determine no more than where their frame is. Measure more check points."
        return Finding("", "check-points", text)
    text = (
        f"{head}; NIS {ratio:.3g} per degree of freedom [{facts['low']:.3g}, {facts['high']:.3g}; {dof:g} dof] — "
        f"{verdict}: {MEANINGS[verdict]}. Power {facts['power']:.2f} [≥ {LEAST_POWER:g}] against covariances "
        "that are too small by two"
    )
    text += f"; {facts['aligned']} dof moved the frame of the rows onto the map." if facts["aligned"] else "."
    if verdict in ("conservative", "overconfident") and facts["power"] < LEAST_POWER:
        text += " Most of the expected error is that of the rows: check their sigma first."
    level: Level = {"consistent": "good", "not tested": "", "wrong": "bad"}.get(verdict, "look")  # type: ignore[assignment]
    if verdict == "overconfident" and ratio > two_sided_bounds(1.0, dof, CERTAIN)[1]:
        level = "bad"
    if level in ("look", "bad") and verdict != "conservative":
        worst = max(facts["rows"], key=lambda r: r["nis"] / max(r["dof"], 1))
        text += f" Check line {worst['line']} first: error {worst['error']:.3g} m, expected {worst['sigma']:.2g} m."
    return Finding(level, "check-points-wrong" if verdict == "wrong" else "check-points", text)
