"""Findings on a landmark front end: observations used, particle depletion, gaps of the odometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations

HALF = 0.5
"""A share of used observations below this is reported as ``bad``."""
LEAST_ANCESTORS = 10
"""Independent samples below which their variance is off by a factor of two with more than 10 % probability (χ²₉ / 9 is
below 0.46 or above 1.88 in one case of ten)."""


def observation_findings(
    log: SensorLog, reports: Sequence[Mapping[str, Any]], dropped: Mapping[str, int]
) -> list[Finding]:
    """Findings on observations offered and used, on particles and on gaps.

    Parameters
    ----------
    reports : sequence of mapping
        Reports of all submaps.
    dropped : mapping of str to int
        Count per ``"stream: reason"``.
    """
    if not all("used" in r and "observations" in r for r in reports):
        return []
    name = log.of_type(LandmarkObservations)
    seen = sum(int(r["observations"]) for r in reports)
    offered = len(log[name].ranges) if name is not None else seen
    used = sum(int(r["used"]) for r in reports)
    trimmed = sum(int(r.get("trimmed", 0)) for r in reports)
    # of the landmark stream only
    lost = {k.partition(": ")[2]: n for k, n in dropped.items() if name is not None and k.startswith(f"{name}: ")}
    reasons = [f"{n} {k}" for k, n in lost.items()]
    if seen - used - trimmed > 0:
        reasons.append(f"{seen - used - trimmed} without a landmark, or the only one of it")
    if after := sum(int(r.get("after_gap", 0)) for r in reports):
        reasons.append(f"{after} right after a gap without wheels and scans")
    if trimmed:
        reasons.append(f"{trimmed} trimmed as outliers")
    why = ", ".join(reasons)
    out = [Finding("", "observations", f"observations used: {used} of {offered}{' — ' + why if why else ''}.")]
    if offered == 0 or used == 0:
        text = f"observations used: 0 of {offered}{', ' + why if why else ''} — the path is that of the odometry."
        out.append(Finding("bad", "observations-not-used", text))
    elif used < HALF * offered:
        text = (
            f"observations used: {used} of {offered} ({why}) — odometry and observations disagree on where landmarks "
            "are. Check units, signs and ids of the observations, and the speeds."
        )
        out.append(Finding("bad", "observations-not-used", text))
    return out + _particles(reports) + _gaps(reports)


def _particles(reports: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """A single particle with unknown data association, or covariances from too few independent particles."""
    if any(r.get("particles") == 1 and r.get("association") != "known" for r in reports):
        text = (
            "particles: 1 — its data association cannot be compared with another one. Set frontend.particles to 20 or "
            "more."
        )
        return [Finding("look", "particles", text)]
    made = [r for r in reports if "ancestors" in r and r.get("handover", "moments") == "moments"]
    few = [r for r in made if r["ancestors"] < LEAST_ANCESTORS]
    if not few:
        return []
    least = min(int(r["ancestors"]) for r in few)
    text = (
        f"particle ancestors: fewer than {LEAST_ANCESTORS} in {len(few)} of {len(made)} submaps (least: {least}) — the "
        "particles are depleted and the covariances too small. Use more particles, shorter submaps, or rbpf-ekf."
    )
    return [Finding("bad", "particles", text)]


def _gaps(reports: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Gaps in the odometry that were bridged."""
    out = []
    for r in reports:
        for g in r.get("gaps", ()):
            text = (
                f"gap in the odometry: {g['begin']:.1f} to {g['end']:.1f} s ({g['end'] - g['begin']:.1f} s) — bridged "
                f"with {g['speed']:.2f} ± {g['speed_sigma']:.2g} m/s and "
                f"{np.rad2deg(g['yaw_rate']):.1f} ± {np.rad2deg(g['yaw_rate_sigma']):.2g} °/s; "
            )
            if not g["unseen"]:
                out.append(Finding("look", "motion-gap", text + "landmark observations continue there."))
            elif r["scans"] == 1:
                text += "no observations either, so the map is split there. Check the pose after the gap."
                out.append(Finding("look", "motion-gap", text))
            else:
                text += (
                    "no observations either, which is too uncertain for a single map. Use rbpf-ekf or ekf, which split "
                    "the map there."
                )
                out.append(Finding("bad", "motion-gap", text))
    return out
