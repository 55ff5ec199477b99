"""Recorded odometry: cut, chained, bridged, degraded, and as far off over intervals as it says."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import chi2

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_log
from graphslam.core.log import DropCounter
from graphslam.core.records import Odometry
from graphslam.io.catalog import load_recording
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.motion import MotionNoise, cut_odometry
from graphslam_frontends.odometry.motion_prior import MotionPrior, OdometryBiases, bias_effect
from graphslam_frontends.odometry.recorded import (
    add_yaw_bias,
    bridge_gap,
    chain_odometry,
    motion_is_given,
)
from graphslam_frontends.odometry.step_config import StepConfig

NOISE = MotionNoise(floor_position=1e-6, floor_heading=1e-6)


def exp(v: np.ndarray) -> np.ndarray:
    return se2_exp(v) if v.shape[-1] == 3 else se3.se3_exp(v)


def log(T: np.ndarray) -> np.ndarray:
    return se2_log(T) if T.shape[-1] == 3 else se3.se3_log(T)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return se2_compose(a, b) if np.shape(a)[-1] == 3 else se3.se3_compose(a, b)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return se2_between(a, b) if np.shape(a)[-1] == 3 else se3.se3_between(a, b)


def prior(odometry: Odometry, **biases: float) -> MotionPrior:
    path = chain_odometry(odometry)
    states = OdometryBiases(odometry=odometry, **biases)
    return MotionPrior(odometry=odometry, poses=path.poses, path=path, biases=states)


def winding(dim: int, n: int = 101, dt: float = 0.2) -> Odometry:
    """Increments of a drive with turns (and slopes); σ 5 mm and 1 mrad a record."""
    s = np.arange(n)
    if dim == 2:
        xi = np.column_stack([0.2 + 0 * s, 0.01 * np.sin(s), 0.08 * np.sin(0.1 * s)])
        sigma = [0.005, 0.005, 0.001]
    else:
        turn = np.column_stack([0.01 * np.sin(0.3 * s), 0.01 * np.cos(0.2 * s), 0.08 * np.sin(0.1 * s)])
        xi = np.column_stack([turn, 0.2 + 0 * s, 0.01 * np.sin(s), 0.005 * np.cos(s)])
        sigma = [0.001, 0.001, 0.001, 0.005, 0.005, 0.005]
    xi[0] = 0.0
    covariance = np.diag(np.square(sigma))
    return Odometry(times=dt * s, increments=exp(xi), covariances=np.tile(covariance, (n, 1, 1)))


@pytest.mark.parametrize("dim", [2, 3])
def test_errors_over_an_interval_are_as_stated(dim: int) -> None:
    """2000 robots whose odometry is off as it says, white noise, yaw rate and scale: NEES on both sides."""
    measured, runs, d = winding(dim), 2000, 3 if dim == 2 else 6
    errors = prior(measured, yaw_bias=0.003, scale=0.01)
    rng = np.random.default_rng(dim)
    xi, sigma = log(measured.increments), np.sqrt(np.diagonal(measured.covariances, axis1=1, axis2=2))
    distances = slice(0, 2) if dim == 2 else slice(3, 6)
    start, end = 20, 90
    T, C = errors.between(start, end)
    U = np.tile(np.zeros(3) if dim == 2 else [0.0, 0, 0, 0, 0, 0, 1], (runs, 1))
    rate, scale = 0.003 * rng.normal(size=runs), 0.01 * rng.normal(size=(runs, 1))
    for k in range(start + 1, end + 1):
        off = np.tile(xi[k], (runs, 1))
        off[:, 2] += rate * 0.2
        off[:, distances] *= 1.0 + scale
        U = compose(U, compose(exp(off), exp(sigma[k] * rng.normal(size=off.shape))))
    e = log(between(np.broadcast_to(T, U.shape), U))
    squares = np.sum(e * np.linalg.solve(C, e.T).T, axis=1)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], runs * d) / runs
    assert low < np.mean(squares) < high
    assert 0.92 < np.mean(np.array(squares) < chi2.ppf(0.95, d)) < 0.98
    # and without what lasts it would promise too much
    white = prior(measured).between(start, end)[1]
    assert C[2, 2] > 4 * white[2, 2]


@pytest.mark.parametrize("dim", [2, 3])
def test_bias_effect_equals_finite_differences(dim: int) -> None:
    step, seconds, eps = winding(dim).increments[13], 0.2, 1e-6
    xi = log(step)
    J = bias_effect(step, seconds)
    turned, longer = xi.copy(), xi.copy()
    turned[2] += eps * seconds
    distances = slice(0, 2) if dim == 2 else slice(3, 6)
    longer[distances] *= 1 + eps
    np.testing.assert_allclose(log(between(step, exp(turned))) / eps, J[:, 0], atol=1e-6)
    np.testing.assert_allclose(log(between(step, exp(longer))) / eps, J[:, 1], atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_cutting_equals_composing_piece_by_piece(dim: int) -> None:
    o = winding(dim)
    times = np.array([0.1, 0.5, 0.55, 0.6, 3.0, 20.0])
    cut = cut_odometry(o, times, NOISE)
    path = chain_odometry(o)
    np.testing.assert_allclose(
        log(between(cut.increments[1:], between(*(path.interpolate(t) for t in (times[:-1], times[1:]))))), 0, atol=1e-9
    )
    knots = np.union1d(o.times, times)
    for k in range(1, len(times)):
        inside = knots[(knots >= times[k - 1]) & (knots <= times[k])]
        P = np.diag(np.full(o.covariances.shape[1], 1e-12))
        for a, b in pairwise(inside):
            record = int(np.searchsorted(o.times, 0.5 * (a + b)))
            piece = between(*path.interpolate([a, b]))
            J = np.empty_like(P)  # by differences: an error before the piece, seen after it
            for i in range(len(P)):
                e = np.eye(len(P))[i] * 1e-6
                J[:, i] = log(between(piece, compose(exp(e), piece))) / 1e-6
            P = J @ P @ J.T + (b - a) / 0.2 * o.covariances[record]
        np.testing.assert_allclose(cut.covariances[k], P, rtol=1e-3, atol=1e-10)


def test_whole_records_come_back_as_they_were() -> None:
    o = winding(3)
    cut = cut_odometry(o, o.times[10:20], NOISE)
    np.testing.assert_allclose(cut.increments[1:], o.increments[11:20], atol=1e-15)
    with pytest.raises(DataError, match="outside the odometry"):
        cut_odometry(o, np.array([19.0, 20.5]), NOISE)
    assert len(cut_odometry(o, o.times[3:4], NOISE).times) == 1


@pytest.mark.parametrize("dim", [2, 3])
def test_a_yaw_bias_turns_by_what_it_says(dim: int) -> None:
    o = winding(dim)
    still = Odometry(times=o.times, increments=exp(np.zeros_like(log(o.increments))), covariances=o.covariances)
    biased = chain_odometry(add_yaw_bias(still, 0.01)).poses[-1]
    assert log(biased)[2] == pytest.approx(0.01 * 20.0)
    np.testing.assert_allclose(add_yaw_bias(add_yaw_bias(o, 0.02), -0.02).increments, o.increments, atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_bridges_cost_certainty(dim: int) -> None:
    o = winding(dim)
    path = chain_odometry(o)
    keep = np.r_[0:30, 45:101]
    gap = Odometry(
        times=o.times[keep],
        increments=np.concatenate([o.increments[:1], between(path.poses[keep][:-1], path.poses[keep][1:])]),
        covariances=o.covariances[keep],
    )
    drops = DropCounter()
    bridged, gaps = bridge_gap(gap, 5.0, where="odometry", drops=drops)
    np.testing.assert_allclose([gaps.begin[0], gaps.end[0]], gap.times[[29, 30]])
    assert drops.counts == {"odometry: gap bridged": 1}
    changed = np.flatnonzero(np.any(bridged.covariances != gap.covariances, axis=(1, 2)))
    np.testing.assert_array_equal(changed, [30])
    x = 0 if dim == 2 else 3
    metres = np.linalg.norm(log(gap.increments[30])[x : x + dim])
    assert np.sqrt(bridged.covariances[30, x, x]) == pytest.approx(0.2 * metres, rel=0.01)
    with pytest.raises(DataError, match=r"odometry: gap without records: 3\.200 s after record 29"):
        bridge_gap(o.take(keep), 3.0, where="odometry")
    assert bridge_gap(o, 1.0, where="odometry")[0] is not None
    # records that are lost, not late: the one after tells its own motion only, and the body drove on meanwhile
    lost, _ = bridge_gap(o.take(keep), 5.0, where="odometry")
    speed = np.linalg.norm(log(o.increments[29])[x : x + dim]) / np.diff(o.times)[28]
    assert np.sqrt(lost.covariances[30, x, x]) == pytest.approx(3.2 * speed, rel=0.2)
    # a long record at the beginning, in which the body stood: it set off afterwards, and nothing was lost
    stood = replace(o, times=np.r_[o.times[0] - 3.0, o.times[1:]], increments=o.increments.copy())
    stood.increments[1] *= 0.0
    still, gaps = bridge_gap(stood, 5.0, where="odometry")
    assert len(gaps.begin) == 1
    np.testing.assert_array_equal(still.covariances, stood.covariances)


def test_a_pause_while_turning_on_the_spot_is_no_loss_of_records() -> None:
    times = np.r_[np.arange(10) * 0.2, 1.8 + 3.0 + np.arange(10) * 0.2]
    increments = np.zeros((20, 3))
    increments[1:, 0], increments[1:, 2] = 1e-3, 0.1  # 5 mm/s
    increments[10] = [2e-3, 0.0, -0.38]
    o = Odometry(times=times, increments=increments, covariances=np.tile(1e-4 * np.eye(3), (20, 1, 1)))
    bridged, _ = bridge_gap(o, 20.0, where="odometry")
    assert np.sqrt(bridged.covariances[10, 2, 2]) == pytest.approx(np.hypot(0.01, 0.2 * 0.38), rel=0.02)
    # the yaw rate of the other records does not come from two stamps that are 1 ms apart
    moving = replace(o, increments=increments * [100.0, 1.0, 1.0])
    lost = bridge_gap(moving, 20.0, where="odometry")[0].covariances[10, 2, 2]
    bunched = replace(moving, times=times - np.where(np.arange(20) == 5, 0.199, 0.0))
    assert np.sqrt(bridge_gap(bunched, 20.0, where="odometry")[0].covariances[10, 2, 2]) < 1.1 * np.sqrt(lost)


def test_intervals_that_are_not_there() -> None:
    errors = prior(winding(3))
    for start, end in ((-1, 3), (5, 4), (0, 101)):
        with pytest.raises(DataError, match="no such interval"):
            errors.between(start, end)
    with pytest.raises(DataError, match="where level is"):
        errors.between(0, 3, level_end=True)
    prior(winding(2)).between(0, 3, level_start=True, level_end=True)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "scans", "gaps"), [("lidar3d-hku1", 314, 2), ("lidar3d-balm-hall", 61, 0), ("lidar3d-hku-mb", 457, 15)]
)
def test_recorded_lidars_become_steps(data_dir: Path, name: str, scans: int, gaps: int) -> None:
    """One step a scan and several steps a scan: the same robot drives the same way."""
    recorded = load_recording(name)
    if name == "lidar3d-balm-hall":  # 30 s of it: its scans are large
        recorded = recorded.slice(recorded.interval[0], recorded.interval[0] + 30.0)
    drops = DropCounter()
    steps = make_steps(recorded, StepConfig(period=None, most_points=2000, max_range=20.0), drops=drops)
    assert (steps.dim, len(steps)) == (3, scans)
    assert drops.counts.get(f"{recorded.name}/odometry: gap bridged", 0) == gaps
    assert np.diff(steps.offsets).min() > 0
    path = chain_odometry(recorded["odometry"])
    T, C = steps.errors.between(0, scans - 1)
    np.testing.assert_allclose(T, se3.se3_between(path.poses[0], path.poses[-1]), atol=1e-6)
    np.linalg.cholesky(C)
    # neighbouring scans, moved by the odometry, lie on each other: deskewing and frames are right
    near = []
    for k in range(20, 50):
        (a, _, met_a), (b, _, met_b) = steps.scan(k), steps.scan(k + 1)
        moved = se3.se3_transform(steps.odometry.increments[k + 1], b[met_b][::10])
        near.append(np.median(cKDTree(a[met_a]).query(moved)[0]))
    assert np.median(near) < 0.25

    drops = DropCounter()
    often = make_steps(recorded, StepConfig(most_points=200), drops=drops)
    assert len(often) == pytest.approx(recorded.duration / 0.4, abs=2)
    assert np.diff(often.offsets).max() == 200
    empty = np.sum(np.diff(often.offsets) == 0)
    assert drops.counts["steps: step without a beam (kept)"] == empty > 10
    ends = path.interpolate(often.times[[0, -1]])
    np.testing.assert_allclose(often.errors.between(0, len(often) - 1)[0], se3.se3_between(*ends), atol=1e-6)


def test_several_clouds_in_a_step(data_dir: Path) -> None:
    recorded = load_recording("lidar3d-hku1")
    steps = make_steps(recorded, StepConfig(period=2.0, most_points=100_000))
    per_step = np.diff(steps.offsets)
    assert len(steps) == pytest.approx(recorded.duration / 2.0, abs=2)
    assert np.median(per_step) > 3 * np.median(recorded["clouds"].counts)
    assert per_step.sum() <= recorded["clouds"].counts.sum()


def paused(dim: int, seconds: float, moved: float, *, still: bool, jump: float = 0.0) -> Odometry:
    """A drive at 1 m/s with a pause in the recording after record 50: ``moved`` [m] over it."""
    o = winding(dim)
    times, xi = o.times.copy(), log(o.increments)
    x = 0 if dim == 2 else 3
    times[51:] += seconds
    if still:
        xi[45:57] = 0.0
    xi[51] = 0.0
    xi[51, x] = moved + jump
    return Odometry(times=times, increments=exp(xi), covariances=o.covariances)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("seconds", "moved", "still"), [(21.0, 0.6, False), (198.0, 0.0, True), (40.0, 30.0, False)])
def test_a_long_pause_that_odometry_bridges_is_kept_and_widened(
    dim: int, seconds: float, moved: float, still: bool
) -> None:
    o, drops = paused(dim, seconds, moved, still=still), DropCounter()
    wide, gaps = bridge_gap(o, 20.0, where="odometry", drops=drops)
    assert drops.counts == {"odometry: gap bridged": 1}
    assert gaps.end - gaps.begin == pytest.approx([seconds + 0.2])
    np.testing.assert_array_equal(wide.increments, o.increments)
    added = np.diagonal(wide.covariances[51] - o.covariances[51])
    rate = np.diagonal(o.covariances[1]) / 0.2  # variance per second of the other records
    assert np.all(added >= 0.99 * rate * seconds)
    longer, _ = bridge_gap(paused(dim, 2 * seconds, moved, still=still), 20.0, where="odometry")
    assert np.all(np.diagonal(longer.covariances[51]) > np.diagonal(wide.covariances[51]))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("moved", "jump"), [(0.2, 0.0), (0.6, 300.0)])
def test_a_clock_that_was_set_and_odometry_that_was_reset_bridge_nothing(dim: int, moved: float, jump: float) -> None:
    o = paused(dim, 60.0, moved, still=False, jump=jump)
    with pytest.raises(DataError, match=rf"{moved + jump:.2f} m over it.*at most 20 s \(frontend\.steps\.longest_"):
        bridge_gap(o, 20.0, where="odometry")
    assert not motion_is_given(o, float(o.times[50]), float(o.times[51]))
    assert motion_is_given(o, 0.0, float(o.times[50]))
    assert not motion_is_given(o, 0.0, float(o.times[-1]) + 1.0)
