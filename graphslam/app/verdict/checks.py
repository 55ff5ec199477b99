"""The verdict of a run: is it solved, is it consistent, is it complete, and was all requested data used.

Each line has the form ``subject: value [bounds] — meaning``, with one imperative sentence if the user should do
something. The command line prints the lines, ``--json`` and ``run.json`` contain them, and the report shows them. Lines
from stored metrics are computed again wherever they are shown (:data:`CHECKS`); findings during the run
(:mod:`graphslam.app.verdict.observed`) are read from ``run.json``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from graphslam.app.verdict.covariances import check_chi2, check_classes, check_nees, check_trust
from graphslam.app.verdict.figures import RunMetrics
from graphslam.app.verdict.maps import check_map, check_sessions, check_two_maps
from graphslam.app.verdict.solution import check_certificate, check_flagged, check_imu_path, check_solved
from graphslam.core.findings import Finding, findings_of_json


@dataclass(frozen=True, slots=True)
class Check:
    """One check of the stored metrics of a run.

    Parameters
    ----------
    find : callable
        Returns the lines of the verdict.
    codes : tuple of str
        Codes of all its lines: stored lines with these codes are replaced whenever a verdict is shown.
    """

    find: Callable[[RunMetrics], list[Finding]]
    codes: tuple[str, ...]


CHECKS = [
    Check(check_solved, ("state",)),
    Check(check_chi2, ("chi2",)),
    Check(check_trust, ("trust",)),
    Check(check_nees, ("nees",)),
    Check(check_classes, ("consistency-test", "correlated", "gps-contradicts")),
    Check(check_certificate, ("certificate",)),
    Check(check_two_maps, ("two-maps",)),
    Check(check_map, ("map-left-out", "map-coarser", "passes", "passes-attempts")),
    Check(check_flagged, ("flagged",)),
    Check(check_imu_path, ("imu-axes", "imu-and-path", "imu-contradicted")),
    Check(check_sessions, ("session",)),
]
"""All checks, in the order of their lines."""


def findings_from_metrics(figures: RunMetrics) -> list[Finding]:
    """Lines of the verdict from the stored metrics."""
    return [line for check in CHECKS for line in check.find(figures)]


def run_findings(figures: RunMetrics) -> list[Finding]:
    """All lines of a finished run: from metrics, and those of ``report["verdict"]`` that no check computes."""
    known, found = {code for check in CHECKS for code in check.codes}, findings_from_metrics(figures)
    stored = findings_of_json(figures.report.get("verdict"))
    return found + [f for f in stored if f.code not in known and f not in found]
