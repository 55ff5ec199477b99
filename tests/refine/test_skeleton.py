"""Paths relaxed with their scans as skeleton networks: errors, fixes, refusals, and each measurement once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.poses import group_of, rotation_matrices
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.refine.skeleton import find_patches, relax_scans
from graphslam.refine.surfaces import ScanReturns, find_surfaces, rotate_by_step
from graphslam.registration.surfaces import SURFACE
from tests.refine.test_fixes import DATUM, fixes_along
from tests.refine.test_plane import started
from tests.refine.world import court_scans


def bent(start, truth, share):
    """A share of the error of dead reckoning, as of the path of a graph."""
    g = group_of(truth)
    return g.compose(truth, g.exp(share * g.log(g.between(truth, start))))


def off(times, poses, truth):
    """ATE [m]."""
    return ate(Trajectory(times, poses), Trajectory(times, truth)).statistics.rmse


@pytest.fixture(scope="module")
def drive():
    scans, reckoned, truth = court_scans(40, beams=31)
    return scans, bent(reckoned, truth, 0.2), truth


@pytest.fixture(scope="module")
def relaxed(drive):
    scans, start, _ = drive
    return relax_scans(scans, start)


def test_a_bent_path_is_brought_to_the_truth(drive, relaxed) -> None:
    scans, start, truth = drive
    assert off(scans.times, start, truth) > 0.1
    assert off(scans.times, relaxed.path.poses, truth) < 0.02
    assert 0.7 < relaxed.relaxation.chi2 < 1.4
    assert relaxed.relaxation.converged


def test_a_bent_path_in_the_plane_is_brought_to_the_truth() -> None:
    scans, reckoned, truth = started(seconds=60.0, bend=0.02, noise=0.005)
    start = bent(reckoned, truth, 0.5)
    found = relax_scans(scans, start)
    nodes = np.searchsorted(scans.times, found.path.times)
    assert off(scans.times, start, truth) > 0.1
    assert off(found.path.times, found.path.poses, truth[nodes]) < 0.02
    assert found.path.dim == 2


def test_fixes_hold_the_path_in_their_frame(drive) -> None:
    """The antenna is not at the origin of the body, no fix is at a stamp, and one is wrong by 30 m."""
    scans, start, truth = drive
    rng, t = np.random.default_rng(0), scans.times[5:-5:4] + 0.07
    gps = fixes_along(Trajectory(scans.times, truth).interpolate(t), t, rng)
    gps.positions[3] += 30.0
    shifted = start + np.array([0.05, -0.04, 0.03, 0.0, 0.0, 0.0, 0.0])
    found = relax_scans(scans, shifted, gps=(gps, DATUM))
    rms = np.sqrt(np.mean((found.path.positions - truth[:, :3]) ** 2, axis=0))
    assert np.all(rms < 0.02)  # not aligned; σ of a fix is 0.05 m
    assert (found.fixes, found.fixes_left) == (len(t) - 1, 1)


def test_each_point_is_in_one_measurement_and_each_pose_sees_a_patch_once(drive) -> None:
    scans, _, truth = drive
    cloud = ScanReturns.of(scans, chunk_length=3.0, chunk_time=10.0)
    seen = find_patches(cloud, find_surfaces(cloud, truth, SURFACE), truth, 0.3, outliers=True)
    pairs = seen.step * (int(seen.patch.max()) + 1) + seen.patch
    assert len(np.unique(pairs)) == len(pairs)
    assert np.all(np.bincount(seen.patch) > 1)
    assert np.all(np.diff(seen.step) >= 0)
    # points of a patch are on one plane, at the true path
    at = group_of(truth).transform(truth[seen.step], seen.points)
    n = rotate_by_step(rotation_matrices(truth), seen.step, seen.normals)
    first = np.unique(seen.patch, return_index=True)[1][seen.patch]
    np.testing.assert_allclose(n, n[first], atol=1e-9)
    far = np.abs(np.einsum("ki,ki->k", at - at[first], n))
    assert np.median(far) < 0.02 < 0.5 * np.median(np.linalg.norm(at - at[first], axis=1))


def test_too_few_correspondences_are_refused_with_their_number(drive) -> None:
    scans, start, _ = drive
    blind = replace(scans, returns=scans.returns & (np.arange(len(scans.returns)) % 40 == 0))
    with pytest.raises(DataError, match=r"too few correspondences.*got \d+ measurements .* of 179 poses"):
        relax_scans(blind, start)


def test_a_path_of_another_length_is_refused(drive) -> None:
    scans, start, _ = drive
    with pytest.raises(GeometryError, match="does not fit"):
        relax_scans(scans, start[:-1])
