"""Refinement in the plane: constant errors of wheels, a wheel that slips, turns on the spot, σ of recorded odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE2
from graphslam.core.records import LaserScans, Odometry
from graphslam.refine import revisit_constraints
from graphslam.refine.config import RefineConfig
from graphslam.refine.refine import refine_by_scans
from graphslam.refine.scans import Scans
from graphslam.refine.surfaces import ScanReturns
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.step_config import StepConfig
from tests.calibrate.room import drive, scan


def started(seconds=100.0, **errors):
    """Scans of a drive, dead reckoning, and the truth from the first pose."""
    log, truth = drive(seconds=seconds, stated=5e-3, **errors)
    scans = Scans.of(make_steps(log, StepConfig(period=None, match_scans=False)))
    u = scans.odometry.increments
    start = [np.zeros(3)]
    for k in range(1, len(u)):
        start.append(se2_compose(start[-1], u[k]))
    return scans, np.array(start), se2_between(np.broadcast_to(truth[0], truth.shape), truth)


def refined(**errors):
    """The refinement from dead reckoning, and its greatest distance from the truth [m]."""
    scans, start, true = started(noise=0.005, **errors)
    found = refine_by_scans(scans, start)
    return found, float(np.hypot(*(found.poses - true)[:, :2].T).max()), start, true


def normalised(found, true):
    """NEES per degree of freedom ``(n - 1,)`` of all steps but the first, which is held."""
    e = found.poses[1:] - true[1:]
    e[:, 2] = np.angle(np.exp(1j * e[:, 2]))
    c, s = np.cos(true[1:, 2]), np.sin(true[1:, 2])
    e[:, :2] = np.column_stack([c * e[:, 0] + s * e[:, 1], -s * e[:, 0] + c * e[:, 1]])
    return np.einsum("ki,kij,kj->k", e, np.linalg.inv(found.covariances[1:]), e) / 3.0


def test_biases_of_wheels_are_found() -> None:
    """Distances 3 % too long, and a turn of 0.02 rad a metre too far to the left."""
    found, off, start, true = refined(scale=1.03, bend=0.02)
    assert np.hypot(*(start - true)[:, :2].T).max() > 1.0
    assert off < 0.03
    scale, sigma = found.constants["scale"]
    assert sigma < 0.005
    assert abs(scale - 0.03) < max(4.0 * sigma, 0.003)
    # what each metre, each radian and each second turn too far can stand for each other: their sum is told
    metres = np.hypot(*np.diff(true[:, :2], axis=0).T).sum()
    turned = np.diff(np.unwrap(true[:, 2])).sum()
    t, b = found.yaw_bias.T
    bias = float(np.sum(0.5 * (b[1:] + b[:-1]) * np.diff(t)))
    total = bias + found.constants["bend"][0] * metres + found.constants["turn"][0] * turned
    assert total == pytest.approx(0.02 * metres, rel=0.1)


def test_a_wheel_that_slips_once_bends_nothing() -> None:
    _, clean, _, _ = refined()
    found, off, start, true = refined(slip=0.5)
    assert np.hypot(*(start - true)[:, :2].T).max() > 0.4
    assert off < 1.5 * clean + 0.01
    assert found.better


def test_the_error_is_as_large_as_the_covariance_says() -> None:
    """Odometry with the noise that it states, over six rooms and drives."""
    values = []
    for seed in range(3, 9):
        scans, start, true = started(seconds=60.0, spread=5e-3, seed=seed)
        values.append(normalised(refine_by_scans(scans, start), true).mean())
    assert 0.5 < np.mean(values) < 1.1


def test_errors_that_a_scan_has_in_common_widen_the_covariance() -> None:
    """All ranges of a scan are off by 1 cm, as much as each by itself."""
    values, found = [], []
    for seed in range(3, 7):
        scans, start, true = started(seconds=60.0, spread=5e-3, seed=seed)
        rng = np.random.default_rng(seed)
        off = np.repeat(1e-2 * rng.standard_normal(len(scans)), np.diff(scans.offsets))
        ends = scans.points - scans.origins
        ends *= 1.0 + off[:, None] / np.maximum(np.linalg.norm(ends, axis=1, keepdims=True), 0.1)
        found.append(refine_by_scans(replace(scans, points=(scans.origins + ends).astype(np.float32)), start))
        values.append(normalised(found[-1], true).mean())
    assert all(r.alike > 2.0 for r in found)
    assert 0.4 < np.mean(values) < 1.6


def test_a_step_between_nodes_is_uncertain_where_wheels_slipped() -> None:
    """Between nodes only the odometry tells the way, and a slip lies anywhere between them."""
    scans, start, true = started(seconds=60.0, spread=5e-3, slip=0.5)
    found = refine_by_scans(scans, start, RefineConfig(spacing=1.0, turn=1.0))
    off = np.hypot(*(found.poses - true)[:, :2].T)
    assert off.max() > 0.2  # nobody can know better
    nees = normalised(found, true)
    assert nees.max() < 10.0
    assert 0.4 < nees.mean() < 1.4


def corridor(seed, *, rest=0.0):
    """Scans of a drive of 24 m through a corridor without an end in sight, dead reckoning, and the truth.

    It stands for ``rest`` seconds at the start and half way; odometry errs with every record, as it says.
    """
    rng = np.random.default_rng(seed)
    walls = np.array([[-40.0, y, 80.0, y] for y in (-1.1, 1.1)])
    x = np.linspace(0.0, 24.0, 150)
    path = np.column_stack([x, 0.2 * np.sin(x / 4), np.arctan(0.05 * np.cos(x / 4))])
    still = int(rest / 0.3)
    path = np.concatenate([np.repeat(path[:1], still, 0), path[:75], np.repeat(path[75:76], still, 0), path[75:]])
    t, bearings = 0.3 * np.arange(len(path)), np.linspace(-np.pi / 2, np.pi / 2, 121)
    ranges = np.array([scan(p, walls, bearings) for p in path])
    ranges = np.where(ranges > 8.0, np.inf, ranges + 0.02 * rng.standard_normal(ranges.shape))
    xi = np.zeros((len(t), 3))
    xi[1:] = se2_log(se2_between(path[:-1], path[1:]))
    d = np.hypot(xi[:, 0], xi[:, 1])
    sigma = np.sqrt(np.column_stack([9e-4 * d + 1e-6, np.full(len(d), 1e-6), 4e-4 * d + 2.5e-7]))
    xi[1:] += (sigma * rng.standard_normal(sigma.shape))[1:]
    odometry = Odometry(times=t, increments=se2_exp(xi), covariances=np.einsum("ki,ij->kij", sigma**2, np.eye(3)))
    scans = LaserScans(times=t, ranges=ranges, bearings=bearings, max_range=8.1)
    log = SensorLog(name="corridor", streams={"odometry": odometry, "scans": scans})
    steps = Scans.of(make_steps(log, StepConfig(period=None, match_scans=False)))
    true = path[np.searchsorted(t, steps.times)]
    return steps, chain_odometry(steps.odometry).poses, se2_between(np.broadcast_to(true[0], true.shape), true)


def test_a_corridor_is_uncertain_along_itself() -> None:
    """Noise of the normals adds up to what looks like a hold along smooth walls, and pulls the path together."""
    along, across = [], []
    for seed in range(6):
        steps, start, true = corridor(seed)
        found = refine_by_scans(steps, start)
        e = se2_log(se2_between(found.poses, true))[20:]
        variance = np.einsum("kii->ki", found.covariances)[20:]
        along.append(np.mean(e[:, 0] ** 2 / variance[:, 0]))
        across.append(np.mean(e[:, 1:] ** 2 / variance[:, 1:]))
        # odometry alone: 0.03 m/√m, and a scale of its own that is known to a hundredth
        assert 0.12 < np.sqrt(variance[-1, 0]) < 0.4
    assert 0.2 < np.mean(along) < 2.2
    assert 0.3 < np.mean(across) < 2.0


def test_where_a_robot_stood_is_as_uncertain_as_its_odometry_until_it_left() -> None:
    """Relative poses over 6 s, in rests and across their ends, where steps lie between nodes far apart in time."""
    values = []
    for seed in range(4):
        steps, start, true = corridor(seed, rest=24.0)
        found = refine_by_scans(steps, start)
        for k in range(0, len(steps) - 20, 7):
            P = found.joint([k, k + 20])
            step = se2_between(found.poses[k], found.poses[k + 20])
            J = np.hstack([-SE2.adjoint(SE2.inverse(step)), np.eye(3)])
            e = se2_log(se2_between(step, se2_between(true[k], true[k + 20])))
            values.append(e @ np.linalg.solve(J @ P @ J.T, e) / 3.0)
    assert np.max(values) < 9.0
    assert 0.4 < np.mean(values) < 1.4  # what two steps of one rest share is not counted


def test_turns_on_the_spot_begin_new_chunks() -> None:
    log, _ = drive(seconds=50.0)
    scans = Scans.of(make_steps(log, StepConfig(period=None, match_scans=False)))
    turned = np.abs(scans.odometry.increments[:, 2])
    cloud = ScanReturns.of(scans, chunk_length=100.0, chunk_time=1000.0, chunk_turn=0.5)
    assert cloud.chunks > 3
    for c in range(cloud.chunks):
        inside = np.flatnonzero(cloud.chunk == c)
        assert turned[inside[1:]].sum() <= 0.5
    assert ScanReturns.of(scans, chunk_length=100.0, chunk_time=1000.0).chunks == 1


def test_scans_that_mended_the_odometry_are_not_in_its_sigma() -> None:
    """Steps may be mended by matches of their scans; the refinement spends these scans itself."""
    log, _ = drive(seconds=30.0, stated=0.02)
    mended = make_steps(log, StepConfig(period=None, match_scans=True))
    plain = make_steps(log, StepConfig(period=None, match_scans=False))
    assert mended.recorded is not None
    mine = Scans.of(mended).odometry.covariances
    np.testing.assert_array_equal(mine, mended.recorded.covariances)
    np.testing.assert_allclose(mine, Scans.of(plain).odometry.covariances, rtol=1e-9)
    assert np.median(mended.odometry.covariances[1:, 2, 2] / mine[1:, 2, 2]) < 0.9


def test_combinations_of_the_joint_covariance_are_those_of_the_whole(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of steps between nodes; and guides together and one by one have the same distances."""
    found = refined()[0]
    steps = np.sort(rng.choice(len(found.poses), 6, replace=False))
    J = rng.standard_normal((18, 4))
    whole = found.joint(steps)
    np.testing.assert_allclose(found.joint(steps, J), J.T @ whole @ J, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(whole[3:6, 3:6], found.joint(steps[1:2]), rtol=1e-9, atol=1e-15)
    path = found.poses[found.nodes]
    pairs = rng.integers(0, len(path), (20, 2))
    near = SE2.compose(SE2.between(path[pairs[:, 0]], path[pairs[:, 1]]), SE2.exp(0.1 * rng.standard_normal((20, 3))))
    guides = revisit_constraints.RevisitConstraints(pairs[pairs[:, 0] != pairs[:, 1]], near[pairs[:, 0] != pairs[:, 1]])
    together = guides.distances(path, found.solved, 3)
    monkeypatch.setattr(revisit_constraints, "TOGETHER", 1)
    np.testing.assert_allclose(guides.distances(path, found.solved, 3), together, rtol=1e-9)
