"""The front end ``scan-window``: scan-to-window odometry, cut into submaps with evidence grids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from graphslam.core.config import check_options
from graphslam.core.errors import DataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.base import Watch
from graphslam_frontends.odometry.scan_use import scan_findings
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.encoder import encoder_findings
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_frontends.scan_window.scan_odometry_steps import refuse_fused_steps
from graphslam_frontends.scan_window.tracker import ScanMatch, ScanToWindowOdometry
from graphslam_frontends.stepwise import StepwiseFrontEnd

LAST = "end-of-log"
MANY = 0.2
"""Share of lost scans above which they are reported."""

LIFT = 0.25
"""Height of the base above a voxel boundary, in voxels, if gravity is measured: otherwise a floor at a boundary between
two voxel layers could be in either of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowSubmapConfig:
    """How the path is cut into submaps, and their grids."""

    length: float = 30.0
    """Path length of a submap [m] …"""
    seconds: float = 12.0
    """… and its least duration [s]."""
    voxel_size: float = 0.2
    """Edge of a voxel [m]."""
    hit: float = 0.7
    """Probability that a voxel is occupied, given that a beam ended in it."""

    def __post_init__(self) -> None:
        check_options(self, "submap: ", {"> 0": "length voxel_size", "≥ 0": "seconds"})
        self.beam_model()

    def beam_model(self) -> BeamModel:
        """Sensor model of a beam for the evidence grid."""
        return BeamModel(hit=self.hit)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanWindowFrontEndConfig:
    """The front end ``scan-window``."""

    steps: StepConfig = field(default_factory=StepConfig)
    """Conversion of the log to steps."""
    window: ScanWindowConfig = field(default_factory=ScanWindowConfig)
    """Matching of each scan to the surfaces of the window before it."""
    submap: WindowSubmapConfig = field(default_factory=WindowSubmapConfig)
    """Cutting of the path, and maps of the submaps."""

    def __post_init__(self) -> None:
        refuse_fused_steps(self.steps)


@dataclass(frozen=True, slots=True)
class ScanWindow(StepwiseFrontEnd):
    """The front end ``scan-window``.

    Needs a stream of beams (a spinning scanner, point clouds, planar scans) and one of motion. It is deterministic and
    causal. A resumed run processes the path again from its start (a few milliseconds per step), because the window and
    the systematic errors continue from submap to submap, and outputs only the missing submaps.
    """

    config: ScanWindowFrontEndConfig = field(default_factory=ScanWindowFrontEndConfig)
    name: ClassVar[str] = "scan-window"

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :class:`~graphslam_frontends.base.FrontEnd`."""
        first = 0 if after is None else after.key + 1
        c = self.config
        for s in scan_window_submaps(self.steps(log, drops=drops), c.window, c.submap, first_key=first):
            if s.report["ended"] == LAST:
                found = encoder_findings(log, c.steps, c.window, s.report["askew"], s.report["askew_sigma"])
                rows = [*s.report.get("findings", []), *(f.as_row() for f in found)]
                s = replace(s, report={**s.report, **({"findings": rows} if rows else {})})
            yield s


def scan_window_submaps(
    steps: Steps, window: ScanWindowConfig, config: WindowSubmapConfig, *, first_key: int = 0
) -> Iterator[Submap]:
    """Submaps of scan-to-window odometry, in order.

    Parameters
    ----------
    first_key : int
        Earlier submaps are not output.
    """
    n = len(steps)
    if n < 2:
        raise DataError("too few steps for a submap", where=steps.name, got=n, wanted="at least 2")
    tracker, along = ScanToWindowOdometry(steps, window), steps.path_length
    start, key, states = 0, 0, []
    for k in range(n):
        found = tracker.step()
        if k == 0:
            tracker.begin()
        states.append((tracker.pose, tracker.joint, found))
        full = along[k] - along[start] >= config.length and steps.times[k] - steps.times[start] >= config.seconds - 1e-6
        if k == n - 1 or full:
            if key >= first_key:
                ended = LAST if k == n - 1 else "length"
                yield _submap(steps, (start, k), states, config, key, ended, tracker)
            tracker.begin()
            # the scan of a step between two submaps is in the map of the one that ends there
            start, key, states = k, key + 1, [(tracker.pose, tracker.joint, found)]


def _submap(
    steps: Steps,
    interval: tuple[int, int],
    states: list[tuple[Array, Array, ScanMatch]],
    config: WindowSubmapConfig,
    key: int,
    ended: str,
    tracker: ScanToWindowOdometry,
) -> Submap:
    start, end = interval
    gravity = steps.tilt is not None
    poses = np.array([s[0] for s in states])
    lift = LIFT * config.voxel_size if gravity else 0.0
    g = group_of(poses)
    begin, exit = (_base(p, lift, gravity) for p in (poses[0], poses[-1]))
    path = g.between(np.broadcast_to(begin, poses.shape), poses)
    C = np.array([relative_covariance((poses[0], p), (begin, p), joint) for p, joint, _ in states])
    grid = EvidenceGrid(config.voxel_size, model=config.beam_model(), dim=g.dim)
    dropped = 0
    for k, T in zip(range(start, end + 1), path):
        points, origins, returns = steps.scan(k)
        if len(points) and (k > start or k == 0):
            dropped += grid.insert_scan(points, origins, pose=T, max_range=steps.max_range, returns=returns).dropped
    report = {"ended": ended, "steps": end - start, "length": round(float(np.ptp(steps.path_length[[start, end]])), 3)}
    report |= {"beams_dropped": int(dropped), **_summary([s[2] for s in states[int(start > 0) :]])}
    report["yaw_bias"], report["askew"] = float(tracker.biases[0]), float(tracker.biases[2])
    report["askew_sigma"] = float(np.sqrt(tracker.P[tracker.w + 2, tracker.w + 2]))
    findings = [*steps.findings, *scan_findings(steps)] if key == 0 else []
    findings += _lost(key, end - start, report)
    if findings:
        report["findings"] = [f.as_row() for f in findings]
    return Submap(
        key=key,
        interval=(float(steps.times[start]), float(steps.times[end])),
        exit_pose=g.between(begin, exit),
        exit_covariance=relative_covariance((poses[0], poses[-1]), (begin, exit), states[-1][1]),
        trajectory=Trajectory(steps.times[start : end + 1], path, C),
        grid=grid,
        uses=steps.uses,
        report=report | {"exit_covariance": "window"},
    )


def _base(body: Array, lift: float, gravity: bool) -> Array:
    """Base frame of a submap that begins at a body pose."""
    if not gravity:
        return body
    base = remove_roll_pitch(body)
    base[2] -= lift
    return base


def _summary(found: list[ScanMatch]) -> dict[str, Any]:
    """Summary of the scan matches."""
    lost = Counter(f.lost for f in found if f.lost and f.lost != "start")
    spreads = [f.spread for f in found if np.isfinite(f.spread)]
    overlaps = [f.overlap for f in found if np.isfinite(f.overlap)]
    return {
        "scans_lost": sum(lost.values()),
        "scans_lost_why": dict(sorted(lost.items())),
        "overlap_median": float(np.median(overlaps)) if overlaps else None,
        "spread_median": float(np.median(spreads)) if spreads else None,
    }


def _lost(key: int, steps: int, report: dict[str, Any]) -> list[Finding]:
    lost = report["scans_lost"]
    if lost <= MANY * steps:
        return []
    why = ", ".join(f"{n} for {WHY[code]}" for code, n in report["scans_lost_why"].items())
    text = (
        f"unmatched scans in submap {key}: {lost} of {steps} ({why}) — the path and its covariance there are those of "
        "the odometry."
    )
    return [Finding("bad" if lost > 0.5 * steps else "look", "scans-lost", text)]


WHY = {
    "points": "too few returns",
    "overlap": "too few points on surfaces",
    "spread": "a large spread of the distances",
    "surprise": "a correction that contradicts the odometry",
}
