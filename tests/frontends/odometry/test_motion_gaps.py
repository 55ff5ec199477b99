"""Gaps of the wheels: bridged with consistent uncertainty, split off where nothing was seen, refused above a limit."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_exp, wrap_angle
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import Odometry, VelocityControls
from graphslam_frontends.odometry.motion import HEADING_UNKNOWN, MotionNoise, dead_reckoned_increments
from graphslam_frontends.odometry.motion_gaps import MotionGap, dead_reckon_over_gaps
from graphslam_studies.faults import landmarks as inject


def log_of(motion: VelocityControls | Odometry) -> SensorLog:
    return SensorLog(name="gaps", streams={"motion": motion})


def weave(rng: np.random.Generator, seconds: float = 120.0) -> VelocityControls:
    """A robot that changes speed and yaw rate every few seconds."""
    t = np.arange(0.0, seconds, 0.1)
    piece = (t / 7.0).astype(int)
    v, w = rng.uniform(0.2, 1.8, piece[-1] + 1)[piece], rng.normal(0.0, 0.06, piece[-1] + 1)[piece]
    return VelocityControls(times=t, speed=v, yaw_rate=w)


NOISE = MotionNoise(speed=0.01, yaw_rate=0.001)


def bridged(
    motion: VelocityControls | Odometry, times: np.ndarray, limit: float = 60.0, counts: DropCounter | None = None
) -> tuple[Odometry, list[MotionGap]]:
    counts = counts or DropCounter()
    odometry, _, gaps = dead_reckon_over_gaps(log_of(motion), times, NOISE, hold=0.0, limit=limit, drops=counts)
    return odometry, gaps


@pytest.mark.parametrize("step", [0.2, 20.0])
def test_the_end_of_a_gap_is_within_its_covariance(step: float) -> None:
    """Over many robots: NEES of the motion over a gap of 10 s, cut into small increments or as a single one."""
    nees = []
    for seed in range(200):
        whole = weave(np.random.default_rng(seed))
        times = np.arange(30.0, 50.0 + 1e-9, step)
        cut = whole.take((whole.times <= 35.0) | (whole.times >= 45.0))
        out, gaps = bridged(cut, times)
        true, _ = dead_reckoned_increments(log_of(whole), times, MotionNoise())
        assert len(gaps) == 1
        assert gaps[0].end - gaps[0].begin == pytest.approx(10.0)
        heading = [float(np.sum(o.increments[1:, 2])) for o in (out, true)]
        var = float(out.covariances[1:, 2, 2].sum())
        nees.append(wrap_angle(heading[0] - heading[1]) ** 2 / var)
    assert 0.3 < np.mean(nees) < 1.3
    assert np.mean(np.array(nees) < 9.0) > 0.98


def test_a_gap_is_counted_and_named() -> None:
    whole = weave(np.random.default_rng(0))
    cut = whole.take((whole.times <= 35.0) | (whole.times >= 65.0))
    times = np.arange(30.0, 70.0, 0.5)
    counts = DropCounter()
    out, _ = bridged(cut, times, counts=counts)
    assert counts.counts == Counter({"motion: gaps bridged": 1})
    assert np.sqrt(out.covariances[1:, 2, 2].sum()) <= HEADING_UNKNOWN + 0.1
    with pytest.raises(DataError, match=r"35\.0.*to 65\.0.*frontend\.longest_gap"):
        bridged(cut, times, limit=20.0)
    # what is no gap stays as it is
    same, none = bridged(whole, times)
    assert none == []
    np.testing.assert_array_equal(
        same.covariances, dead_reckoned_increments(log_of(whole), times, NOISE)[0].covariances
    )


def test_a_record_of_odometry_over_a_gap_is_believed_only_if_it_tells_the_way() -> None:
    t = np.arange(0.0, 60.0, 0.5)
    xi = np.tile([0.5, 0.0, 0.01], (len(t), 1))
    xi[0] = 0.0
    covariances = np.tile(np.diag([1e-4, 1e-4, 1e-6]), (len(t), 1, 1))
    whole = Odometry(times=t, increments=se2_exp(xi), covariances=covariances)
    keep = (t <= 20.0) | (t > 30.0)
    lost = whole.take(keep)
    full = Odometry(times=lost.times, increments=lost.increments.copy(), covariances=lost.covariances)
    full.increments[np.searchsorted(lost.times, 30.5)] = se2_exp(21 * xi[1])
    times = np.arange(15.0, 35.0, 0.5)
    for motion, speed in ((lost, 1.0), (full, 1.0)):
        out, gaps = bridged(motion, times)
        assert gaps[0].speed == pytest.approx(speed, rel=0.01)
        assert np.sum(out.increments[1:, 0]) == pytest.approx(19.5, rel=0.02)
    assert bridged(full, times)[1][0].speed_sigma == pytest.approx(0.2, rel=0.01)
    # beyond the limit, only a record that gives the motion bridges; a body may have stopped meanwhile
    with pytest.raises(DataError, match=r"0\.50 m over it.*frontend\.longest_gap"):
        bridged(lost, times, limit=5.0)
    assert bridged(full, times, limit=5.0)[1][0].speed == pytest.approx(1.0)
    full.increments[np.searchsorted(lost.times, 30.5)] = [2.0, 0.0, 0.0]
    out, gaps = bridged(full, times, limit=5.0)
    assert gaps[0].speed == pytest.approx(2.0 / 10.5)
    assert np.sum(out.increments[1:, 0]) == pytest.approx(2.0 + 0.5 * 18, rel=0.02)
    assert np.sqrt(out.covariances[1:, 0, 0].sum()) > 5.0  # as it drove on, or stopped


@pytest.mark.parametrize("frontend", ["rbpf-ekf", "ekf"])
def test_a_map_is_split_where_nothing_was_seen(frontend: str) -> None:
    log = simulate("landmark-field", seed=2, preset="quick")
    front = make_front_end(frontend, recommended_options(log, frontend)["frontend"])
    submaps = list(front.submaps(inject.gap_of_all(10.0)(log), seed=SeedTree(1)))
    bridge = [s for s in submaps if s.report["gaps"]]
    assert len(bridge) == 1
    assert bridge[0].report["scans"] == 1
    assert len(bridge[0].landmarks.ids) == 0
    assert bridge[0].interval[0] < 20.0 < 30.0 <= bridge[0].interval[1]
    assert bridge[0].report["after_gap"] > 0
    # a run that is gone on with in the middle of it makes the same submaps
    k = submaps.index(bridge[0])
    rest = list(front.submaps(inject.gap_of_all(10.0)(log), seed=SeedTree(1), after=submaps[k - 1]))
    for a, b in zip(submaps[k:], rest, strict=True):
        np.testing.assert_array_equal(a.landmarks.covariance, b.landmarks.covariance)


def test_impossible_limits_are_refused() -> None:
    log = simulate("landmark-field", seed=2, preset="quick")
    for frontend in ("rbpf-ekf", "ekf", "ekf-slam"):
        with pytest.raises(ConfigError, match="longest_gap"):
            make_front_end(frontend, recommended_options(log, frontend)["frontend"] | {"longest_gap": -1.0})
