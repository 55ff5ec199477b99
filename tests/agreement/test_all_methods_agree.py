"""Joiners and solvers on the same submaps: one map where the problem is linear, one optimum where it is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.app.compare import DEFAULT_METHODS
from graphslam.core.geometry import se2_compose
from graphslam.core.submap import Submap
from graphslam.io.slsjf import read_slsjf_local_maps
from graphslam.join.registry import join_by_method
from graphslam.join.submap_solver import SubmapEstimate
from tests.reference.submap_chain import submap_chain


def difference(a: SubmapEstimate, b: SubmapEstimate) -> float:
    order = [int(np.flatnonzero(b.landmark_ids == j)[0]) for j in a.landmark_ids]
    return max(np.abs(a.poses - b.poses).max(), np.abs(a.landmarks - b.landmarks[order]).max())


def test_known_headings_make_all_methods_one(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=20, landmarks=50, known_heading=True)
    batch = join_by_method(submaps, "batch")
    moved = batch.poses[1:, :2] - submaps_chained(submaps)
    assert np.abs(moved).max() > 0.01  # the loop did correct something
    P = batch.joint_covariance()
    for method in DEFAULT_METHODS:
        own = join_by_method(submaps, method)  # before any polish
        assert difference(batch, own) < 1e-6, method
        assert own.objective == pytest.approx(batch.objective, rel=1e-6)
        if method != "isam2":
            np.testing.assert_allclose(own.joint_covariance(), P, rtol=0, atol=1e-6 * np.abs(P).max())


def submaps_chained(submaps: list[Submap]) -> np.ndarray:
    """End positions by composition alone."""
    poses = [np.zeros(3)]
    for s in submaps:
        poses.append(se2_compose(poses[-1], s.exit_pose))
    return np.array(poses[1:])[:, :2]


def test_without_noise_every_method_finds_the_truth(rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng, submaps=10, sigma=1e-9, sigma_heading=1e-10)
    for method in DEFAULT_METHODS:
        found = join_by_method(submaps, method)
        assert np.abs(found.poses[1:, :2] - truth.exit_poses[:, :2]).max() < 1e-6, method


def test_polish_leads_to_one_optimum(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=25, landmarks=60, sigma=0.15, sigma_heading=0.02)
    batch = join_by_method(submaps, "batch")
    gaps = {}
    for method in DEFAULT_METHODS:
        polished = join_by_method(submaps, method, polish=True)
        assert polished.objective_polished == pytest.approx(batch.objective, rel=1e-7), method
        assert difference(batch, polished) < 1e-4, method
        gaps[method] = polished.objective / batch.objective - 1.0
    assert gaps["eif-sequential"] == pytest.approx(gaps["ekf"], rel=1e-4)
    assert min(gaps["eif-sequential"], gaps["eif-tree"]) > 1e-4  # one linearisation costs something


@pytest.mark.data
def test_the_published_local_maps(data_dir: Path) -> None:
    submaps = read_slsjf_local_maps(data_dir / "victoria_park_processed")
    objectives = {}
    for method in DEFAULT_METHODS:
        found = join_by_method(submaps, method, polish=True)
        assert found.objective_polished == pytest.approx(3643.43, rel=1e-3), method
        assert found.states == 1198
        objectives[method] = found.objective
    assert objectives["eif-sequential"] == pytest.approx(objectives["ekf"], rel=1e-9)
    assert 3643.5 < objectives["eif-sequential"] < objectives["eif-tree"] < 3660.0
