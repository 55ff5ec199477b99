"""Scan-to-window odometry: its derivatives, what it knows when, and how consistent it is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, se2_between
from graphslam.core.poses import SE2, SE3, compose_increments, group_of
from graphslam.core.records import Odometry
from graphslam.core.se3 import matrix_to_quat
from graphslam.core.trajectory import Trajectory
from graphslam.registration.plane_kernels import PlanePairs, plane_residuals
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_frontends.scan_window.tracker import ScanToWindowOdometry, TrackedPath, bias_effects, track_steps
from tests.frontends.grid_world import ring

CONFIG = ScanWindowConfig(lay=2.0)


def head(steps: Steps, n: int) -> Steps:
    """The first n steps."""
    rows = int(steps.offsets[n])
    o = steps.odometry
    return replace(
        steps,
        times=steps.times[:n],
        odometry=Odometry(times=o.times[:n], increments=o.increments[:n], covariances=o.covariances[:n]),
        offsets=steps.offsets[: n + 1],
        points=steps.points[:rows],
        origins=steps.origins[:rows],
        returns=steps.returns[:rows],
        tilt=None if steps.tilt is None else steps.tilt[:n],
    )


def drawn_ring(seed: int, dim: int, length: float, gravity: bool = True) -> Steps:
    """A drive whose yaw bias and scale are drawn from what the tracker takes them for."""
    rng = np.random.default_rng(seed)
    steps = ring(
        seed, dim, length=length, step=0.3, beams=150 if dim == 3 else 90, yaw_bias=0.4 * 2e-3 * rng.normal(),
        tilt_sigma=0.002 if gravity else 0.0,
    )  # fmt: skip
    u = steps.odometry.increments.copy()
    u[:, :dim] *= 1.0 + 0.01 * rng.normal()
    return replace(steps, odometry=replace(steps.odometry, increments=u))


def errors(steps: Steps, made: TrackedPath, start: int, end: int) -> tuple[Array, Array]:
    """Error ``(d,)`` of the motion between two steps, and its covariance."""
    assert steps.truth is not None
    g, truth = group_of(made.poses), steps.truth.poses
    a, b = made.poses[start], made.poses[end]
    e = g.log(g.between(g.between(a, b), g.between(truth[start], truth[end])))
    return e, relative_covariance((a, b), (a, b), made.joints[end])


@pytest.mark.parametrize("dim", [2, 3])
def test_what_biases_take_off_a_motion(dim: int) -> None:
    rng = np.random.default_rng(dim)
    g = SE2 if dim == 2 else SE3
    u, dt, h = g.exp(0.4 * rng.normal(size=g.dof)), 0.4, 1e-6
    p = u[:dim]
    away = np.array([p[1], -p[0], 0.0])[:dim], np.array([-p[2], 0.0, p[0]]) if dim == 3 else p
    turned = np.zeros(g.dof)
    turned[g.heading] = -h * dt
    true = [g.compose(u, g.exp(turned))]  # the gyro turns too far, the wheels go too far, and not straight on
    for moved in (-p, *away)[:dim]:
        true.append(np.concatenate([p + h * moved, u[dim:]]))
    wanted = np.column_stack([g.log(g.between(u, T)) / h for T in true])
    assert bias_effects(u, dt) == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize("dim", [2, 3])
def test_how_errors_move_with_the_body(dim: int) -> None:
    """The covariance of the state with a clone, after a motion, is the derivative of the motion times that before."""
    steps, g = drawn_ring(1, dim, 3.0), SE2 if dim == 2 else SE3
    rng = np.random.default_rng(0)

    def tracker() -> ScanToWindowOdometry:
        t = ScanToWindowOdometry(steps, CONFIG)
        t.k, t.pose = 3, g.exp(np.random.default_rng(1).normal(size=g.dof))
        t.biases = 1e-3 * np.random.default_rng(2).normal(size=len(t.biases))
        return t

    t = tracker()
    before = rng.normal(size=(t.x, t.w))
    t.P[: t.x, t.x : t.x + t.w] = before
    t._move()
    F = np.empty((t.x, t.x))
    for i in range(t.x):
        other, h = tracker(), 1e-6
        if i < t.w:
            other.pose = g.compose(other.pose, g.exp(h * np.eye(t.w)[i]))
        else:
            other.biases[i - t.w] += h
        other._move()
        F[:, i] = np.concatenate([g.log(g.between(t.pose, other.pose)), other.biases - t.biases]) / h
    assert t.P[: t.x, t.x : t.x + t.w] == pytest.approx(F @ before, abs=2e-3)
    assert np.abs(F @ before).max() > 1.0


@pytest.mark.parametrize("dim", [2, 3])
def test_what_a_scan_says_of_two_poses(dim: int) -> None:
    """Blocks of information against a plain sum over finite differences of the residuals."""
    steps, g = drawn_ring(2, dim, 8.0), SE2 if dim == 2 else SE3
    t = ScanToWindowOdometry(steps, CONFIG)
    for _ in range(20):
        t.step()
    rng = np.random.default_rng(3)
    q = t.tree_rows[rng.integers(len(t.tree_rows), size=40)]
    source = t.NOW * t.rows + np.arange(40)
    t.points[source] = rng.normal(size=(40, dim))
    t._place(t.NOW, t.pose)
    slot = q // t.rows
    pairs = PlanePairs(source, q, np.full(40, t.NOW), slot)
    information, slots = rng.uniform(1.0, 2.0, size=40), np.unique(slot)
    poses = {t.NOW: t.pose} | {int(s): pose_of(t, int(s)) for s in slots}

    def residuals() -> Array:
        r = np.empty(40)
        plane_residuals(pairs, t.R, t.t, t.points, t.normals, r)
        return r

    columns, r, h = [], residuals(), 1e-6
    for s in (t.NOW, *slots.tolist()):
        for i in range(t.w):
            t._place(s, g.compose(poses[s], g.exp(h * np.eye(t.w)[i])))
            columns.append((residuals() - r) / h)
        t._place(s, poses[s])
    J = np.column_stack(columns)
    wanted = (J[:, : t.w].T * information) @ J
    L, G, b = t._blocks(pairs, information, slots)
    assert len(slots) > 2
    assert pytest.approx(wanted[:, : t.w], abs=1e-3) == L
    assert pytest.approx(wanted[:, t.w :], abs=1e-3) == G
    assert b == pytest.approx((J[:, : t.w].T * information) @ r, abs=1e-3)


def pose_of(t: ScanToWindowOdometry, slot: int) -> Array:
    """Pose at which the scan of a slot was laid."""
    if t.group.dim == 2:
        return np.append(t.t[slot], np.arctan2(t.R[slot, 1, 0], t.R[slot, 0, 0]))
    return np.concatenate([t.t[slot], matrix_to_quat(t.R[slot])])


@pytest.mark.parametrize("dim", [2, 3])
def test_covariance_of_a_motion_between_frames_beside_the_body(dim: int) -> None:
    rng = np.random.default_rng(dim)
    g = SE2 if dim == 2 else SE3
    a, b, toa, tob = (g.exp(0.7 * rng.normal(size=g.dof)) for _ in range(4))
    A = 1e-2 * rng.normal(size=(2 * g.dof, 2 * g.dof))
    joint = A @ A.T
    frames = g.compose(a, toa), g.compose(b, tob)
    x = rng.multivariate_normal(np.zeros(2 * g.dof), joint, size=20_000)
    drawn = [g.compose(g.compose(p, g.exp(e)), to) for p, e, to in ((a, x[:, : g.dof], toa), (b, x[:, g.dof :], tob))]
    e = g.log(g.between(g.between(*frames), g.between(*drawn)))
    C = relative_covariance((a, b), frames, joint)
    L = np.linalg.inv(np.linalg.cholesky(C))
    assert L @ (e.T @ e / len(e)) @ L.T == pytest.approx(np.eye(g.dof), abs=0.06)


@pytest.mark.parametrize("dim", [2, 3])
def test_what_was_reported_of_a_step_stays_reported(dim: int) -> None:
    steps = drawn_ring(4, dim, 14.0)
    whole, part = track_steps(steps, CONFIG, [12]), track_steps(head(steps, 31), CONFIG, [12])
    for a, b in zip((whole.poses, whole.joints, whole.biases), (part.poses, part.joints, part.biases)):
        assert a[:31].tobytes() == b.tobytes()
    assert sum(f.lost == "" for f in part.found) > 10


@pytest.mark.parametrize(("dim", "gravity"), [(2, False), (3, True), (3, False)])
def test_exits_are_as_far_off_as_they_say(dim: int, gravity: bool) -> None:
    """Normalised squared errors of exits of drawn robots lie within the two-sided 99 % of χ²; with half of the
    covariance they would not."""
    values, better = [], []
    for seed in range(24 if dim == 2 else 10):
        steps = drawn_ring(100 + seed, dim, 24.0, gravity)
        starts = [0, 40, len(steps) - 1]
        made = track_steps(steps, CONFIG, starts)
        for start, end in pairwise(starts):
            e, C = errors(steps, made, start, end)
            values.append(float(e @ np.linalg.solve(C, e)))
        assert steps.truth is not None
        g, truth = group_of(made.poses), steps.truth.poses
        reckoned = compose_increments(steps.odometry.increments)[-1]
        wrong = [np.linalg.norm(g.between(p, g.between(truth[0], truth[-1]))[:dim])
                 for p in (g.between(made.poses[0], made.poses[-1]), reckoned)]  # fmt: skip
        better.append(wrong)
    dof = group_of(made.poses).dof * len(values)
    total = sum(values)
    assert chi2_quantile(0.005, dof) < total < chi2_quantile(0.995, dof)
    assert not chi2_quantile(0.005, dof) < 2.0 * total < chi2_quantile(0.995, dof)
    scans, motion = np.mean(better, axis=0)
    assert scans < 0.5 * motion


def corridor(seed: int, length: float = 20.0) -> Steps:
    """A drive along two walls without ends: nothing tells how far the robot went, but its wheels."""
    rng = np.random.default_rng(seed)
    n = int(length / 0.3)
    truth = np.column_stack([0.3 * np.arange(n), np.zeros(n), np.zeros(n)])
    sigma = np.array([0.01, 0.004, 0.001])
    increments = np.vstack([np.zeros(3), se2_between(truth[:-1], truth[1:]) + rng.normal(size=(n - 1, 3)) * sigma])
    increments[1:, :2] *= 1.0 + 0.01 * rng.normal()
    increments[1:, 2] += 0.4 * 2e-3 * rng.normal()
    angles = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    with np.errstate(divide="ignore"):
        distance = 1.5 / np.abs(np.sin(angles))
    met = distance < 8.0
    measured = np.where(met, distance, 8.0) + np.where(met, 0.02, 0.0) * rng.normal(size=(n, 90))
    beams = np.column_stack([np.cos(angles), np.sin(angles)])
    times = 0.4 * np.arange(n)
    return Steps(
        times=times,
        odometry=Odometry(times=times, increments=increments, covariances=np.tile(np.diag(sigma**2), (n, 1, 1))),
        offsets=90 * np.arange(n + 1, dtype=np.int64),
        points=(measured[..., None] * beams).reshape(-1, 2),
        origins=np.zeros((90 * n, 2)),
        returns=np.tile(met, n),
        max_range=8.0,
        range_sigma=0.02,
        truth=Trajectory(times, truth),
    )


def test_a_corridor_stays_wide() -> None:
    values = []
    for seed in range(16):
        steps = corridor(seed)
        made = track_steps(steps, CONFIG)
        e, C = errors(steps, made, 0, len(steps) - 1)
        values.append(float(e @ np.linalg.solve(C, e)))
        own = float(steps.odometry.covariances[1:, 0, 0].sum()) + (0.01 * 19.8) ** 2  # noise and scale of the wheels
        assert 0.85 * own < C[0, 0] < 1.5 * own
        assert C[1, 1] < 0.15 * C[0, 0]
        assert sum(f.lost == "" for f in made.found) > 40
    assert chi2_quantile(0.005, 48) < sum(values) < chi2_quantile(0.995, 48)


def test_what_is_lost_is_reported_and_widens() -> None:
    steps = drawn_ring(7, 2, 20.0)
    n = len(steps)
    blind, far = steps.returns.copy(), steps.points.copy()
    rows = slice(int(steps.offsets[40]), int(steps.offsets[55]))
    blind[rows] = False
    far[rows] *= np.random.default_rng(0).uniform(0.2, 1.0, size=(rows.stop - rows.start, 1))  # dust
    known = track_steps(steps, CONFIG)
    cases = (
        (replace(steps, returns=blind), {"points"}),
        (replace(steps, points=far), {"overlap", "spread", "surprise"}),
    )
    for other, why in cases:
        made = track_steps(other, CONFIG)
        assert {f.lost for f in made.found[40:55]} <= {*why, ""}
        assert sum(f.lost in why for f in made.found[40:55]) >= 12
        assert sum(f.lost in why for f in made.found[:40]) == 0
        followed, lost = (errors(steps, m, 0, 54)[1] for m in (known, made))
        assert np.all(np.diag(lost) > 1.5 * np.diag(followed))
        e, C = errors(steps, made, 0, n - 1)
        assert e @ np.linalg.solve(C, e) < chi2_quantile(0.9999, 3)


def test_a_place_that_nobody_saw_before_is_no_place(caplog: pytest.LogCaptureFixture) -> None:
    """Kidnapped: the scans contradict the motion, or meet nothing, and the path goes on with the motion."""
    steps = drawn_ring(8, 2, 20.0)
    k = 40
    points = steps.points.copy()
    points[int(steps.offsets[k]) :] += np.array([0.6, -0.45])  # the mast was hit
    made = track_steps(replace(steps, points=points), CONFIG)
    assert made.found[k].lost in {"overlap", "spread", "surprise"}
    e, C = errors(steps, made, 0, k)
    assert e @ np.linalg.solve(C, e) < chi2_quantile(0.9999, 3)


def test_numbers_that_cannot_be_are_refused() -> None:
    for bad in (
        {"seconds": 0.0},
        {"points": 3},
        {"lay": 30.0},
        {"lay": 0.1},
    ):
        with pytest.raises(ConfigError, match="window"):
            ScanWindowConfig(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("dim", [2, 3])
def test_where_the_map_lies_is_no_matter_of_the_path(dim: int) -> None:
    """A map that may lie tens of metres off, and be turned by a radian: scans see nothing of it, nor does it cost."""
    steps, made = drawn_ring(5, dim, 16.0), []
    for far in (0.0, 1.0):
        t = ScanToWindowOdometry(steps, CONFIG)
        g, unsure = t.group, np.zeros(t.w)
        unsure[g.position], unsure[g.heading] = 30.0 * far, 1.0 * far
        A = g.adjoint(g.inverse(t.pose))
        t.P[: t.w, : t.w] += A @ np.diag(unsure**2) @ A.T
        t.begin()
        poses = []
        for _ in range(len(steps)):
            t.step()
            poses.append(t.pose)
        a, b = poses[0], poses[-1]
        made.append((np.array(poses), relative_covariance((a, b), (a, b), t.joint)))
    (near, P), (far_off, Q) = made
    off = group_of(near).log(group_of(near).between(near, far_off))
    assert np.abs(off).max() < 1e-3
    np.testing.assert_allclose(np.sqrt(np.diag(Q)), np.sqrt(np.diag(P)), rtol=0.05)
