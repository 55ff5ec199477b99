"""The front end ``scan-window``: submaps of a log, the same when resumed, with what scans did in their reports."""

from __future__ import annotations

import importlib
import json
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.config import build_config
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.log import SensorLog
from graphslam.core.poses import compose_increments, group_of
from graphslam.core.random import SeedTree
from graphslam.core.records import LaserScans
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.front_end import (
    ScanWindow,
    ScanWindowFrontEndConfig,
    WindowSubmapConfig,
    scan_window_submaps,
)
from graphslam_frontends.scan_window.scan_odometry_steps import ScanOdometryErrors, odometry_from_scans
from graphslam_frontends.scan_window.tracker import track_steps
from graphslam_frontends.segslam.config import SegSlamConfig
from graphslam_frontends.segslam.front_end import SegSlam, SegSlamFrontEndConfig
from tests.frontends.grid_world import ring

WINDOW = ScanWindowConfig(lay=2.0)
FRONT = ScanWindow(
    ScanWindowFrontEndConfig(
        steps=StepConfig(period=None),
        window=WINDOW,
        submap=WindowSubmapConfig(length=7.0, seconds=4.0, voxel_size=0.1),
    )
)


@pytest.fixture(scope="module")
def log() -> SensorLog:
    """A drive round the ring as planar scans and recorded odometry."""
    steps = ring(0, 2, length=24.0, beams=90, yaw_bias=0.0006)
    n = len(steps)
    beams = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    ranges = np.linalg.norm(steps.points.reshape(n, 90, 2), axis=2)
    ranges = np.where(steps.returns.reshape(n, 90), ranges, steps.max_range)
    scans = LaserScans(times=steps.times, ranges=ranges, bearings=beams, max_range=steps.max_range)
    return SensorLog(name="ring", streams={"laser": scans, "odometry": steps.odometry})


@pytest.fixture(scope="module")
def submaps(log: SensorLog) -> list[Submap]:
    return list(FRONT.submaps(log, seed=SeedTree(0)))


def same(a: Submap, b: Submap) -> bool:
    assert isinstance(a.grid, EvidenceGrid)
    assert isinstance(b.grid, EvidenceGrid)
    assert a.trajectory is not None
    assert b.trajectory is not None
    paths, grids = (a.trajectory, b.trajectory), (a.grid, b.grid)
    arrays = [
        (s.exit_pose, s.exit_covariance, t.poses, t.covariances, g.brick_coordinates(), g.brick_values())
        for s, t, g in zip((a, b), paths, grids)
    ]
    return all(np.array_equal(x, y) for x, y in zip(*arrays)) and a.report == b.report


def test_submaps_of_a_log(log: SensorLog, submaps: list[Submap]) -> None:
    assert [s.key for s in submaps] == [0, 1, 2, 3]
    assert [s.report["ended"] for s in submaps] == ["length", "length", "length", "end-of-log"]
    steps = FRONT.steps(log)
    assert submaps[0].interval[0] == steps.times[0]
    assert submaps[-1].interval[1] == steps.times[-1]
    poses = [np.zeros(3)]
    g = group_of(poses[0])
    for a, b in pairwise(submaps):
        assert a.interval[1] == b.interval[0]
    made = track_steps(steps, WINDOW)
    for s in submaps:
        assert s.uses == {"laser", "odometry"}
        assert s.trajectory is not None
        assert s.trajectory.covariances is not None
        assert np.array_equal(s.trajectory.poses[-1], s.exit_pose)
        assert np.array_equal(s.trajectory.covariances[-1], s.exit_covariance)
        assert np.trace(s.trajectory.covariances[0]) < 1e-5
        assert isinstance(s.grid, EvidenceGrid)
        assert s.grid.voxel_counts().occupied > 100
        json.dumps(dict(s.report))
        poses.append(g.compose(poses[-1], s.exit_pose))
    assert poses[-1] == pytest.approx(made.poses[-1], abs=1e-9)  # the chain of the exits is the path
    assert sum(s.report["steps"] for s in submaps) == len(steps) - 1
    assert submaps[0].report["scans_lost"] == 0
    assert 0.01 < submaps[1].report["spread_median"] < 0.05


def test_every_beam_is_in_one_map(submaps: list[Submap], log: SensorLog) -> None:
    counted: list[int] = []
    real = EvidenceGrid.insert_scan

    def insert(self: EvidenceGrid, points: object, *args: object, **named: object) -> object:
        counted.append(len(points))  # type: ignore[arg-type]
        return real(self, points, *args, **named)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EvidenceGrid, "insert_scan", insert)
        list(FRONT.submaps(log, seed=SeedTree(0)))
    assert sum(counted) == len(FRONT.steps(log).points)


def test_resumed_and_repeated_runs_are_the_same(log: SensorLog, submaps: list[Submap]) -> None:
    for other in (SeedTree(0), SeedTree(5)):  # nothing is drawn
        again = list(ScanWindow(FRONT.config).submaps(log, seed=other))
        assert len(again) == len(submaps)
        assert all(map(same, submaps, again))
    rest = list(ScanWindow(FRONT.config).submaps(log, seed=SeedTree(0), after=submaps[1]))
    assert [s.key for s in rest] == [2, 3]
    assert all(map(same, submaps[2:], rest))
    assert list(FRONT.submaps(log, seed=SeedTree(0), after=submaps[-1])) == []


def test_a_submap_is_there_as_soon_as_its_last_step_is(log: SensorLog, submaps: list[Submap]) -> None:
    stream: Iterator[Submap] = scan_window_submaps(FRONT.steps(log), WINDOW, FRONT.config.submap)
    assert same(next(stream), submaps[0])


def test_in_space_bases_stand_level_and_errors_are_those_of_the_body() -> None:
    values = []
    for seed in range(6):
        steps = ring(seed, 3, length=14.0, step=0.3, beams=150, yaw_bias=0.0)
        assert steps.truth is not None
        made = list(scan_window_submaps(steps, WINDOW, WindowSubmapConfig(length=6.0, seconds=4.0)))
        g, truth = group_of(made[0].exit_pose), steps.truth.poses
        for s in made:
            assert s.trajectory is not None
            first = s.trajectory.poses[0]
            assert first[2] == pytest.approx(0.05)  # a quarter of a voxel
            rows = np.searchsorted(steps.times, s.interval)
            base = g.compose(truth[rows[0]], g.inverse(first))
            exit = g.compose(truth[rows[1]], g.between(s.trajectory.poses[-1], s.exit_pose))
            e = g.log(g.between(s.exit_pose, g.between(base, exit)))
            values.append(float(e @ np.linalg.solve(s.exit_covariance, e)))
            assert np.abs(s.exit_pose[3:5]).max() < 1e-12
    dof = 6 * len(values)
    assert chi2_quantile(0.002, dof) < sum(values) < chi2_quantile(0.998, dof)


def test_lost_scans_are_a_line_of_the_verdict() -> None:
    steps = ring(3, 2, length=20.0, beams=90, yaw_bias=0.0)
    returns = steps.returns.copy()
    returns[int(steps.offsets[30]) : int(steps.offsets[42])] = False
    made = list(
        scan_window_submaps(replace(steps, returns=returns), WINDOW, WindowSubmapConfig(length=8.0, seconds=4.0))
    )
    codes = [f["code"] for s in made for f in s.report.get("findings", ())]
    assert "scans-lost" in codes
    assert "motion-uncorrected" in codes
    assert sum(s.report["scans_lost"] for s in made) >= 12
    assert all("lost" not in s.report["scans_lost_why"] for s in made)
    clean = list(scan_window_submaps(steps, WINDOW, WindowSubmapConfig(length=8.0, seconds=4.0)))
    assert all("findings" not in s.report for s in clean)


def test_what_makes_no_submap_is_refused() -> None:
    short = ring(0, 2, length=0.3, beams=20)
    with pytest.raises(DataError, match="too few steps"):
        list(scan_window_submaps(short, WINDOW, WindowSubmapConfig()))
    for bad in ({"length": 0.0}, {"voxel_size": np.nan}, {"seconds": -1.0}):
        with pytest.raises(ConfigError, match="submap"):
            WindowSubmapConfig(**bad)  # type: ignore[arg-type]


def test_followed_steps_know_their_errors_over_any_interval() -> None:
    steps = ring(5, 3, length=16.0, step=0.3, beams=150, yaw_bias=0.0006)
    there = odometry_from_scans(steps, WINDOW)
    made, g = track_steps(steps, WINDOW, [20]), group_of(steps.odometry.increments)
    path = compose_increments(there.odometry.increments[1:])
    assert g.between(path[20], path[45]) == pytest.approx(g.between(made.poses[20], made.poses[45]), abs=1e-9)
    assert isinstance(there.errors, ScanOdometryErrors)
    T, C = there.errors.between(20, 45)
    assert g.log(g.between(T, g.between(made.poses[20], made.poses[45]))) == pytest.approx(0.0, abs=1e-9)
    # a pose of the past and the pose of now have most of their errors in common
    assert np.all(np.diag(C) < np.diag(made.joints[45][6:, 6:]) + np.diag(made.joints[45][:6, :6]) + 1e-5)
    there.errors.prepare([20, 45])
    assert np.array_equal(there.errors.between(20, 45)[1], C)
    assert np.all(np.linalg.eigvalsh(there.errors.between(20, 20, level_start=True, level_end=True)[1]) > 0)
    with pytest.raises(DataError, match="interval"):
        there.errors.between(5, 4)
    assert there.tilt_sigma == 0.0


def test_segslam_follows_scans_inside_its_segments(log: SensorLog) -> None:
    made = {}
    for inside in ("filter", "scan-window"):
        front = SegSlam(
            SegSlamFrontEndConfig(
                steps=StepConfig(period=None),
                filter=GridFilterConfig(particles=4, voxel_size=0.1),
                segslam=SegSlamConfig(inside=inside),  # type: ignore[arg-type]
                window=WINDOW,
            )
        )
        made[inside] = list(front.submaps(log, seed=SeedTree(1)))
    (*_, sampled), (*_, scans) = made["filter"], made["scan-window"]
    path = track_steps(FRONT.steps(log), WINDOW).poses
    assert scans.trajectory is not None
    # particles stay near the path of the scans, and the exit is as sure as that
    g = group_of(path)
    rows = np.searchsorted(FRONT.steps(log).times, scans.interval)
    followed_exit = g.between(path[rows[0]], path[rows[1]])
    assert np.abs(g.log(g.between(followed_exit, scans.exit_pose))).max() < 1e-6
    assert np.sqrt(scans.exit_covariance[2, 2]) < 0.7 * np.sqrt(sampled.exit_covariance[2, 2])
    twice = StepConfig(match_scans=True)
    with pytest.raises(ConfigError, match="match_scans"):
        ScanWindowFrontEndConfig(steps=twice)
    with pytest.raises(ConfigError, match="match_scans"):
        SegSlamFrontEndConfig(steps=twice, segslam=SegSlamConfig(inside="scan-window"))
    assert SegSlamFrontEndConfig(steps=twice).segslam.inside == "filter"
    with pytest.raises(ConfigError, match="inside"):
        SegSlamConfig(inside="guess")  # type: ignore[arg-type]


def test_it_is_registered_and_its_presets_are_options_of_it() -> None:
    root = Path(__file__).resolve().parents[3]
    names = tomllib.loads((root / "pyproject.toml").read_text())["project"]["entry-points"]["graphslam.frontends"]
    module, _, kind = names["scan-window"].partition(":")
    assert getattr(importlib.import_module(module), kind) is ScanWindow
    assert ScanWindow.name == "scan-window"
    folders = ("graphslam/app/presets", "notebooks/studies/graphslam_studies/presets")
    presets = sorted(p for folder in folders for p in (root / folder).glob("*.scan-window.toml"))
    assert {p.name.partition(".")[0] for p in presets} >= {"garage", "mine", "building", "court"}
    for file in presets:
        build_config(ScanWindowFrontEndConfig, tomllib.loads(file.read_text())["frontend"], "frontend")
