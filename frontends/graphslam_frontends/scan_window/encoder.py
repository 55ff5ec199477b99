"""Encoder offset of a scanner that rotates about a vertical axis, estimated from the log.

Wheels move straight ahead. With an encoder offset the scans are rotated about the robot, so that matched scans show a
sideways motion at a constant angle. The tracker estimates this direction
(:mod:`~graphslam_frontends.scan_window.tracker`). Here it is estimated with the scans of one scanner, subtracted from
its angles, and estimated again until it is about zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.range_scans import RangeScans
from graphslam.core.se3 import quat_to_matrix
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.tracker import ScanToWindowOdometry

UPRIGHT = 0.9
"""Least cosine of the tilt of a vertical axis."""
NAMED = 0.006
"""Offset from which a run reports it [rad]: mounts are not more accurate."""
SECONDS = 150.0
"""Longest part of the log used [s]: enough for 0.01°."""
_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class EncoderOffset:
    """Offset of an encoder: reading minus true angle.

    Parameters
    ----------
    offset, sigma : float
        About the x axis of the mount [rad].
    """

    stream: str
    offset: float
    sigma: float


def turning_heads(log: SensorLog) -> dict[str, float]:
    """Streams of scanners that rotate about a vertical axis: 1.0 if it points up, -1.0 if down."""
    out = {}
    for name, s in log.streams.items():
        if isinstance(s, RangeScans) and s.spin is not None and np.any(s.spin_rate):
            up = float(quat_to_matrix(s.T_base_mount[3:])[2, 0])
            if abs(up) > UPRIGHT:
                out[name] = float(np.sign(up))
    return out


def encoder_offset(
    log: SensorLog,
    steps: StepConfig | None = None,
    window: ScanWindowConfig | None = None,
    *,
    stream: str | None = None,
) -> EncoderOffset:
    """Estimate the encoder offset of a rotating scanner.

    Parameters
    ----------
    log : SensorLog
        With scans of the scanner, and motion in a known direction: wheels without lateral slip.
    steps : StepConfig, optional
        As in the front end.
    stream : str, optional
        Of the scanner; by default the only one.
    """
    heads = turning_heads(log)
    if stream is None and len(heads) == 1:
        stream = next(iter(heads))
    if stream not in heads:
        raise MissingDataError(
            "no scanner that turns about an upright axis", where=log.name, got=stream, wanted=", ".join(heads) or "one"
        )
    scans = log[stream]
    begin = float(scans.times[0])
    part = log.slice(begin, begin + SECONDS)
    head: RangeScans = part[stream]
    assert head.spin is not None
    config = replace(steps or StepConfig(), scanners=(stream,))
    found = 0.0
    for _ in range(_ROUNDS):
        turned = replace(part, streams={**part.streams, stream: replace(head, spin=head.spin - found)})
        tracker = ScanToWindowOdometry(make_steps(turned, config), window or ScanWindowConfig())
        seen = [tracker.step().lost == "" for _ in range(len(tracker.steps))]
        if np.mean(seen) < 0.3:
            raise DataError(
                "too few scans could be put on each other",
                where=stream,
                got=f"{np.mean(seen):.0%}",
                wanted="30 % or more",
            )
        askew, sigma = float(tracker.biases[2]), float(np.sqrt(tracker.P[tracker.w + 2, tracker.w + 2]))
        found -= heads[stream] * askew
        if abs(askew) < max(0.2 * sigma, 2e-4):
            break
    return EncoderOffset(stream, found, sigma)


def encoder_findings(
    log: SensorLog, steps: StepConfig, window: ScanWindowConfig, askew: float, sigma: float
) -> list[Finding]:
    """A finding if the encoder has an offset; only checked if ``askew`` [rad] of the run is significant."""
    heads = turning_heads(log)
    if len(heads) != 1 or abs(askew) < max(0.5 * NAMED, 5.0 * sigma):
        return []
    try:
        e = encoder_offset(log, steps, window)
    except DataError:
        return []
    if abs(e.offset) < NAMED:
        return []
    degrees = np.rad2deg(abs(e.offset))
    text = (
        f"encoder of {e.stream}: {degrees:.1f} ± {np.rad2deg(e.sigma):.1f}° too {'much' if e.offset > 0 else 'little'} "
        "— the scans show a constant sideways motion; the encoder has an offset, or the mount is rotated. Subtract the "
        "offset from the encoder angles, and run again."
    )
    return [Finding("bad", "scan-encoder", text)]
