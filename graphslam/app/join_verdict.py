"""Verdict on a joined map: convergence, and consistency of its covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from graphslam.app.compare import MapEstimate
from graphslam.app.run.summary import headline, length_text
from graphslam.app.verdict.chi_square import ChiSquareTest
from graphslam.app.verdict.figures import is_finite_number
from graphslam.core.findings import Finding

SAME = 1e-6
"""Relative difference below which two objectives count as equal."""


def join_verdict(row: Mapping[str, Any], estimate: MapEstimate) -> list[Finding]:
    """Findings on one joined map.

    Parameters
    ----------
    row : mapping
        Of :func:`graphslam.app.compare.join_json`.
    estimate : SubmapEstimate or GraphEstimate
        The map of that row.
    """
    out = [_state(row, estimate)]
    judged = {j.code: j for j in join_consistency_tests(row)}
    if chi2 := judged.get("chi2"):
        out.append(Finding(chi2.level, "chi2", f"chi-square at the optimum: {chi2.text}."))
    elif row.get("dof") is not None and row["objective_polished"] is not None:
        text = "covariances: not tested by chi-square — no measurement in these submaps is redundant."
        out.append(Finding("", "chi2", text))
    if nees := judged.get("nees"):
        before: Any = row.get("nees_unpolished")
        note = f"; before refinement {before / nees.dof:.3g}" if is_finite_number(before) else ""
        out.append(Finding(nees.level, "nees", f"NEES (ground truth): {nees.text}{note}."))
    return out


def join_consistency_tests(row: Mapping[str, Any]) -> list[ChiSquareTest]:
    """Ratios that test the covariances of a joined map: χ²/dof and NEES/n."""
    out = []
    best: Any = row["objective_polished"]
    if (dof := row.get("dof") or 0) > 0 and is_finite_number(best):
        out.append(ChiSquareTest("chi2", "χ²/dof", best / dof, dof))
    if is_finite_number(row.get("nees")) and row["nees_dof"]:
        out.append(ChiSquareTest("nees", "NEES/n", row["nees"] / row["nees_dof"], row["nees_dof"]))
    return out


def join_headline(row: Mapping[str, Any], findings: Sequence[Finding], *, submaps: int, length: float) -> Finding:
    """First line of the verdict on one joined map.

    Parameters
    ----------
    row : mapping
        Of :func:`graphslam.app.compare.join_json`.
    findings : sequence of Finding
        Of :func:`join_verdict`.
    submaps : int
        Number of joined submaps.
    length : float
        Of the path through the nodes [m].
    """
    marks = f", {row['landmarks']} landmarks" if row["landmarks"] else ""
    tests = join_consistency_tests(row)
    known = any(j.code == "nees" for j in tests)
    facts = [f"{length_text(length)} through {submaps} submaps{marks}", "" if known else "true error unknown"]
    return headline(findings, facts, tests, known=known)


def _state(row: Mapping[str, Any], estimate: MapEstimate) -> Finding:
    own, best = row["objective"], row["objective_polished"]
    if best is None:
        text = f"solution: χ² {own:.6g} — not refined; the optimum is unknown."
        return Finding("look", "state", text)
    if not estimate.converged:
        return Finding(
            "bad", "state", f"solution: χ² {best:.6g} — not converged; the refinement did not reach an optimum."
        )
    gap = f"; the method alone is {own - best:.3g} higher" if own > best else ""
    return Finding("good", "state", f"solution: χ² {best:.6g} — converged to a least-squares optimum{gap}.")


def compare_verdict(rows: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Finding: do all methods of a comparison reach the same optimum? Empty if fewer than two were refined.

    Parameters
    ----------
    rows : sequence of mapping
        Of :func:`graphslam.app.compare.methods_json`.
    """
    ends = {r["method"]: r["objective_polished"] for r in rows if is_finite_number(r["objective_polished"])}
    if len(ends) < 2:
        return []
    low, high = min(ends.values()), max(ends.values())
    if high - low <= SAME * max(low, 1.0):
        text = f"optimum: χ² {low:.6g} — the same for all {len(ends)} methods."
        return [Finding("good", "one-optimum", text)]
    best = ", ".join(m for m, value in ends.items() if value - low <= SAME * max(low, 1.0))
    text = f"optimum: χ² {low:.6g} ({best}) to {high:.6g} — the higher ones are local."
    return [Finding("look", "one-optimum", text)]
