"""From particles to one Gaussian: common features (B4), moment matching (B3), winning association, stopping (B8)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.worlds import simulate
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import wrap_angle
from graphslam.core.log import DropCounter
from graphslam.core.random import SeedTree
from graphslam_frontends.landmarks.config import RbpfEkfConfig, StoppingConfig
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf
from graphslam_frontends.landmarks.stopping import StoppingRule
from graphslam_frontends.landmarks.summarise import common_features, gaussian_of_particles, winning_association
from graphslam_studies.evaluate.submap_consistency import submaps_consistency


def particle_set(n=4, observations=6, **config):
    p = ParticleSet(RbpfEkfConfig(particles=n, **config), np.zeros(3), (-1.5, 1.5), 10.0, np.random.default_rng(0))
    p.observations = observations
    p.weights = np.full(n, 1.0 / n)
    return p


def test_features_correspond_by_their_observations_not_by_their_slots():
    p = particle_set()
    #            observations 0..5: two landmarks A (0, 2, 4) and B (1, 3, 5)
    p.assoc[0, :6] = [0, 1, 0, 1, 0, 1]
    p.assoc[1, :6] = [7, 3, 7, 3, 7, 3]  # the same under other slots
    p.assoc[2, :6] = [2, 2, 2, 2, 2, 2]  # both mapped to one: cannot be ordered like the standard
    p.assoc[3, :6] = [0, -1, 0, -1, 0, 1]  # lacks B: one of three of its observations
    p.weights = np.array([0.4, 0.3, 0.2, 0.1])
    association = winning_association(p, 1)
    np.testing.assert_array_equal(association.slots, [0, 1])
    kept, slots = common_features(p, association)
    np.testing.assert_array_equal(kept, [0, 1])
    np.testing.assert_array_equal(slots, [[0, 1], [7, 3]])


def test_landmarks_come_in_order_of_observation_and_rare_ones_are_left_out():
    p = particle_set(observations=7)
    p.assoc[0, :7] = [5, 5, 2, -1, 5, 2, 9]
    p.weights = np.array([1.0, 0, 0, 0])
    a = winning_association(p, 2)
    np.testing.assert_array_equal(a.slots, [5, 2])
    np.testing.assert_array_equal(a.observation, [0, 1, 2, 4, 5])
    np.testing.assert_array_equal(a.landmark, [0, 0, 1, 0, 1])


@pytest.mark.parametrize("inflate", [False, True])
def test_moment_matching_equals_the_moments_of_a_large_sample(inflate):
    """Draw from the mixture itself: a particle by weight, its features from their Gaussians; headings cross ±π."""
    rng = np.random.default_rng(5)
    p = particle_set(n=8, observations=2)
    p.pose = np.column_stack([rng.normal(2, 0.3, 8), rng.normal(-1, 0.2, 8), wrap_angle(np.pi + rng.normal(0, 0.2, 8))])
    p.weights = rng.dirichlet(np.ones(8) * 4)
    p.assoc[:, :2] = [0, 1]
    p.mean[:, :2] = rng.normal(0, 1, (8, 2, 2)) * 0.2 + [[5, 1], [3, -4]]
    p.cov[:, 0], p.cov[:, 1] = [0.05, 0.01, 0.08], [0.02, -0.005, 0.03]
    got, dropped = gaussian_of_particles(p, winning_association(p, 1), inflate=inflate)
    assert dropped == 0
    n = 400_000
    pick = rng.choice(8, n, p=p.weights)
    features = []
    for j in range(2):
        c = p.cov[0, j]
        noise = rng.multivariate_normal(np.zeros(2), [[c[0], c[1]], [c[1], c[2]]], n)
        features.append(p.mean[pick, j] + noise)
    x = np.column_stack([p.pose[pick], *features])
    x[:, 2] = wrap_angle(x[:, 2] - got.mean[2])  # relative to the answer, so the circle does not matter
    expected = np.cov(x.T)
    if inflate:  # only the part between particles grows, by 1 + 40/N
        within = np.zeros((7, 7))
        for j in range(2):
            c = p.cov[0, j]
            within[3 + 2 * j : 5 + 2 * j, 3 + 2 * j : 5 + 2 * j] = [[c[0], c[1]], [c[1], c[2]]]
        expected = within + (expected - within) * (1 + 40 / 8)
    s = np.sqrt(np.diag(expected))
    assert abs(x[:, 2].mean()) < 0.002
    np.testing.assert_allclose(got.mean[[0, 1, 3, 4, 5, 6]], x[:, [0, 1, 3, 4, 5, 6]].mean(0), atol=0.004)
    np.testing.assert_allclose(got.covariance / np.outer(s, s), expected / np.outer(s, s), atol=0.02)


SIGMA = np.array([0.5, 0.5, 0.1])


def stopping(**config):
    return StoppingRule(StoppingConfig(min_scans=1, **config))


def test_each_criterion_names_itself():
    p = particle_set()
    p.scans = 5
    u = np.array([1.0, 0.0, 0.0])
    p.hits[0, :4] = 3
    assert stopping(num_features=4).reason(p, 0.2, u, 1, SIGMA) == "features"
    assert stopping(num_features=5).reason(p, 0.2, u, 1, SIGMA) is None
    p.resamplings = 3
    assert stopping(max_resamplings=3).reason(p, 0.2, u, 1, SIGMA) == "diversity"
    p.ancestor[:] = 1
    assert stopping(min_ancestors=1).reason(p, 0.2, u, 1, SIGMA) == "diversity"
    assert stopping(max_distance=0.9).reason(p, 0.2, u, 1, SIGMA) == "distance"
    assert stopping(max_scans=5).reason(p, 0.2, u, 1, SIGMA) == "scans"
    assert StoppingRule(StoppingConfig(min_scans=6, max_scans=5)).reason(p, 0.2, u, 1, SIGMA) is None


def test_a_fixed_number_of_scans_overrules_every_other_criterion():
    p = particle_set()
    p.hits[0, :9] = 3
    p.resamplings, p.ancestor[:] = 9, 0
    everything = {"num_features": 1, "max_resamplings": 1, "min_ancestors": 3, "max_distance": 0.1, "max_scans": 1}
    s = StoppingRule(StoppingConfig(min_scans=1, scans=4, **everything))
    reasons = []
    for p.scans in range(1, 5):
        reasons.append(s.reason(p, 100.0, np.ones(3), 0, SIGMA))
    assert reasons == [None, None, None, "scans"]
    with pytest.raises(ConfigError, match="scans"):
        StoppingConfig(scans=-1)


def test_a_filter_without_particles_can_be_watched():
    class Plain:
        scans, confirmed, resamplings, ancestors = 3, 5, 0, None

        def pose_std(self):
            return np.ones(3)

    u = np.array([1.0, 0.0, 0.0])
    assert stopping(min_ancestors=3, max_resamplings=1, num_features=6).reason(Plain(), 0.2, u, 1, SIGMA) is None
    assert stopping(num_features=5).reason(Plain(), 0.2, u, 1, SIGMA) == "features"


def test_time_without_features_shrinks_with_pose_uncertainty():
    """TIME = TIME_max · min(1, ε/σ): eight seconds while the pose is sure, four when σ_x is twice the noise."""
    for spread, limit in ((0.01, 8.0), (1.0, 4.0)):
        p = particle_set(n=2)
        p.scans = 5
        p.pose[:, 0] = [-spread, spread]  # standard deviation = spread, ε_x = 0.5
        s = stopping(time_max=8.0, max_distance=1e9)
        waited = 0.0
        while s.reason(p, 0.2, np.zeros(3), 0, SIGMA) is None:
            waited += 0.2
            assert waited < 20
        assert waited == pytest.approx(limit, abs=0.21)


def test_seeing_a_feature_starts_the_clock_anew():
    p = particle_set(n=2)
    p.scans = 5
    s = stopping(time_max=1.0, max_distance=1e9)
    for k in range(40):
        assert s.reason(p, 0.2, np.zeros(3), int(k % 4 == 0), SIGMA) is None


@pytest.fixture(scope="module")
def world():
    return simulate("landmark-field", preset="demo", seed=7)


def front(**changes):
    config = RbpfEkfConfig(
        association="known", particles=100, stopping=StoppingConfig(num_features=15, max_distance=35.0)
    )
    return RbpfEkf(replace(config, **changes))


def test_smoothed_submaps_are_consistent_and_moment_matched_ones_are_not_with_a_good_sensor():
    """Two-sided on many maps; the paper's hand-over must fail the same test where the sensor is good."""
    log = simulate(
        "landmark-field", preset="A", seed=3, laps=0.5, sigma_range=0.1, sigma_bearing=float(np.deg2rad(1.0))
    )
    consistent = submaps_consistency(front().submaps(log, seed=SeedTree(1)), log.truth)
    assert consistent["joint"].count > 30
    assert consistent["joint"].verdict == "consistent", consistent["joint"]
    assert consistent["exit"].verdict == "consistent", consistent["exit"]
    paper = submaps_consistency(front(handover="moments", particles=40).submaps(log, seed=SeedTree(1)), log.truth)
    assert paper["joint"].verdict == "overconfident"
    assert paper["exit"].mean_normalised > 2 * consistent["exit"].mean_normalised


def test_report_carries_the_consistency_figures(world):
    for s in front().submaps(world, seed=SeedTree(0)):
        r = s.report
        assert r["moment_kl"] > 0
        assert len(r["moment_pose_variance_ratio"]) == 3
        assert 1 <= r["min_ess"] <= 100
        assert 1 <= r["ancestors"] <= 100
        assert r["used"] + r["not_associated"] + r["trimmed"] == r["observations"]
        assert s.trajectory.times[0] == s.interval[0]
        assert s.trajectory.times[-1] == s.interval[1]
        np.testing.assert_allclose(s.trajectory.poses[-1], s.exit_pose)
        np.testing.assert_allclose(s.trajectory.covariances[-1], s.exit_covariance, rtol=1e-6)


def test_front_end_resumes_at_any_submap_with_the_same_numbers(world):
    whole = list(front().submaps(world, seed=SeedTree(3)))
    for k in (0, len(whole) // 2, len(whole) - 1):
        rest = list(front().submaps(world, seed=SeedTree(3), after=whole[k]))
        assert [s.key for s in rest] == [s.key for s in whole[k + 1 :]]
        for a, b in zip(rest, whole[k + 1 :]):
            np.testing.assert_array_equal(a.landmarks.covariance, b.landmarks.covariance)
            np.testing.assert_array_equal(a.landmarks.detections, b.landmarks.detections)


def test_every_usable_observation_is_in_exactly_one_submap(world):
    drops = DropCounter()
    seen = np.concatenate([s.landmarks.detections[:, 0] for s in front().submaps(world, seed=SeedTree(0), drops=drops)])
    assert len(np.unique(seen)) == len(seen)
    assert len(seen) + sum(drops.counts.values()) == len(world["landmarks"].ranges)
    ids = world["landmarks"].ids
    for s in front().submaps(world, seed=SeedTree(0)):
        rows = s.landmarks.detections
        np.testing.assert_array_equal(ids[rows[:, 0]], s.landmarks.ids[rows[:, 1]])
        break
