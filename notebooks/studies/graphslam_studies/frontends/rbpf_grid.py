"""RBPF SLAM on evidence grids: one filter over the whole log, in 6 DoF (or 2-D); the baseline of the SegSLAM paper.

Each particle has a pose and a map. There is no segmentation and no matching: a loop closes if a particle returns to the
right place in its own map. Forty particles rarely do so after a long path, and their spread does not show it, because
after resampling they have a recent common ancestor. So the output covariance is their spread *plus* the covariance of
dead reckoning along the path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import group_of
from graphslam.core.progress import Bar
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.base import Watch
from graphslam_frontends.grid.ancestry import Ancestry
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter import FilterCounts, GridFilter, GridParticles
from graphslam_frontends.grid.filter_error_model import PASSED, ErrorPassThrough, interpolate_covariances
from graphslam_frontends.odometry.scan_use import (
    dead_reckoning_covariance,
    unobserved_covariance,
    unobserved_stretches,
    with_findings,
)
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.covariance import exit_covariance
from graphslam_frontends.stepwise import StepwiseFrontEnd
from graphslam_studies.frontends.drift import DriftModel

KNOTS = 33
"""Number of poses on the path where the passed-on covariance is computed; it is interpolated between them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RbpfResult:
    """Result of a filter over all steps.

    Parameters
    ----------
    times : (n,)
        Of the steps [s].
    path_length : (n,)
        Odometry path length up to each step [m].
    effective : (n,)
        N_eff after the scan of each step, before resampling.
    resampled : (n,) bool
    particles : GridParticles
        At the end, with their grids.
    best : int
        Index of the particle whose map and path are output.
    tally : FilterCounts
        Wall time by part, and counts of beams.
    used_bytes : int
        Memory of all maps at the end; shared parts count once.
    uses : frozenset of str
        Streams that were used.
    """

    name: str
    times: Array
    path_length: Array
    effective: Array
    resampled: npt.NDArray[np.bool_]
    ancestry: Ancestry
    particles: GridParticles
    best: int
    tally: FilterCounts
    used_bytes: int
    uses: frozenset[str] = frozenset()

    @property
    def poses(self) -> Array:
        """Poses of all particles at the end ``(N, 7)`` or ``(N, 3)``."""
        return self.particles.poses

    @property
    def final_pose(self) -> Array:
        """Pose of the best particle at the end."""
        return self.particles.poses[self.best]

    @property
    def seconds(self) -> float:
        """Wall time of all parts together [s]."""
        return float(sum(self.tally.seconds.values()))

    def trajectory(self, drift: Callable[[float], Array] | None = None) -> Trajectory:
        """Path of the best particle, ``T_map_body``.

        Parameters
        ----------
        drift : callable, optional
            Path length [m] → covariance ``(d, d)`` of dead reckoning. If given, the path has covariances: second moment
            of all particles' paths about this one, plus this drift. Otherwise it has none, because the second moment
            alone would be far too small.
        """
        path = self.ancestry.path(self.best)
        if drift is None:
            return Trajectory(self.times, path)
        group = group_of(path)
        every = self.ancestry.paths()
        e = group.log(group.between(np.broadcast_to(path[:, None], every.shape), every))
        cov = np.einsum("n,kna,knb->kab", self.particles.weights, e, e)
        at, back = np.unique(self.path_length, return_inverse=True)
        cov += np.array([drift(float(s)) for s in at])[back]
        return Trajectory(self.times, path, cov)

    def report(self) -> dict[str, Any]:
        """Metrics of the run; JSON-serialisable."""
        n = len(self.particles)
        quantiles = np.quantile(self.effective / n, [0.05, 0.5])
        last = self.ancestry.coalescence()
        return {
            "scans": len(self.times),
            "particles": n,
            "path_length": float(self.path_length[-1]),
            "resamplings": self.tally.resamplings,
            "effective_median": float(quantiles[1]),
            "effective_p05": float(quantiles[0]),
            "coalescence_seconds_back": float(self.times[-1] - self.times[last]) if last >= 0 else None,
            "steps_without_beams": self.tally.without_beams,
            "steps_without_returns": self.tally.without_returns,
            "beams_dropped": self.tally.dropped_rays,
            "maps_megabytes": self.used_bytes / 1e6,
        }


def run_rbpf(
    steps: Steps,
    config: GridFilterConfig,
    seed: SeedTree,
    *,
    prune_every: int = 32,
    progress: bool = False,
) -> RbpfResult:
    """Run one filter over all steps.

    Parameters
    ----------
    seed : SeedTree
        The same seed gives identical results for any number of threads.
    prune_every : int
        Steps between prunings of extinct lineages; 0: no pruning, for plots of the whole tree.
    progress : bool
        Show a progress bar.

    Raises
    ------
    DataError
        No steps.
    """
    n = len(steps)
    if n == 0:
        raise DataError("no steps to filter", where=steps.name, wanted="at least 1")
    filter = GridFilter(steps, config, seed, prune_every=prune_every)
    effective, resampled = np.empty(n), np.zeros(n, dtype=np.bool_)
    for k in Bar(range(n), name=steps.name, unit="step", shown=progress):
        effective[k], ancestors = filter.step(k)
        resampled[k] = ancestors is not None
    if prune_every:
        filter.ancestry.prune()
    return RbpfResult(
        name=steps.name,
        times=steps.times,
        path_length=steps.path_length,
        effective=effective,
        resampled=resampled,
        ancestry=filter.ancestry,
        particles=filter.particles,
        best=filter.particles.best,
        tally=filter.tally,
        used_bytes=filter.pool.used_bytes,
        uses=steps.uses,
    )


def rbpf_submap(
    result: RbpfResult,
    drift: Callable[[float], Array],
    *,
    key: int = 0,
    drift_scale: float = 1.0,
    steps: Steps | None = None,
    passed: ErrorPassThrough | None = None,
) -> Submap:
    """The whole run as one submap: map and path of the best particle, and a consistent covariance of its end pose.

    Parameters
    ----------
    drift : callable
        Path length [m] → covariance ``(d, d)`` of dead reckoning, right tangent.
    drift_scale : float
        Factor on the covariance of the drift model.
    steps : Steps, optional
        If given, the covariance of dead reckoning is added where no scan corrects it
        (:mod:`graphslam_frontends.odometry.scan_use`).
    passed : ErrorPassThrough, optional
        Share of the dead-reckoning covariance that the filter passes on elsewhere; needs ``steps``. Default: none.
    """
    times = result.times
    if len(times) < 2:
        raise DataError("one step makes no submap", where=result.name, got=len(times), wanted="at least 2 steps")
    w = result.particles.weights
    exit = exit_covariance(
        result.poses, result.final_pose, drift(float(result.path_length[-1])), weights=w, drift_scale=drift_scale
    )
    report = result.report() | {
        "ended": "end-of-log",
        "exit_sigma_particles": np.sqrt(np.diag(exit.particles)).tolist(),
        "exit_sigma_drift": np.sqrt(np.diag(exit.drift)).tolist(),
    }
    path = result.trajectory(lambda s: drift_scale * np.asarray(drift(s)))
    added = np.zeros_like(exit.total)
    alone = len(result.particles) == 1  # a single particle: the path is dead reckoning, because scans cannot correct it
    if steps is not None and (stretches := [(1, len(path) - 1)] if alone else unobserved_stretches(steps)):
        assert path.covariances is not None
        more = [unobserved_covariance(steps, stretches, path.poses[: k + 1], 0, k) for k in range(len(path))]
        path = Trajectory(path.times, path.poses, path.covariances + np.array(more))
        added = more[-1]
    if steps is not None and passed is not None and not alone:
        assert path.covariances is not None
        leaked = drift_scale * covariance_along_path(steps, path.poses, passed, len(result.particles))
        path = Trajectory(path.times, path.poses, path.covariances + leaked)
        added = added + leaked[-1]
    report["exit_sigma_drift"] = np.sqrt(np.diag(drift_scale * exit.drift + added)).tolist()
    return Submap(
        key=key,
        interval=(float(times[0]), float(times[-1])),
        exit_pose=result.final_pose,
        exit_covariance=exit.total + added,
        trajectory=path,
        grid=result.particles.grids[result.best],
        uses=result.uses,
        report=report,
    )


def covariance_along_path(steps: Steps, poses: Array, passed: ErrorPassThrough, particles: int) -> Array:
    """Covariances ``(n, d, d)`` along the path of a filter: the dead-reckoning errors that it passes on."""
    n = len(poses)
    knots = np.unique(np.linspace(0, n - 1, min(n, KNOTS)).round().astype(np.int64))
    tilt = None if steps.tilt is None else steps.tilt_sigma
    along = steps.path_length
    C = [
        passed.covariance(
            dead_reckoning_covariance(steps, 0, k, level_end=False), float(along[k] - along[0]), particles, tilt=tilt
        )
        for k in knots.tolist()
    ]
    return interpolate_covariances(knots, np.array(C), poses, along)


@dataclass(frozen=True, slots=True, kw_only=True)
class RbpfGridConfig:
    """The front end ``rbpf-grid``."""

    steps: StepConfig = field(default_factory=StepConfig)
    """Conversion of the log to steps."""
    filter: GridFilterConfig = field(default_factory=GridFilterConfig)
    """Particles, motion, weights."""
    drift_scale: float = 1.0
    """Factor on the covariances of errors common to all particles: the drift model, and the dead-reckoning errors that
    the filter passes on."""


@dataclass(frozen=True, slots=True)
class RbpfGrid(StepwiseFrontEnd):
    """The front end ``rbpf-grid``: the whole log as one submap with an evidence grid.

    Needs a stream of range data (spinning scanner, point clouds, planar scans) and a stream of motion.
    """

    config: RbpfGridConfig = field(default_factory=RbpfGridConfig)
    name: ClassVar[str] = "rbpf-grid"

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :class:`graphslam_frontends.base.FrontEnd`. There is only one submap."""
        if after is None:
            steps = self.steps(log, drops=drops)
            result = run_rbpf(steps, self.config.filter, seed.child(0))
            drift = DriftModel(dim=steps.dim)
            submap = rbpf_submap(result, drift, drift_scale=self.config.drift_scale, steps=steps, passed=PASSED)
            if len(result.particles) == 1:
                text = "particles: 1 — no correction by scans; path and covariance are dead reckoning."
                steps = replace(steps, findings=(*steps.findings, Finding("look", "one-particle", text)))
            yield with_findings(submap, steps)
