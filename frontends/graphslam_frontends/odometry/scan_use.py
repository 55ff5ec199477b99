"""Which parts of a path scans can correct, and the covariance of the others.

The drift model of a filter describes errors that remain after scans are used. Without sufficient scans, or in a gap of
the motion, nothing corrects the errors of dead reckoning: the covariance there is that of dead reckoning over the
stretch, propagated to the end of the path.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import Odometry
from graphslam.core.submap import Submap
from graphslam_frontends.odometry.growing_steps import GrowingSteps
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.motion_check import check_motion, half_turn_seconds, motion_findings
from graphslam_frontends.odometry.motion_prior import OdometryBiases, interval_covariance
from graphslam_frontends.odometry.scan_matching import match_neighbours
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps

FEW = 10
"""Least number of returns in a step to constrain a pose: a wall needs several beams."""
LONG = 2.0
"""Shorter stretches without a correction are covered by the random walks of the filter [s]."""


def check_steps(log: SensorLog, config: StepConfig, drops: DropCounter | None = None) -> Steps:
    """Steps of a log for a grid front end: scans must have returns and are compared with the motion."""
    count = DropCounter()
    steps = make_steps(log, replace(config, match_scans=False), drops=count)
    if drops is not None:
        drops.counts.update(count.counts)
    require_returns(steps, count)
    spins = [half_turn_seconds(s.spin_rate) for s in log.streams.values() if isinstance(s, RangeScans)]
    found = tuple(motion_findings(check_motion(steps, max(spins, default=0.0))))
    if config.match_scans:  # after the check, because motion fused with the scans agrees with them
        steps = match_neighbours(steps, drops=drops)
    return replace(steps, findings=found)


def require_returns(steps: Steps, drops: DropCounter | None = None) -> None:
    """Raise if no beam of any scan has a return."""
    if np.any(steps.returns):
        return
    counts = {} if drops is None else drops.counts
    what = "; ".join(f"{k}: {n}" for k, n in counts.items() if "gap" not in k) or "none was there"
    far = len(steps.returns)
    if far:
        what += f"; {far} beams reached max_range, {steps.max_range:g} m, and met nothing"
    raise DataError(
        "no beam of any scan met anything: is the scanner alive, and are its ranges in metres?",
        where=steps.name,
        got=what,
        wanted="ranges between min_range and max_range (frontend.steps.min_range, frontend.steps.max_range)",
    )


def unobserved_stretches(steps: Steps | GrowingSteps) -> list[tuple[int, int]]:
    """Stretches ``(first, last)`` of steps, both inclusive and at least :data:`LONG`, without scan corrections.

    Steps with fewer than :data:`FEW` returns, and steps in a gap of the motion.
    """
    n = len(steps)
    bad: npt.NDArray[np.bool_] = steps.returned < FEW
    for a, b in zip(steps.gaps.begin, steps.gaps.end):
        if b - a >= LONG:
            bad[1:] |= (steps.times[1:] > a) & (steps.times[:-1] < b)
    bad[:1] = False  # the first step has no motion
    out = []
    for a, b in np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8))).reshape(-1, 2):
        if steps.times[b - 1] - steps.times[max(a - 1, 0)] >= LONG - 1e-6 and b <= n:
            out.append((int(a), int(b) - 1))
    return out


def unobserved_covariance(
    steps: Steps | GrowingSteps, stretches: list[tuple[int, int]], path: Array, first: int, last: int
) -> Array:
    """Covariance ``(d, d)`` that stretches without a correction add at the end of a path, right tangent.

    Parameters
    ----------
    stretches : list of (first, last)
        Of :func:`unobserved_stretches`.
    path : (last - first + 1, 7) or (…, 3)
        Poses at the steps ``first`` to ``last``.
    """
    group = group_of(path)
    total = np.zeros((group.dof, group.dof))
    for begin, end in stretches:
        a, b = max(begin, first + 1), min(end, last)
        if a > b:
            continue
        P, there = dead_reckoning_covariance(steps, a - 1, b), path[b - first]
        if group.dim == 3 and steps.tilt is not None:
            there = remove_roll_pitch(there)
        A = group.adjoint(group.between(path[-1], there))
        total += A @ P @ A.T
    return 0.5 * (total + total.T)


def dead_reckoning_covariance(steps: Steps | GrowingSteps, start: int, end: int, *, level_end: bool = True) -> Array:
    """Covariance of dead reckoning from step ``start`` to step ``end``, right tangent.

    From the source of the motion, with systematic errors; otherwise from the increments, as white noise.

    Parameters
    ----------
    level_end : bool
        The frame at the end is levelled if gravity is measured, as the frame at the start is.
    """
    if steps.errors is not None:
        gravity = steps.tilt is not None
        try:
            return steps.errors.between(start, end, level_start=gravity, level_end=gravity and level_end)[1]
        except DataError:  # recorded odometry has no levelled frames
            return steps.errors.between(start, end)[1]
    return interval_covariance(OdometryBiases(odometry=cast(Odometry, steps.odometry)), start, end)


def scan_findings(steps: Steps) -> list[Finding]:
    """Findings on gaps of the motion, and on stretches without scan corrections."""
    out = []
    gaps = [(a, b) for a, b in zip(steps.gaps.begin, steps.gaps.end) if b - a >= LONG]
    if gaps:
        a, b = max(gaps, key=lambda g: g[1] - g[0])
        text = (
            f"gaps in the odometry: {len(gaps)} of {LONG:g} s or more, the longest {b - a:.1f} s from {a:.2f} s — "
            "bridged with the motion that the odometry gives, or else the usual one; the covariances are increased."
        )
        out.append(Finding("look", "motion-gap", text))
    stretches = unobserved_stretches(steps)
    blind = [s for s in stretches if not _in_gap(steps, s)]
    if blind:
        seconds = sum(float(steps.times[b] - steps.times[a - 1]) for a, b in blind)
        metres = sum(float(steps.path_length[b] - steps.path_length[a - 1]) for a, b in blind)
        share = seconds / max(float(steps.times[-1] - steps.times[0]), 1e-9)
        text = (
            f"path without scan correction: {seconds:.1f} s ({metres:.1f} m, {100 * share:.0f} % of the time; "
            f"stretches: {len(blind)}) — fewer than {FEW} returns in a step; path and covariance there are dead "
            "reckoning."
        )
        out.append(Finding("bad" if share > 0.5 else "look", "motion-uncorrected", text))
    return out


def with_findings(submap: Submap, steps: Steps) -> Submap:
    """The submap with the findings of the steps in its report."""
    rows = [f.as_row() for f in (*steps.findings, *scan_findings(steps))]
    return replace(submap, report={**submap.report, "findings": rows}) if rows else submap


def _in_gap(steps: Steps, stretch: tuple[int, int]) -> bool:
    a, b = steps.times[stretch[0] - 1], steps.times[stretch[1]]
    return bool(np.any((steps.gaps.begin < b) & (steps.gaps.end > a) & (steps.gaps.end - steps.gaps.begin >= LONG)))
