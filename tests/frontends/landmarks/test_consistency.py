"""Pooled independent filters and the flag: pooling is consistent where one small filter is not, and the alarm rings."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import Gaussian
from graphslam.core.geometry import wrap_angle
from graphslam.core.random import SeedTree
from graphslam.evaluate.metrics import Metrics, flag_counts, front_end_metrics
from graphslam_frontends.landmarks.config import RbpfEkfConfig, StoppingConfig
from graphslam_frontends.landmarks.moment_consistency import consistency_flag, pool_gaussians, variance_bounds
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf
from graphslam_frontends.odometry.motion import MotionNoise
from graphslam_studies.evaluate.submap_consistency import submaps_consistency


def test_pool_is_unbiased_for_estimates_of_one_posterior():
    """K sets of n draws of N(μ, C) each: the pooled covariance is C + (1 + 1/K) C/n on average."""
    rng = np.random.default_rng(1)
    C = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.02]])
    k, n = 5, 8
    totals = []
    for _ in range(4000):
        x = rng.multivariate_normal([1.0, 2.0, np.pi], C, (k, n))
        x[..., 2] = wrap_angle(x[..., 2])
        gs = [Gaussian(np.r_[s[:, :2].mean(0), np.pi + wrap_angle(s[:, 2] - np.pi).mean()], C, (2,)) for s in x]
        g = pool_gaussians([Gaussian(np.r_[a.mean[:2], wrap_angle(a.mean[2])], C, (2,)) for a in gs])
        assert abs(wrap_angle(g.mean[2] - np.pi)) < 0.5  # averaged on the circle
        totals.append(g.covariance)
    expected = C * (1 + (1 + 1 / k) / n)
    s = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.mean(totals, 0) / np.outer(s, s), expected / np.outer(s, s), atol=0.006)


@pytest.fixture(scope="module")
def maps():
    """Local maps of the good sensor, where forty particles are hopeless: moments, five filters pooled, smoothed."""
    out = {}
    for seed in range(3):
        log = simulate("landmark-field", seed=seed, preset="C", layout_seed=1)
        log = log.slice(*(log.interval[0] + np.array([0.0, 240.0])))
        for handover in ("smoothed", "moments", "pooled"):
            config = RbpfEkfConfig(
                association="known",
                motion=MotionNoise(speed=0.3, steering=np.deg2rad(3.0)),
                stopping=StoppingConfig(scans=59),
                handover=handover,
                pooled=0 if handover == "moments" else 5,
            )
            submaps = [s for s in RbpfEkf(config).submaps(log, seed=SeedTree(seed)) if s.report["scans"] == 59]
            out.setdefault(handover, []).append((log, submaps))
    return out


def _pose_nees(runs):
    return np.concatenate([submaps_consistency(submaps, log.truth)["exit"].nees[0] for log, submaps in runs]) / 3.0


def test_pooling_repairs_what_moments_break(maps):
    """Pose NEES/3 of forty-particle moments is off by tens with a good sensor; pooled maps are near one."""
    moments, pooled, smoothed = (_pose_nees(maps[h]) for h in ("moments", "pooled", "smoothed"))
    assert len(moments) >= 55
    assert moments.mean() > 5.0
    assert 0.7 < smoothed.mean() < 1.35
    assert 0.6 < pooled.mean() < 2.5
    assert pooled.mean() < 0.25 * moments.mean()


def test_the_alarm_rings_for_moments_that_are_handed_over_and_not_for_the_rest(maps):
    flags = {h: [s.report["flag"] for _, submaps in maps[h] for s in submaps] for h in maps}
    rings = {h: np.mean([bool(f) for f in flags[h]]) for h in maps}
    assert rings["moments"] > 0.8  # forty particles with a good sensor descend from two or three
    assert all("ancestors" in f for f in flags["moments"] if f)
    assert rings["smoothed"] <= 0.05
    assert rings["pooled"] <= 0.05
    reports = [s.report for _, submaps in maps["smoothed"] for s in submaps]
    d2 = {p: np.median([r[f"{p}_d2_per_dof"] for r in reports]) for p in ("moment", "pooled")}
    assert d2["pooled"] < d2["moment"]
    assert np.median([r["pooled_kl"] for r in reports]) < np.median([r["moment_kl"] for r in reports])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"noise": {"range_sigma": 0.05, "bearing_sigma": float(np.deg2rad(0.5))}}, "residuals"),  # a quarter
        ({"particles": 4}, "ess"),
        ({"handover": "moments", "particles": 20}, "ancestors"),
    ],
)
def test_degenerate_filters_and_wrong_noise_are_flagged(options, reason):
    log = simulate("landmark-field", seed=3, preset="quick")
    merged = recommended_options(log, "rbpf-ekf")["frontend"] | options
    submaps = list(make_front_end("rbpf-ekf", merged).submaps(log, seed=SeedTree(1)))
    assert np.mean([reason in s.report["flag"] for s in submaps]) > 0.7


def test_consistent_filters_are_flagged_in_one_submap_of_twenty_at_most():
    """Drawn worlds, noises and seeds, identities known and not."""
    rng, flags = np.random.default_rng(4), []
    for seed in range(60, 66):
        log = simulate(
            "landmark-field",
            seed=seed,
            preset="quick",
            sigma_range=rng.uniform(0.1, 0.5),
            sigma_bearing=np.deg2rad(rng.uniform(1.0, 5.0)),
        )
        association = ("known", "likelihood")[seed % 2]
        options = recommended_options(log, "rbpf-ekf")["frontend"] | {"association": association}
        flags += [bool(s.report["flag"]) for s in make_front_end("rbpf-ekf", options).submaps(log, seed=SeedTree(seed))]
    assert len(flags) > 35
    assert np.mean(flags) <= 0.05


def test_bounds_of_a_variance_are_those_of_draws():
    rng = np.random.default_rng(2)
    for n in (3, 12, 40):
        low, high = variance_bounds(n)
        ratios = rng.standard_normal((20000, n)).var(axis=1)
        outside = np.mean((ratios < low) | (ratios > high))
        assert 0.6 < outside / (0.01 / 3) < 1.5
    assert variance_bounds(1.9) == (0.0, np.inf)


def test_watching_changes_nothing_that_is_handed_over():
    log = simulate("landmark-field", seed=3, preset="quick")
    one, watched = (
        list(RbpfEkf(RbpfEkfConfig(association="known", particles=8, pooled=k)).submaps(log, seed=SeedTree(2)))
        for k in (0, 3)
    )
    assert len(one) == len(watched)
    for a, b in zip(one, watched):
        np.testing.assert_array_equal(a.landmarks.covariance, b.landmarks.covariance)
        assert a.report["moment_kl"] == b.report["moment_kl"]
        assert b.report["dropped_filters"] == 0
        assert "pooled_kl" not in a.report
        assert b.report["pooled_kl"] != b.report["moment_kl"]


@pytest.mark.parametrize(
    ("figures", "particles", "expected"),
    [
        ({"moment_pose_variance_ratio": [1.0, 0.6, 1.9], "min_ess": 2.0, "effective_ancestors": 12.0}, 40, []),
        ({"moment_pose_variance_ratio": [1.0, 0.6, 1.9], "min_ess": 2.0, "effective_ancestors": 40.0}, 40,
         ["moment-pose-variance"]),
        ({"moment_pose_variance_ratio": [1.0, 0.1, 9.0], "min_ess": 1.9, "effective_ancestors": 1.5}, 40, ["ess"]),
        ({"moment_pose_variance_ratio": [1, 1, 1], "min_ess": 5.0, "effective_ancestors": 9.0, "handover": "moments"},
         40, ["ancestors"]),
        ({"moment_pose_variance_ratio": [1, 1, 1], "pooled_pose_variance_ratio": [1, 1, 0.1], "min_ess": 5.0,
          "effective_ancestors": 4.0, "pooled_filters": 5}, 40, ["pooled-pose-variance"]),
        ({"moment_pose_variance_ratio": None, "moment_kl": None, "min_ess": 5.0, "handover": "moments"}, 6,
         ["moment-missing"]),
        ({"moment_pose_variance_ratio": None, "moment_kl": None, "min_ess": 5.0}, 6, []),
        ({"moment_pose_variance_ratio": [np.nan, 1, 1], "min_ess": 50.0}, 60, ["moment-pose-variance"]),
        ({"min_ess": 1.0, "chi2": 150.0, "dof": 100}, 1, ["residuals"]),
        ({"min_ess": 1.0, "chi2": 120.0, "dof": 100}, 1, []),
    ],
)  # fmt: skip
def test_flag_names_its_reasons(figures, particles, expected):
    assert consistency_flag(figures, particles) == expected


def test_flagged_maps_are_counted(maps):
    submaps = maps["moments"][0][1]
    counts = flag_counts(submaps)
    assert counts["any"] == sum(bool(s.report["flag"]) for s in submaps) > 0
    assert counts["ancestors"] == sum("ancestors" in s.report["flag"] for s in submaps)
    out = Metrics()
    front_end_metrics(out, submaps)
    assert {r["key"]: r["value"] for r in out.rows}["flagged_submaps"] == counts["any"]


def test_impossible_pools_are_refused():
    for bad in ({"pooled": 1}, {"pooled": -2}, {"handover": "pooled"}):
        with pytest.raises(ConfigError, match="pooled"):
            RbpfEkfConfig(**bad)
