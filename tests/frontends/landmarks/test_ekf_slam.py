"""EKF front ends: consistent local maps, one map over a whole log, snapshots of it, resuming, and what they refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.core.errors import ConfigError, CovarianceError, GeometryError, MissingDataError
from graphslam.core.geometry import tangent_to_vector_covariance
from graphslam.core.log import DropCounter
from graphslam.core.random import SeedTree
from graphslam.evaluate.association import pair_agreement
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.landmarks.config import StoppingConfig
from graphslam_frontends.landmarks.ekf import Ekf
from graphslam_frontends.landmarks.ekf_config import EkfConfig
from graphslam_studies.charts import ChartConfig, draw_log
from graphslam_studies.evaluate.submap_consistency import submaps_consistency
from graphslam_studies.frontends.ekf_slam import EkfSlam, EkfSlamConfig, ekf_snapshots
from graphslam_studies.frontends.snapshot import Snapshot

SEED = SeedTree(0)
CUTS = StoppingConfig(scans=59)


@pytest.fixture(scope="module")
def world():
    return simulate("landmark-field", preset="demo", seed=7)


@pytest.fixture(scope="module")
def single(world):
    return next(EkfSlam(EkfSlamConfig(association="known")).submaps(world, seed=SEED))


def local(**changes):
    return Ekf(replace(EkfConfig(association="known", stopping=CUTS), **changes))


def mean_nees(preset, handover, seeds):
    joint = dof = pose = maps = 0.0
    for seed in seeds:
        log = simulate("landmark-field", preset=preset, seed=seed, layout_seed=1)
        found = submaps_consistency(local(handover=handover).submaps(log, seed=SEED), log.truth)
        joint, dof = joint + found["joint"].nees.sum(), dof + found["joint"].dof.sum()
        pose, maps = pose + found["exit"].nees.sum(), maps + found["exit"].nees.size
    return joint / dof, pose / maps / 3, maps


def test_local_maps_with_a_good_sensor_are_consistent():
    """0.1 m / 1°: the EKF is as good as the smoother. Standard errors over 252 maps: joint 0.015, pose 0.051."""
    joint, pose, maps = mean_nees("C", "filter", (20, 21))
    assert maps == 252
    assert 0.95 < joint < 1.05
    assert 0.85 < pose < 1.15


def test_local_maps_with_the_stated_sensor_pay_for_linearisation_and_smoothing_repairs_it():
    """0.5 m / 5°: on the same data and the same association, the filter's NEES is about 5 % above the smoother's."""
    joint, pose, _ = mean_nees("A", "filter", (20, 21))
    smoothed, smoothed_pose, _ = mean_nees("A", "smoothed", (20, 21))
    assert 0.95 < smoothed < 1.05
    assert 0.85 < smoothed_pose < 1.15
    assert 1.02 < joint / smoothed < 1.08
    assert pose > smoothed_pose


def test_where_ranges_are_sure_and_bearings_are_not_the_filter_believes_itself_too_much_and_the_default_does_not():
    """6 cm / 3.5°: an observation at 20 m is an arc of 2 m, of which one linearisation makes a straight line."""
    maps = StoppingConfig(num_features=10**6, time_max=1e6, max_scans=10**6, max_distance=35.0)
    per_dof = {}
    for name, options in (("default", {}), ("filter", {"handover": "filter"})):
        nees = dof = 0.0
        for seed in range(8):
            robot = ChartConfig(odometry=(0.03, 0.02, 0.5), sensor=(0.06, 3.5), seconds=150.0)
            log = draw_log(robot, SeedTree(seed).child("arcs"))
            front = Ekf(EkfConfig(association="known", max_range=25.0, stopping=maps, **options))
            found = submaps_consistency(front.submaps(log, seed=SEED), log.truth)["exit"]
            nees, dof = nees + found.nees.sum(), dof + found.dof.sum()
        per_dof[name] = nees / dof
    assert dof / 3 >= 70
    assert 0.8 < per_dof["default"] < 1.3  # 95 % bounds of honest ones: 0.82 to 1.20
    assert per_dof["filter"] > 3.0


def test_front_ends_are_registered_with_presets_for_the_simulated_world(world):
    for name, kind in (("ekf", Ekf), ("ekf-slam", EkfSlam)):
        made = make_front_end(name, recommended_options(world, name)["frontend"])
        assert isinstance(made, kind)
        assert isinstance(made, FrontEnd)
        assert made.config.association == "known"
        assert made.config.motion.speed == world.meta["noise"]["speed"]


@pytest.mark.parametrize("handover", ["filter", "smoothed"])
def test_front_end_resumes_at_any_submap_with_the_same_numbers(world, handover):
    whole = list(local(handover=handover).submaps(world, seed=SEED))
    assert [s.report["scans"] for s in whole[:-1]] == [59] * (len(whole) - 1)
    for k in (0, len(whole) // 2, len(whole) - 1):
        rest = list(local(handover=handover).submaps(world, seed=SEED, after=whole[k]))
        assert [s.key for s in rest] == [s.key for s in whole[k + 1 :]]
        for a, b in zip(rest, whole[k + 1 :]):
            assert a.interval == b.interval
            np.testing.assert_array_equal(a.landmarks.covariance, b.landmarks.covariance)
            np.testing.assert_array_equal(a.landmarks.detections, b.landmarks.detections)
            np.testing.assert_array_equal(a.trajectory.poses, b.trajectory.poses)


@pytest.mark.parametrize("handover", ["filter", "smoothed"])
def test_path_ends_where_the_gaussian_says(world, handover):
    for s in local(handover=handover).submaps(world, seed=SEED):
        assert s.trajectory.times[0] == s.interval[0]
        assert s.trajectory.times[-1] == s.interval[1]
        np.testing.assert_allclose(s.trajectory.poses[-1], s.exit_pose, atol=1e-12)
        np.testing.assert_allclose(s.trajectory.covariances[-1], s.exit_covariance, rtol=1e-6, atol=1e-14)


def test_every_usable_observation_is_in_exactly_one_submap_under_its_own_identity(world):
    drops = DropCounter()
    submaps = list(local().submaps(world, seed=SEED, drops=drops))
    seen = np.concatenate([s.landmarks.detections[:, 0] for s in submaps])
    assert len(np.unique(seen)) == len(seen)
    assert len(seen) + sum(drops.counts.values()) == len(world["landmarks"].ranges)
    ids = world["landmarks"].ids
    for s in submaps:
        rows = s.landmarks.detections
        np.testing.assert_array_equal(ids[rows[:, 0]], s.landmarks.ids[rows[:, 1]])
        assert s.report["used"] == len(rows)
        assert s.report["used"] + s.report["not_associated"] == s.report["observations"]


def test_smoothed_hand_over_counts_what_it_leaves_out(world):
    kept = list(local(handover="smoothed", trim=4.0, min_hits=3).submaps(world, seed=SEED))
    assert sum(s.report["trimmed"] for s in kept) > 50
    for s in kept:
        r = s.report
        assert r["used"] + r["trimmed"] + r["not_associated"] == r["observations"]
        assert np.bincount(s.landmarks.detections[:, 1]).min() >= 3


def test_single_map_is_one_submap_with_the_whole_path(world, single):
    scans = len(world["landmarks"].times)
    assert single.report["scans"] == scans
    assert len(single.trajectory) == scans + 1  # the base stands first
    assert np.all(np.linalg.eigvalsh(single.trajectory.covariances[1:])[:, 0] > 0)
    assert single.report["nis_dof"] == 2 * (single.report["used"] - single.report["founded"])
    assert 0.9 < single.report["nis"] / single.report["nis_dof"] < 1.1
    assert list(EkfSlam().submaps(world, seed=SEED, after=single)) == []


def test_snapshots_are_the_states_of_the_single_map(world, single):
    n = single.report["scans"]
    cuts = [1, 59, 118, n]
    calls = []
    config = EkfSlamConfig(association="known")
    found = list(ekf_snapshots(world, config, cuts=cuts, on_scan=calls.append))
    assert calls == list(range(1, n + 1))
    assert [s.scan for s in found] == cuts
    for s in found:
        k = s.scan  # the base stands first in the trajectory
        assert s.time == single.trajectory.times[k]
        np.testing.assert_allclose(s.pose, single.trajectory.poses[k], atol=1e-9)
        np.testing.assert_allclose(
            s.pose_covariance, tangent_to_vector_covariance(s.pose, single.trajectory.covariances[k]), atol=1e-10
        )
    assert [s.gaussian is None for s in found] == [True, True, True, False]
    last = found[-1]
    np.testing.assert_array_equal(last.landmark_ids, single.landmarks.ids)
    np.testing.assert_allclose(last.landmarks, single.landmarks.positions, atol=1e-9)
    np.testing.assert_allclose(last.gaussian.covariance, single.landmarks.covariance, atol=1e-10)
    for j in range(len(last)):
        ix = [3 + 2 * j, 4 + 2 * j]
        np.testing.assert_allclose(
            last.landmark_covariances[j], last.gaussian.covariance[np.ix_(ix, ix)], rtol=1e-12, atol=1e-15
        )
    assert all(s.gaussian is not None for s in ekf_snapshots(world, config, cuts=cuts[:2], joint="all"))
    assert all(s.gaussian is None for s in ekf_snapshots(world, config, cuts=cuts[:2], joint="never"))


@pytest.fixture(scope="module")
def clear_world():
    """Features 1.5 m apart cannot be told at 30 m by a bearing of 3°; by one of 1° they can."""
    return simulate("landmark-field", preset="demo", seed=7, sigma_range=0.1, sigma_bearing=float(np.deg2rad(1.0)))


@pytest.mark.parametrize("association", ["nearest", "jcbb"])
def test_unknown_association_finds_the_identities_over_a_loop_closure(clear_world, association):
    options = recommended_options(clear_world, "ekf-slam")["frontend"]
    s = next(make_front_end("ekf-slam", {**options, "association": association}).submaps(clear_world, seed=SEED))
    rows = s.landmarks.detections
    found = pair_agreement(rows[:, 1], clear_world["landmarks"].ids[rows[:, 0]])
    assert found.precision > 0.995
    assert found.recall > 0.995
    assert np.all(s.landmarks.ids == -1)
    assert s.report["used"] > 0.97 * s.report["observations"]
    assert s.report.get("jcbb_capped_scans", 0) == 0


def test_impossible_requests_are_refused(world):
    config = EkfSlamConfig(association="known")
    n = len(world["landmarks"].times)
    for cuts in ([], [0], [5, 5], [7, 6], [n + 1]):
        with pytest.raises(ConfigError, match="cuts"):
            ekf_snapshots(world, config, cuts=cuts)
    with pytest.raises(ConfigError, match="joint"):
        ekf_snapshots(world, config, cuts=[3], joint="some")
    with pytest.raises(ConfigError, match="handover"):
        EkfConfig(handover="moments")
    with pytest.raises(ConfigError, match="trim"):
        EkfConfig(trim=-1.0)
    blind = replace(world["landmarks"], ids=None)
    with pytest.raises(MissingDataError, match="identities"):
        ekf_snapshots(replace(world, streams={**world.streams, "landmarks": blind}), config, cuts=[3])
    sigmas = world["landmarks"].sigmas.copy()
    sigmas[:, 1] = np.inf
    flat = replace(world["landmarks"], sigmas=sigmas, bearings=np.zeros(len(sigmas)))
    with pytest.raises(MissingDataError, match="ranges alone"):
        list(EkfSlam(config).submaps(replace(world, streams={**world.streams, "landmarks": flat}), seed=SEED))


def test_snapshot_refuses_what_it_cannot_be():
    good = {
        "scan": 1, "time": 0.2, "pose": np.zeros(3), "pose_covariance": np.eye(3), "landmark_ids": np.array([4]),
        "landmarks": np.zeros((1, 2)), "landmark_covariances": np.eye(2)[None],
    }  # fmt: skip
    assert len(Snapshot(**good)) == 1
    for bad in ({"landmarks": np.zeros((2, 2))}, {"pose": np.array([0, np.nan, 0])}):
        with pytest.raises(GeometryError):
            Snapshot(**{**good, **bad})
    for bad in ({"pose_covariance": -np.eye(3)}, {"landmark_covariances": np.ones((1, 2, 2))}):
        with pytest.raises(CovarianceError):
            Snapshot(**{**good, **bad})
