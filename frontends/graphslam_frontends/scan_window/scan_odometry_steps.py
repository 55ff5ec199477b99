"""Steps with the motion of scan-to-window odometry, for front ends that use the motion of steps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.records import Odometry
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_frontends.scan_window.tracker import TrackedPath, track_steps


@dataclass(frozen=True, slots=True)
class ScanOdometryErrors:
    """Covariance of a tracked path over any interval (`IntervalCovariance`), from scan-to-window odometry.

    Parameters
    ----------
    steps : Steps
        Before their motion was replaced.
    """

    steps: Steps
    config: ScanWindowConfig
    _tracks: list[tuple[list[int], TrackedPath]] = field(default_factory=list, init=False, repr=False, compare=False)

    def prepare(self, starts: Iterable[int]) -> None:
        """Track the steps once for intervals that begin at ``starts`` and end no later than the next one begins."""
        begins = sorted({0, *(int(k) for k in starts)})
        if not any(set(begins) <= set(known) for known, _ in self._tracks):
            self._tracks.append((begins, track_steps(self.steps, self.config, begins)))

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        """Motion from step ``start`` to step ``end`` and its covariance ``(d, d)``, right tangent."""
        if not 0 <= start <= end < len(self.steps):
            raise DataError(
                "no such interval of the path", got=(start, end), wanted=f"0 ≤ start ≤ end < {len(self.steps)}"
            )
        found = self._of(start, end)
        if found is None:
            self.prepare([start])
            found = self._of(start, end)
        assert found is not None
        poses = a, b = found.poses[start], found.poses[end]
        joint = found.joints[end]
        if start == end:
            d = len(joint) // 2
            joint = np.tile(joint[d:, d:], (2, 2))
        frames = remove_roll_pitch(a) if level_start else a, remove_roll_pitch(b) if level_end else b
        return group_of(a).between(*frames), relative_covariance(poses, frames, joint)

    def _of(self, start: int, end: int) -> TrackedPath | None:
        for begins, made in self._tracks:
            if start in begins:
                later = begins[begins.index(start) + 1 :]
                if not later or end <= later[0]:
                    return made
        return None


def odometry_from_scans(steps: Steps, config: ScanWindowConfig) -> Steps:
    """Steps with the increments, and in 3-D the roll and pitch, of scan-to-window odometry.

    Consecutive increments are correlated, because both are matched to the same window. The covariances of the
    increments stay those of the motion, as weights; :class:`ScanOdometryErrors` gives the covariance of the path over
    any interval. Roll and pitch are estimates of the path, so their σ is 0.
    """
    made, g = track_steps(steps, config), group_of(steps.odometry.increments)
    increments = np.concatenate([g.identity[None], g.between(made.poses[:-1], made.poses[1:])])
    tilt = None if steps.tilt is None else se3.roll_pitch_jacobian(made.poses)[0]
    return replace(
        steps,
        odometry=Odometry(times=steps.times, increments=increments, covariances=steps.odometry.covariances),
        tilt=tilt,
        tilt_sigma=0.0,
        errors=ScanOdometryErrors(steps, config),
    )


def refuse_fused_steps(config: StepConfig) -> None:
    """Reject steps whose motion is already fused with the same scans."""
    if config.match_scans:
        raise ConfigError(
            "frontend.steps.match_scans = true fuses the motion with the scans, which scan-to-window odometry would "
            "use a second time; wanted false"
        )
