"""Plaza 1, recorded: ranges alone against RTK truth, with noise and calibration that come from the log itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

import graphslam as gs
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import align_se2, se2_transform
from graphslam.core.log import DropCounter
from graphslam_frontends.landmarks.config import RangeBearingNoise, RbpfEkfConfig
from graphslam_frontends.landmarks.prepare import prepare_log
from tests.benchmarks.bench_plaza import Evidence, Model, free_nees

pytestmark = pytest.mark.data


def rms(e):
    return float(np.sqrt(np.mean(np.sum(e**2, axis=1))))


@pytest.fixture(scope="module")
def log(data_dir):
    return gs.load("plaza1")


@pytest.fixture(scope="module")
def run(log):
    return gs.run(log, frontend="rbpf-ekf", solver="batch", progress=False)


def off_path(path, truth):
    inside = (path.times >= truth.times[0]) & (path.times <= truth.times[-1])
    here, there = path.poses[inside, :2], truth.interpolate(path.times[inside])[:, :2]
    return rms(se2_transform(align_se2(here, there), here) - there)


def test_map_from_ranges_is_near_the_truth(run, log):
    """0.22 m on the path and 0.16 m on the beacons when written; dead reckoning alone is off by 1.5 m."""
    beacons = dict(zip(log.truth.landmark_ids.tolist(), log.truth.landmarks))
    L = np.array([beacons[int(i)] for i in run.solution.landmark_ids])
    assert len(L) == 4
    assert off_path(run.map.trajectory, log.truth.trajectory) < 0.30
    assert rms(se2_transform(align_se2(run.solution.landmarks, L), run.solution.landmarks) - L) < 0.25
    assert sum(s.report["beacons_without_landmark"] + s.report["ambiguous_landmarks"] for s in run.submaps) == 0


def test_map_is_consistent_but_for_the_scale_of_the_odometer(run, log):
    """Up to a similarity the covariance explains the errors of 12 submap ends and 4 beacons; rigidly it cannot, since
    nothing in the log says how long the odometer's metre is (0.4 % off)."""
    s, beacons = run.solution, dict(zip(log.truth.landmark_ids.tolist(), log.truth.landmarks))
    n = 3 * (len(s.poses) - 1)
    P = s.joint_covariance()
    ix = np.concatenate([3 * k + np.arange(2) for k in range(len(s.poses) - 1)] + [np.arange(n, len(P))])
    ends = log.truth.trajectory.interpolate([m.interval[1] for m in run.submaps])[:, :2]
    truth = np.vstack([ends, [beacons[int(i)] for i in s.landmark_ids]])
    mean = np.vstack([s.poses[1:, :2], s.landmarks])
    dof = 2 * len(truth) - 4
    low, high = chi2.ppf([0.005, 0.995], dof)
    assert low < free_nees(mean, P[np.ix_(ix, ix)], truth, scale=True) < high
    assert free_nees(mean, P[np.ix_(ix, ix)], truth, scale=False) > chi2.ppf(0.999, dof + 1)


def test_calibration_is_the_maximum_of_the_evidence(log):
    """The preset's figures, not the truth: the likelihood of the log falls on either side of every one of them."""
    evidence = Evidence(log)
    preset = {"speed_walk": 0.063, "yaw_walk": 0.0012, "range_sigma": 0.5, "range_scale": 1.066, "range_offset": 0.0}
    here = evidence(Model(**preset))
    steps = {"speed_walk": 0.03, "yaw_walk": 6e-4, "range_sigma": 0.05, "range_scale": 0.01, "range_offset": 0.5}
    for name, step in steps.items():
        for side in (-step, step):
            assert evidence(Model(**{**preset, name: preset[name] + side})) > here + 0.5, (name, side)


def test_range_calibration_is_taken_out_before_anything_else(log):
    noise = RangeBearingNoise(range_sigma=0.5, bearing_sigma=np.inf, range_scale=1.25, range_offset=6.0)
    drops = DropCounter()
    data = prepare_log(log, RbpfEkfConfig(association="known", max_range=40.0, noise=noise), drops)
    raw = log["landmarks"].ranges
    d = (raw - 6.0) / 1.25
    np.testing.assert_allclose(data.rows[:, 0], d[(d > 0) & (d <= 40.0)])
    np.testing.assert_allclose(raw[data.original], 1.25 * data.rows[:, 0] + 6.0)
    assert drops.counts["landmarks: ranges not positive"] == (d <= 0).sum() > 0
    assert drops.counts["landmarks: observations beyond 40 m"] == (d > 40).sum() > 0
    for bad in ({"range_scale": 0.0}, {"range_offset": np.nan}):
        with pytest.raises(ConfigError, match=next(iter(bad))):
            RangeBearingNoise(range_sigma=0.5, bearing_sigma=0.1, **bad)
