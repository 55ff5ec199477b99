"""The front end ``ekf-slam``: a single EKF map of the whole log, and snapshots of its estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import ClassVar, Literal

from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import Gaussian
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.landmarks.ekf import EkfRun, require_bearings
from graphslam_frontends.landmarks.ekf_config import EkfConfig, EkfFilterConfig
from graphslam_frontends.landmarks.prepare import PreparedLog, prepare_log
from graphslam_studies.frontends.snapshot import Snapshot

OnScan = Callable[[int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfSlamConfig(EkfFilterConfig):
    """Settings of EKF-SLAM with a single map of the whole log."""

    @property
    def smoothing_noise(self) -> None:
        """A single map is not smoothed."""
        return None


def _prepare(log: SensorLog, config: EkfSlamConfig | EkfConfig, drops: DropCounter | None) -> PreparedLog:
    data = prepare_log(log, config, drops if drops is not None else DropCounter())
    require_bearings(data, log.name)
    return data


@dataclass(frozen=True, slots=True)
class EkfSlam(FrontEnd):
    """The front end ``ekf-slam``: one EKF map of the whole log, output as a single submap.

    Parameters
    ----------
    on_scan : callable, optional
        Called after each scan with the number of scans processed, e.g. for progress or timing. It does not affect
        the result.
    """

    config: EkfSlamConfig = field(default_factory=EkfSlamConfig)
    on_scan: OnScan | None = None
    name: ClassVar[str] = "ekf-slam"
    calibrates: ClassVar[str] = "observations"

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :class:`graphslam_frontends.base.FrontEnd`; there is only one submap."""
        if after is not None:
            return
        data = _prepare(log, self.config, drops)
        run = EkfRun(data, self.config, 0, data.t_start)
        while run.next < len(data):
            run.advance()
            if self.on_scan is not None:
                self.on_scan(run.next)
        yield run.submap(0, {"ended": "end-of-log"})


def ekf_snapshots(
    log: SensorLog,
    config: EkfSlamConfig | EkfConfig,
    *,
    seed: SeedTree | None = None,
    cuts: Sequence[int],
    joint: Literal["last", "all", "never"] = "last",
    drops: DropCounter | None = None,
    on_scan: OnScan | None = None,
) -> Iterator[Snapshot]:
    """Run EKF-SLAM with a single map and yield its estimate after given numbers of scans.

    Parameters
    ----------
    config : EkfSlamConfig or EkfConfig
        Of an `EkfConfig`, settings for local maps are ignored.
    seed : SeedTree, optional
        Not used, because the filter is deterministic; for the same signature as other filters.
    cuts : sequence of int
        Numbers of scans, strictly increasing, from 1 to the number of usable scans. The filter stops after the last
        one.
    joint : {"last", "all", "never"}
        Which snapshots have the joint Gaussian.
    drops : DropCounter, optional
        Counts records that are not used.
    on_scan : callable, optional
        As in :class:`EkfSlam`.
    """
    if joint not in ("last", "all", "never"):
        raise ConfigError(f"joint = {joint!r}; known: last, all, never")
    wanted = [int(k) for k in cuts]
    data = _prepare(log, config, drops)
    if not wanted or wanted[0] < 1 or any(b <= a for a, b in pairwise(wanted)) or wanted[-1] > len(data):
        raise ConfigError(f"cuts must increase strictly within 1 … {len(data)}, got {wanted[:3]} … {wanted[-1:]}")
    return _snapshots(EkfRun(data, config, 0, data.t_start), wanted, joint, on_scan)


def _snapshots(run: EkfRun, cuts: list[int], joint: str, on_scan: OnScan | None) -> Iterator[Snapshot]:
    for cut in cuts:
        while run.next < cut:
            run.advance()
            if on_scan is not None:
                on_scan(run.next)
        slots = run.map.landmarks(run.config.min_hits)
        gaussian = None
        if joint == "all" or (joint == "last" and cut == cuts[-1]):
            gaussian = Gaussian(*run.map.joint(slots), (2,))
        positions, covariances = run.map.marginals(slots)
        yield Snapshot(
            scan=cut,
            time=float(run.data.observations.times[cut - 1]),
            pose=run.map.pose,
            pose_covariance=run.map.pose_covariance,
            landmark_ids=run.identities(slots),
            landmarks=positions,
            landmark_covariances=covariances,
            gaussian=gaussian,
        )
