"""One particle filter over a whole log: shared histories equal copied ones, snapshots equal the particles' moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.worlds import simulate
from graphslam.core.errors import ConfigError, MissingDataError
from graphslam.core.gaussian import moment_match
from graphslam.core.geometry import wrap_angle
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.prepare import prepare_log
from graphslam_frontends.landmarks.summarise import REGULARISER
from graphslam_frontends.odometry.motion import MotionNoise
from graphslam_studies.frontends.lineage import SingleMapParticles
from graphslam_studies.frontends.rbpf_slam import RbpfSlam, RbpfSlamConfig, SingleMapFilter, rbpf_snapshots
from tests.frontends.landmarks.test_fastslam_step import FOV, SENSOR, world


@pytest.fixture(scope="module")
def log():
    return simulate("landmark-field", seed=3, preset="quick")


class Copying(ParticleSet):
    """The slow twin: every particle carries its whole past, and a resampling copies all of it."""

    def _resample(self, survivors):
        copies = np.bincount(survivors, minlength=len(self.pose))
        row = [k for k in range(len(copies)) for _ in range(copies[k] - 1)]  # who is copied onto the dead, in order
        source = [k if copies[k] else row.pop(0) for k in range(len(copies))]
        super()._resample(np.array(source))


@pytest.mark.parametrize("association", ["known", "likelihood"])
@pytest.mark.parametrize("seed", range(3))
def test_shared_histories_equal_copied_ones(association, seed):
    config = RbpfSlamConfig(particles=6, association=association, ess_fraction=0.8)
    shared, copied = (
        kind(config, SENSOR, FOV, 9.0, np.random.default_rng(seed)) for kind in (SingleMapParticles, Copying)
    )
    slots: dict[int, int] = {}
    for u, Q, obs, ids in world(np.random.default_rng(50 + seed), scans=120):
        if association == "known":
            obs, ids = obs[ids >= 0], ids[ids >= 0]
            known = np.array([slots.setdefault(int(i), len(slots)) for i in ids], dtype=np.int64)
        else:
            known = np.full(len(obs), -1, dtype=np.int64)
        shared.step(u, Q, obs, known)
        copied.step(u, Q, obs, known)
    assert shared.resamplings == copied.resamplings > 5
    assert 1 <= shared.ancestors < 6
    np.testing.assert_array_equal(shared.weights, copied.weights)
    np.testing.assert_array_equal(shared.paths().transpose(1, 0, 2), copied.path[:, : copied.scans])
    m = int(copied.count.max())
    np.testing.assert_array_equal(shared.hits[:, :m], copied.hits[:, :m])
    np.testing.assert_array_equal(shared.mean[:, :m], copied.mean[:, :m])
    if association == "likelihood":
        np.testing.assert_array_equal(shared.associations().T, copied.assoc[:, : copied.observations])
        assert np.any(copied.assoc[:, : copied.observations] < 0)  # the comparison saw features that went


@pytest.mark.parametrize("association", ["known", "likelihood"])
def test_snapshot_is_the_moment_matched_set(log, association):
    config = RbpfSlamConfig(particles=12, association=association, min_hits=2)
    data = prepare_log(log, config, DropCounter())
    filter = SingleMapFilter(data, config, SeedTree(1).generator())
    for _ in range(80):
        filter.advance()
    got, dropped, _ = filter.snapshot(joint=True)
    p = filter.particles
    kept, slots = p.features(2)
    assert len(kept) + dropped == 12
    assert len(got) == slots.shape[1] > 3
    if association == "known":
        assert set(got.landmark_ids) <= set(log.truth.landmark_ids)
        assert dropped == 0
    else:
        assert set(got.landmark_ids) == {-1}
    n = 3 + 2 * len(got)
    covs = np.zeros((len(kept), n, n))
    for a, i in enumerate(kept):
        for f, j in enumerate(slots[a]):
            c, k = p.cov[i, j], 3 + 2 * f
            covs[a, k : k + 2, k : k + 2] = [[c[0], c[1]], [c[1], c[2]]]
    means = np.concatenate([p.pose[kept], [p.mean[i, s].ravel() for i, s in zip(kept, slots)]], axis=1)
    expected = moment_match(p.weights[kept], means, covs + REGULARISER * np.eye(n), angular=(2,))
    np.testing.assert_allclose(got.gaussian.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(got.gaussian.covariance, expected.covariance, atol=1e-13)
    np.testing.assert_allclose(got.pose_covariance, expected.covariance[:3, :3], atol=1e-13)
    for f in range(len(got)):
        k = slice(3 + 2 * f, 5 + 2 * f)
        np.testing.assert_allclose(got.landmark_covariances[f], expected.covariance[k, k], atol=1e-13)


def test_snapshots_are_those_of_one_filter_and_carry_joints_where_asked(log):
    config = RbpfSlamConfig(particles=8, association="known")
    run = lambda cuts, joint="last": list(rbpf_snapshots(log, config, seed=SeedTree(4), cuts=cuts, joint=joint))  # noqa: E731
    a, b = run([20, 50, 90]), run([50, 90], "all")
    assert [s.gaussian is not None for s in a] == [False, False, True]
    assert [s.gaussian is not None for s in b] == [True, True]
    assert run([20], "never")[0].gaussian is None
    for x, y in zip(a[1:], b):  # where one looks does not change what the filter does
        np.testing.assert_array_equal(x.pose, y.pose)
        np.testing.assert_array_equal(x.landmark_covariances, y.landmark_covariances)
    assert [s.scan for s in a] == [20, 50, 90]
    assert [s.time for s in a] == [log["landmarks"].times[k - 1] for k in (20, 50, 90)]
    for bad in ([0, 5], [5, 5], [10**6]):
        with pytest.raises(ConfigError, match="cuts"):
            run(bad)
    with pytest.raises(ConfigError, match="joint"):
        run([5], "some")


def test_front_end_gives_one_submap_that_knows_how_sure_it_is_not(log):
    """The end is where the truth is within metres; forty particles claim to know it far better than they do."""
    motion = MotionNoise(speed=0.3, steering=np.deg2rad(3.0))
    front = RbpfSlam(RbpfSlamConfig(association="known", motion=motion))
    (submap,) = front.submaps(log, seed=SeedTree(0))
    assert submap.report["scans"] == len(log["landmarks"].times)
    assert submap.report["regulariser"] == REGULARISER
    assert submap.report["min_ess"] < 20
    assert list(front.submaps(log, seed=SeedTree(0), after=submap)) == []
    end = log.truth.trajectory.interpolate([submap.interval[1]])[0]
    error = submap.exit_pose - end
    error[2] = wrap_angle(error[2])
    assert np.hypot(*error[:2]) < 10.0
    path = submap.trajectory
    assert len(path.times) == len(path.poses) == len(path.covariances)
    np.testing.assert_allclose(path.poses[-1], submap.exit_pose, atol=1e-9)
    np.testing.assert_allclose(path.covariances[-1], submap.exit_covariance, atol=1e-12)
    truth = log.truth.trajectory.interpolate(path.times)
    assert np.sqrt(np.mean(np.sum((path.poses - truth)[:, :2] ** 2, axis=1))) < 10.0


def test_observations_of_an_unknown_association_name_the_observations(log):
    (submap,) = RbpfSlam(RbpfSlamConfig(particles=10, min_hits=3)).submaps(log, seed=SeedTree(0))
    observation, landmark = submap.landmarks.detections.T
    assert len(np.unique(observation)) == len(observation)  # an observation is of one landmark
    assert np.bincount(landmark, minlength=len(submap.landmarks)).min() >= 3
    true_id = log["landmarks"].ids[observation]
    majority = [np.bincount(true_id[landmark == k]).max() for k in range(len(submap.landmarks))]
    assert sum(majority) > 0.9 * len(observation)


def test_known_association_needs_identities(log):
    observations = replace(log["landmarks"], ids=None)
    bare = SensorLog(name="bare", streams={"controls": log["controls"], "landmarks": observations})
    with pytest.raises(MissingDataError, match="identities"):
        next(rbpf_snapshots(bare, RbpfSlamConfig(association="known"), seed=SeedTree(0), cuts=[5]))
