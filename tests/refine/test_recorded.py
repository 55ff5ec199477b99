"""The refinement on slices of recorded logs: scans agree better, and relations are no worse than before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run.front_ends import recommended_options
from graphslam.core.config import build_config
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE2
from graphslam.core.trajectory import Trajectory
from graphslam.refine.result import Refinement
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_studies.evaluate.relations import covered_part, random_pairs, relation_error

FREEHAND = {"period": None, "max_range": 30.0, "most_points": 400, "odometry_tilt_sigma": 0.005}
"""Packs of clouds with poses of lidar and IMU, as their presets have it; the yaw rate as it was recorded."""


def part(name: str, seconds: float, data_dir: Path) -> SensorLog:
    """The beginning of a recording."""
    log = gs.load(name)
    begins = float(log["reference"].times[0])
    return log.slice(begins, begins + seconds)


def relations(path: Trajectory, reference: Trajectory) -> dict[str, float]:
    held = covered_part(reference, path)
    return relation_error(path, held, random_pairs(len(held), 1000, np.random.default_rng(0))).as_row()


def path_of(found: Refinement) -> Trajectory:
    return Trajectory(found.times, found.poses)


@pytest.fixture(scope="module")
def building(data_dir: Path) -> SensorLog:
    return part("radish-fr079", 100.0, data_dir)


@pytest.fixture(scope="module")
def refined(building: SensorLog) -> Refinement:
    return gs.refine_path(building)


@pytest.mark.data
def test_relations_of_a_planar_log_are_better_than_those_of_its_odometry(
    building: SensorLog, refined: Refinement
) -> None:
    steps = make_steps(
        building, build_config(StepConfig, recommended_options(building, "segslam")["frontend"]["steps"])
    )
    before = relations(chain_odometry(steps.odometry), building["reference"])
    after = relations(path_of(refined), building["reference"])
    assert after["translation_mean"] < before["translation_mean"]
    assert refined.agreement[1] > refined.agreement[0]


@pytest.mark.data
def test_whole_scans_of_one_place_are_one_node_and_the_path_has_every_step(refined: Refinement) -> None:
    assert len(refined.nodes) < 0.75 * len(refined.times)
    assert len(refined.poses) == len(refined.covariances) == len(refined.times)
    assert np.all(np.linalg.eigvalsh(refined.covariances[1:]) > 0)
    step = SE2.log(SE2.between(refined.poses[:-1], refined.poses[1:]))
    assert np.abs(step).max() < 0.5
    # joint covariances are those of the path, between nodes too
    k = np.array([50, 51, 200])
    joint = refined.joint(k)
    assert np.linalg.eigvalsh(joint).min() > 0
    for i, row in enumerate(k):
        own = joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(np.diag(own), np.diag(refined.covariances[row]), rtol=0.5)


@pytest.mark.data
@pytest.mark.parametrize("name", ["lidar3d-hku1", "lidar3d-balm-hall"])
def test_scans_of_a_lidar_pack_agree_no_less_than_along_its_odometry(name: str, data_dir: Path) -> None:
    log = part(name, 30.0, data_dir)
    found = gs.refine_path(log, steps=FREEHAND)
    assert found.agreement[1] >= found.agreement[0]
    assert not len(found.refused)
    moved = relations(path_of(found), log["reference"])
    assert moved["translation_mean"] < 0.15  # the reference is another program's, made of the same scans


@pytest.mark.data
def test_a_path_that_is_off_is_brought_back(data_dir: Path) -> None:
    log = part("lidar3d-hku1", 30.0, data_dir)
    start = chain_odometry(log["odometry"])
    bent = chain_odometry(make_steps(log, build_config(StepConfig, {**FREEHAND, "yaw_bias": 0.01})).odometry)
    before = relations(bent, log["reference"])
    found = gs.refine_path(log, bent, steps={**FREEHAND, "yaw_bias": 0.01})
    after = relations(path_of(found), log["reference"])
    assert after["translation_mean"] < 0.5 * before["translation_mean"]
    assert found.agreement[1] > found.agreement[0] + 0.02
    assert relations(start, log["reference"])["translation_mean"] < after["translation_mean"] + 0.15
