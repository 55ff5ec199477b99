"""What a joined map says of itself, in words: is it at its optimum, and are its covariances honest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from graphslam.app.run.verdict import bounded, number
from graphslam.core.findings import Finding
from graphslam.join.submap_solver import SubmapEstimate

SAME = 1e-6
"""Relative difference of two objectives that are one."""


def join_verdict(row: Mapping[str, Any], estimate: SubmapEstimate, left_out: Sequence[str] = ()) -> list[Finding]:
    """Lines of a verdict on one joined map.

    Parameters
    ----------
    row : mapping
        Of :func:`graphslam.app.compare.join_json`.
    estimate : SubmapEstimate
        The map that it describes.
    left_out : sequence of str
        What the graph of the submaps holds besides.
    """
    out = [_state(row, estimate)]
    if (dof := row.get("dof")) is not None and row["objective_polished"] is not None:
        if dof <= 0:
            text = "χ² says nothing of the covariances: nothing in these submaps is redundant that could contradict."
            out.append(Finding("", "chi2", text))
        else:
            text, level = bounded(row["objective_polished"] / dof, dof)
            out.append(Finding(level, "chi2", f"χ²/dof at the optimum: {text}."))
    if number(row.get("nees")) and row["nees_dof"]:
        n = row["nees_dof"]
        text, level = bounded(row["nees"] / n, n)
        before = row.get("nees_unpolished")
        said = f"; before the refinement {before / n:.3g}" if number(before) else ""
        out.append(Finding(level, "nees", f"NEES/n against the truth: {text}{said}."))
    if left_out:
        text = f"Not part of it, because joiners take submaps and what ties them alone: {', '.join(left_out)}."
        out.append(Finding("", "left-out", text))
    return out


def _state(row: Mapping[str, Any], estimate: SubmapEstimate) -> Finding:
    own, best = row["objective"], row["objective_polished"]
    if best is None:
        text = f"As the method leaves it, not refined: χ² {own:.6g}; its optimum is not known."
        return Finding("look", "state", text)
    if not estimate.converged:
        return Finding("bad", "state", f"Not solved: the refinement did not reach an optimum (χ² {best:.6g}).")
    gap = f", {own - best:.3g} below where the method left it" if own > best else ""
    return Finding("good", "state", f"Solved: at a least-squares optimum, χ² {best:.6g}{gap}.")


def compare_verdict(rows: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Whether all methods of a comparison end at one optimum; nothing where there was no refinement.

    Parameters
    ----------
    rows : sequence of mapping
        Of :func:`graphslam.app.compare.methods_json`.
    """
    ends = {r["method"]: r["objective_polished"] for r in rows if number(r["objective_polished"])}
    if len(ends) < 2:
        return []
    low, high = min(ends.values()), max(ends.values())
    if high - low <= SAME * max(low, 1.0):
        text = f"All {len(ends)} methods end at one optimum, χ² {low:.6g}."
        return [Finding("good", "one-optimum", text)]
    best = ", ".join(m for m, value in ends.items() if value - low <= SAME * max(low, 1.0))
    text = f"The methods end at different optima, χ² {low:.6g} ({best}) to {high:.6g}: the higher ones are local."
    return [Finding("look", "one-optimum", text)]
