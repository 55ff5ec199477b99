"""What a landmark front end made of the sightings: how many it used, and what its particles can say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations

HALF = 0.5
"""If most of the sightings are not used, those that are used are the exception."""
LEAST_ANCESTORS = 10
"""Independent samples below which a variance made of them is off by a factor of two more often than once in ten
(χ²₉ / 9 is below 0.46 or above 1.88 in one case of ten)."""


def sighting_findings(
    log: SensorLog, reports: Sequence[Mapping[str, Any]], dropped: Mapping[str, int]
) -> list[Finding]:
    """Lines on the sightings offered and used, and on the particles.

    Parameters
    ----------
    reports : sequence of mapping
        Of all submaps.
    dropped : mapping of str to int
        Per ``"stream: reason"``.
    """
    if not all("used" in r and "observations" in r for r in reports):
        return []
    name = log.of_type(LandmarkObservations)
    seen = sum(int(r["observations"]) for r in reports)
    offered = len(log[name].ranges) if name is not None else seen
    used = sum(int(r["used"]) for r in reports)
    trimmed = sum(int(r.get("trimmed", 0)) for r in reports)
    # a reason counts records or sightings; those of sightings say so
    lost = {k.partition(": ")[2]: n for k, n in dropped.items() if name is not None and k.startswith(f"{name}: ")}
    reasons = [f"{n} {k}" for k, n in lost.items()]
    if seen - used - trimmed > 0:
        reasons.append(f"{seen - used - trimmed} that no landmark explains, or a single one")
    if after := sum(int(r.get("after_gap", 0)) for r in reports):
        reasons.append(f"{after} right after a gap without wheels and scans")
    if trimmed:
        reasons.append(f"{trimmed} trimmed as outliers")
    why = ", ".join(reasons)
    out = [
        Finding("", "sightings", f"Sightings used of those offered: {used} of {offered}{': ' + why if why else ''}.")
    ]
    if offered == 0 or used == 0:
        text = f"No sighting was used ({offered} offered{': ' + why if why else ''}): the path is that of the wheels."
        out.append(Finding("bad", "sightings-not-used", text))
    elif used < HALF * offered:
        text = (
            f"Only {used} of {offered} sightings were used ({why}): wheels and sightings hardly agree on where "
            "landmarks are seen again. Check units, signs and identities of the sightings, and the speeds."
        )
        out.append(Finding("bad", "sightings-not-used", text))
    return out + _particles(reports) + _gaps(reports)


def _particles(reports: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """One particle, or covariances made of particles that have few independent ones left."""
    if any(r.get("particles") == 1 and r.get("association") != "known" for r in reports):
        text = (
            "A single particle decided which sighting is of which landmark, and no other could contradict it. Set "
            "frontend.particles to 20 or more."
        )
        return [Finding("look", "particles", text)]
    made = [r for r in reports if "ancestors" in r and r.get("handover", "moments") == "moments"]
    few = [r for r in made if r["ancestors"] < LEAST_ANCESTORS]
    if not few:
        return []
    least = min(int(r["ancestors"]) for r in few)
    text = (
        f"In {len(few)} of {len(made)} maps made of particles fewer than {LEAST_ANCESTORS} of the first particles have "
        f"descendants (least: {least}): the covariances are the scatter of next to nothing, and too small. Use more "
        "particles, shorter submaps, or rbpf-ekf, which smooths its submaps."
    )
    return [Finding("bad", "particles", text)]


def _gaps(reports: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Gaps of the motion that were bridged."""
    out = []
    for r in reports:
        for g in r.get("gaps", ()):
            text = (
                f"No motion was recorded from {g['begin']:.1f} to {g['end']:.1f} s ({g['end'] - g['begin']:.1f} s). It "
                f"was bridged by {g['speed']:.2f} ± {g['speed_sigma']:.2g} m/s and {np.rad2deg(g['yaw_rate']):.1f} ± "
                f"{np.rad2deg(g['yaw_rate_sigma']):.2g} °/s, which is how the robot drives elsewhere in the log; "
            )
            if not g["unseen"]:
                out.append(Finding("look", "motion-gap", text + "the sightings went on, and decide."))
            elif r["scans"] == 1:
                text += (
                    "no sighting came either, so the map is split there. Look whether the place is right afterwards."
                )
                out.append(Finding("look", "motion-gap", text))
            else:
                text += (
                    "no sighting came either, and a single map over the whole log cannot hold so large an uncertainty. "
                    "Use rbpf-ekf or ekf, which split their maps there."
                )
                out.append(Finding("bad", "motion-gap", text))
    return out
