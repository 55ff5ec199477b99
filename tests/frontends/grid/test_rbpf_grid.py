"""RBPF SLAM on grids: a loop is closed better than by dead reckoning, and the end is not promised too well."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end
from graphslam.core.errors import ConfigError, CovarianceError, DataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.core.records import LaserScans
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.memory import measure_memory
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter_error_model import ErrorPassThrough
from graphslam_frontends.odometry.scan_use import dead_reckoning_covariance
from graphslam_frontends.odometry.steps import Steps
from graphslam_studies.frontends.drift import DriftModel
from graphslam_studies.frontends.rbpf_grid import RbpfResult, rbpf_submap, run_rbpf
from tests.frontends.grid_world import ring, true_end

CONFIG = GridFilterConfig(particles=20, heading_walk=0.02)


def drift(length: float) -> Array:
    """σ 3 cm after a metre, 6 mrad of roll and pitch, heading off by 5 mrad a metre."""
    position, heading = 0.01 + 0.03 * np.sqrt(length), 0.002 + 0.005 * length
    return np.diag([0.006, 0.006, heading, position, position, position]) ** 2


def flat_drift(length: float) -> Array:
    return drift(length)[np.ix_([3, 4, 2], [3, 4, 2])]


def end_error(steps: Steps, result: RbpfResult) -> float:
    return float(np.linalg.norm((true_end(steps) - result.final_pose)[: steps.dim]))


@pytest.fixture(scope="module")
def run() -> tuple[Steps, RbpfResult]:
    steps = ring(7, 3, length=20.0, beams=120)
    return steps, run_rbpf(steps, CONFIG, SeedTree(3))


@pytest.mark.parametrize(("dim", "bound"), [(3, 0.45), (2, 0.15)])
def test_a_loop_is_closed_better_than_by_dead_reckoning(dim: int, bound: float) -> None:
    errors, reckoned = [], []
    for seed in range(40, 45):
        steps = ring(seed, dim, yaw_bias=0.002, beams=200 if dim == 3 else 90)
        config = replace(CONFIG, voxel_size=0.2 if dim == 3 else 0.1)
        errors.append(end_error(steps, run_rbpf(steps, config, SeedTree(seed))))
        reckoned.append(end_error(steps, run_rbpf(steps, replace(config, particles=1), SeedTree(seed))))
    assert np.mean(reckoned) > 0.7
    assert np.mean(errors) < bound
    assert np.mean(errors) < 0.5 * np.mean(reckoned)


def test_result_holds_what_happened(run: tuple[Steps, RbpfResult]) -> None:
    steps, result = run
    n = len(steps)
    assert result.effective.shape == result.resampled.shape == (n,)
    assert np.all((result.effective >= 1 - 1e-9) & (result.effective <= 20 + 1e-9))
    assert np.array_equal(result.resampled, result.effective < 10)
    assert result.tally.resamplings == result.resampled.sum() > 0
    assert len(result.ancestry) == n
    assert result.ancestry.paths()[-1].shape == result.poses.shape
    # the paths end where the particles stand: every step was written down in the frame it is in
    assert np.array_equal(result.ancestry.paths()[-1], result.poses)
    assert result.seconds > 0.0
    assert set(result.tally.seconds) == {"predict", "weigh", "record", "resample", "update"}
    assert result.used_bytes == measure_memory(result.particles.grids).total
    assert result.used_bytes < 0.6 * sum(measure_memory(g).total for g in result.particles.grids)
    assert result.particles.weights[result.best] == result.particles.weights.max()
    json.dumps(result.report())


def test_the_map_is_of_the_place(run: tuple[Steps, RbpfResult]) -> None:
    steps, result = run
    group = group_of(result.final_pose)
    assert steps.truth is not None
    start = remove_roll_pitch(steps.truth.poses[0])
    points = np.concatenate([group.transform(group.between(start, T), steps.scan(k)[0][steps.scan(k)[2]])
                             for k, T in enumerate(steps.truth.poses)])  # fmt: skip
    cloud = result.particles.grids[result.best].occupied_cloud()
    from scipy.spatial import cKDTree

    distance = cKDTree(points).query(cloud)[0]
    assert np.quantile(distance, 0.9) < 0.3
    assert len(cloud) > 1000


def test_submap_is_the_best_particles_with_an_consistent_exit(run: tuple[Steps, RbpfResult]) -> None:
    steps, result = run
    submap = rbpf_submap(result, drift)
    assert submap.interval == (steps.times[0], steps.times[-1])
    assert np.array_equal(submap.exit_pose, result.final_pose)
    assert submap.grid is result.particles.grids[result.best]
    assert submap.uses == steps.uses
    group = group_of(result.final_pose)
    # particles, about the pose that is handed over, by a plain loop; and the drift model on top
    spread = np.zeros((6, 6))
    for w, T in zip(result.particles.weights, result.poses):
        e = group.log(group.between(result.final_pose, T))
        spread += w * np.outer(e, e)
    wanted = spread + drift(float(steps.path_length[-1]))
    assert submap.exit_covariance == pytest.approx(wanted, rel=1e-9, abs=1e-15)
    path = submap.trajectory
    assert path is not None
    assert path.covariances is not None
    assert np.array_equal(path.poses[-1], submap.exit_pose)
    assert path.covariances[-1] == pytest.approx(wanted, rel=1e-9, abs=1e-15)
    assert path.covariances[0] == pytest.approx(drift(0.0), abs=1e-4)
    doubled = rbpf_submap(result, drift, drift_scale=2.0)
    assert doubled.exit_covariance - submap.exit_covariance == pytest.approx(wanted - spread, abs=1e-12)
    json.dumps(dict(submap.report))
    assert result.trajectory().covariances is None


def test_the_exit_takes_along_what_the_filter_passes_on_of_dead_reckoning(run: tuple[Steps, RbpfResult]) -> None:
    steps, result = run
    n = len(steps)
    plain, passed = rbpf_submap(result, drift, steps=steps), ErrorPassThrough(heading=0.5, position=0.7)
    submap = rbpf_submap(result, drift, steps=steps, passed=passed)
    tilt = None if steps.tilt is None else steps.tilt_sigma
    reckoned = dead_reckoning_covariance(steps, 0, n - 1, level_end=False)
    wanted = passed.covariance(reckoned, float(steps.path_length[-1]), len(result.particles), tilt=tilt)
    assert np.trace(wanted) > 0
    assert submap.exit_covariance - plain.exit_covariance == pytest.approx(wanted, rel=1e-6, abs=1e-12)
    assert submap.trajectory is not None
    assert submap.trajectory.covariances is not None
    assert submap.trajectory.covariances[-1] == pytest.approx(submap.exit_covariance, rel=1e-9, abs=1e-15)
    sigma = np.sqrt(np.diag(drift(float(steps.path_length[-1])) + wanted))
    assert submap.report["exit_sigma_drift"] == pytest.approx(sigma, rel=1e-6)


def test_ends_lie_inside_what_the_exit_covariance_promises() -> None:
    d2, alone = [], []
    for seed in range(60, 72):
        steps = ring(seed, 2, length=30.0, yaw_bias=0.002, beams=60)
        result = run_rbpf(steps, replace(CONFIG, voxel_size=0.2, particles=10), SeedTree(seed))
        submap = rbpf_submap(result, flat_drift)
        group = group_of(submap.exit_pose)
        e = group.log(group.between(submap.exit_pose, true_end(steps)))
        d2.append(e @ np.linalg.solve(submap.exit_covariance, e) / 3)
        spread = submap.exit_covariance - flat_drift(float(steps.path_length[-1])) + np.diag([0.01, 0.01, 0.001]) ** 2
        alone.append(e @ np.linalg.solve(spread, e) / 3)
    assert np.max(d2) < 2.6  # χ² with 3 dof: 95 %
    assert np.mean(alone) > np.mean(d2)


def test_too_little_for_a_submap_and_no_covariance_are_refused(run: tuple[Steps, RbpfResult]) -> None:
    _, result = run
    with pytest.raises(CovarianceError):
        rbpf_submap(result, flat_drift)
    short = ring(0, 2, length=0.3, beams=20)
    assert len(short) == 1
    with pytest.raises(DataError, match="one step"):
        rbpf_submap(run_rbpf(short, CONFIG, SeedTree(0)), flat_drift)


def planar_log(seed: int) -> SensorLog:
    """The drive round the ring as a log of planar scans and recorded odometry."""
    steps = ring(seed, 2, length=16.0, beams=90)
    n = len(steps)
    beams = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    ranges = np.linalg.norm(steps.points.reshape(n, 90, 2), axis=2)
    ranges = np.where(steps.returns.reshape(n, 90), ranges, steps.max_range)
    ranges[3, 5] = np.nan
    scans = LaserScans(times=steps.times, ranges=ranges, bearings=beams, max_range=steps.max_range)
    return SensorLog(name="ring", streams={"laser": scans, "odometry": steps.odometry})


def test_front_end_gives_one_submap_and_nothing_after_it() -> None:
    log, drops = planar_log(0), DropCounter()
    front = make_front_end("rbpf-grid", {"filter": {"particles": 6, "voxel_size": 0.1}, "drift_scale": 1.5})
    assert isinstance(front, FrontEnd)
    (submap,) = front.submaps(log, seed=SeedTree(1), drops=drops)
    assert submap.dim == 2
    assert submap.exit_covariance[2, 2] > 1.5 * DriftModel(dim=2).covariance(15.0)[2, 2]
    assert submap.report["particles"] == 6
    assert submap.uses == {"laser", "odometry"}
    assert submap.trajectory is not None
    assert isinstance(submap.grid, EvidenceGrid)
    assert submap.grid.dim == 2
    assert submap.grid.voxel_counts().occupied > 100
    assert any("laser" in what for what in drops.counts)  # the reading that was none
    assert list(front.submaps(log, seed=SeedTree(1), after=submap)) == []
    (again,) = front.submaps(log, seed=SeedTree(1))
    assert again.exit_pose.tobytes() == submap.exit_pose.tobytes()
    with pytest.raises(ConfigError, match="likelihood"):
        make_front_end("rbpf-grid", {"filter": {"likelihood": "guess"}})
