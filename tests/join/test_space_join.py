"""Landmark submaps in space: five ways to one optimum, the filters' algebra, honesty, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.compare import map_nees
from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.map_truth import MapTruth
from graphslam.core.se3 import se3_between, se3_inverse, se3_transform
from graphslam.core.submap import Submap
from graphslam.io.submap_store import read_submaps, write_submaps
from graphslam.join.graph_join import join_graph_sequential
from graphslam.join.registry import join_by_method, prepare_submaps

METHODS = ("isam2", "batch", "eif-tree", "eif-sequential", "ekf")
FIELD = {"seconds": 60.0, "points": 150}


def local_maps(log: gs.SensorLog) -> list[Submap]:
    return gs.local_maps(log, "points", options={"max_distance": 10.0})


def truth_of(log: gs.SensorLog, submaps: list[Submap]) -> MapTruth:
    assert log.truth is not None
    at = np.array([0.0, *(s.interval[1] for s in submaps)])
    base, *ends = log.truth.trajectory.interpolate(at)
    return MapTruth(
        keys=np.array([s.key for s in submaps]),
        exit_poses=se3_between(base, np.array(ends)),
        landmark_ids=log.truth.landmark_ids,
        landmarks=se3_transform(se3_inverse(base), log.truth.landmarks),
    )


@pytest.fixture(scope="module")
def drifting() -> tuple[list[Submap], MapTruth]:
    """Heading uncertain by 6° at the ends of submaps."""
    log = gs.simulate("point-field", preset="drift", seed=5, **FIELD)
    submaps = local_maps(log)
    return submaps, truth_of(log, submaps)


def test_every_method_ends_at_one_optimum(drifting) -> None:
    submaps, truth = drifting
    table = gs.compare(submaps, METHODS, truth=truth, memory=False)
    best = table["objective_polished"]
    assert best.max() - best.min() < 1e-9 * best.min()
    assert np.ptp(table["nees"]) < 1e-4 * table["nees"].iloc[0]
    assert (table["objective"] > best.min() * (1 - 1e-12)).all()
    by = table.set_index("method")
    # linearised once, an error of six degrees in heading is not small
    assert by.loc["eif-tree", "objective"] < 1.05 * best.min() < by.loc["ekf", "objective"]
    assert by.loc["eif-tree", "nees_unpolished"] < 0.5 * by.loc["ekf", "nees_unpolished"]


def test_the_filters_in_both_forms_are_one_algebra(drifting) -> None:
    """The Kalman filter and the classical information filter in sequence are linearised at the same places."""
    submaps = drifting[0][:3]
    covariance = join_by_method(submaps, "ekf")
    information = join_graph_sequential(prepare_submaps(submaps), passes=1)
    np.testing.assert_allclose(covariance.poses, information.poses, atol=1e-7)
    np.testing.assert_allclose(covariance.landmarks, information.landmarks, atol=1e-7)
    np.testing.assert_allclose(
        covariance.covariance, np.linalg.inv(information.information.toarray()), rtol=1e-5, atol=1e-9
    )


def test_a_tree_of_two_is_the_sequence(drifting) -> None:
    submaps = drifting[0][:2]
    tree, sequence = join_by_method(submaps, "eif-tree"), join_by_method(submaps, "eif-sequential")
    np.testing.assert_array_equal(tree.poses, sequence.poses)
    np.testing.assert_array_equal(tree.information.toarray(), sequence.information.toarray())


def test_joined_maps_are_consistent() -> None:
    """Eight flights: the optimum inside two-sided bounds that a halved or a doubled covariance leaves."""
    d2, dof = 0.0, 0
    for seed in range(8):
        log = gs.simulate("point-field", seed=100 + seed, **FIELD)
        submaps = local_maps(log)
        found = join_by_method(submaps, "eif-tree")
        one, n = map_nees(found, [s.key for s in submaps], truth_of(log, submaps))
        d2, dof = d2 + one, dof + n
    low, high = chi2_quantile(0.001, dof) / dof, chi2_quantile(0.999, dof) / dof
    assert low < d2 / dof < high
    assert not low < 2.0 * d2 / dof < high
    assert not low < 0.5 * d2 / dof < high


def test_submaps_in_space_survive_the_disk(tmp_path, drifting) -> None:
    submaps = drifting[0]
    write_submaps(tmp_path / "maps", list(submaps))
    again = read_submaps(tmp_path / "maps")
    assert [s.landmarks.chart for s in again] == ["group"] * len(submaps)
    np.testing.assert_array_equal(join_by_method(again, "eif-tree").poses, join_by_method(submaps, "eif-tree").poses)


def test_a_submap_without_landmarks_measures_its_end(drifting) -> None:
    first, second, *_ = drifting[0]
    bare = replace(second, landmarks=None)
    found = join_by_method([first, bare], "batch")
    np.testing.assert_allclose(se3_between(found.poses[1], found.poses[2]), bare.exit_pose, atol=1e-9)


def test_what_cannot_be_joined_is_refused(drifting) -> None:
    submaps = drifting[0]
    with pytest.raises(ConfigError, match="only landmark submaps in the plane"):
        join_by_method(submaps, associate="joint")
    with pytest.raises(ConfigError, match="one process"):
        join_by_method(submaps, workers=2)
    nobody = [submaps[0].with_ids(np.full(len(submaps[0].landmarks), -1)), *submaps[1:]]
    with pytest.raises(DataError, match="without an identity"):
        join_by_method(nobody)
    flat = gs.local_maps(gs.simulate("landmark-field", preset="quick", seed=1))[0]
    with pytest.raises(GeometryError, match="two dimensions"):
        join_by_method([submaps[0], flat])
