"""Metrics of a finished run from which its verdict is computed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from graphslam.evaluate.intervals import two_sided_width
from graphslam.evaluate.residual_consistency import NOT_TESTED

CONFIDENCE = 0.95
CERTAIN = 0.999
"""Confidence of tests whose failure is ``bad``: a consistent run fails with probability 0.001."""
CERTAIN_OVER_CONFIDENT = two_sided_width(CERTAIN) / two_sided_width(CONFIDENCE)
"""Ratio of the two-sided bounds of a normal variable at the two levels."""


@dataclass(frozen=True)
class RunMetrics:
    """Report, metrics and events of a finished run, in memory or from its folder.

    Parameters
    ----------
    report : mapping
        Content of ``run.json`` or ``merge.json``.
    metrics : mapping of str to float
    sessions : sequence of mapping
        Sessions of a merge.
    """

    report: Mapping[str, Any]
    metrics: Mapping[str, float]
    events: Sequence[Mapping[str, Any]] = ()
    sessions: Sequence[Mapping[str, Any]] = field(default_factory=tuple)

    @classmethod
    def of_rows(
        cls, report: Mapping[str, Any], rows: Iterable[Mapping[str, Any]], events: Sequence[Mapping[str, Any]] = ()
    ) -> RunMetrics:
        """From rows of metrics with ``key`` and ``value``."""
        return cls(report, {r["key"]: r["value"] for r in rows}, events)

    def part(self, name: str) -> Mapping[str, Any]:
        """A mapping in the report; empty if it is missing or no mapping."""
        found = self.report.get(name)
        return found if isinstance(found, Mapping) else {}


def is_finite_number(value: Any) -> bool:
    """Finite int or float, no bool?"""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def class_rows(figures: RunMetrics) -> list[dict[str, Any]]:
    """Rows of ``graph.classes``: χ² of each class of factors."""
    found = figures.part("graph").get("classes")
    return [r for r in found if isinstance(r, dict)] if isinstance(found, list) else []


def whole_chi2(figures: RunMetrics) -> tuple[float, float] | None:
    """χ² and degrees of freedom of all tested classes of factors; None if unknown, or if dof is not above 0.5."""
    rows = [
        r for r in class_rows(figures) if is_finite_number(r.get("dof")) and is_finite_number(r.get("chi2_per_dof"))
    ]
    chi2 = dof = 0.0
    for r in rows:
        dof += float(r["dof"])
        if r["class"] in NOT_TESTED:  # without this class the graph has fewer residuals and fewer unknowns
            dof -= max(float(r.get("rows", 0)) - NOT_TESTED[r["class"]], 0.0)
        elif is_finite_number(r.get("chi2")):
            chi2 += float(r["chi2"])
    return (chi2, dof) if dof > 0.5 else None  # dof is an integer up to rounding
