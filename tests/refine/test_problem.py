"""The parts of a refinement against plain twins: Jacobians, blocks, noise of pairs, the linear solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from graphslam.core.poses import SE2, SE3, group_of
from graphslam.core.records import Odometry
from graphslam.refine.motion import MotionModel
from graphslam.refine.problem import (
    NOISE_INDUCED,
    RefinementProblem,
    chunk_information,
    correlation_factor,
    pair_noise,
    point_information,
    surface_residuals,
)
from graphslam.refine.scans import Scans
from graphslam.refine.surfaces import ScanReturns, SurfacePairs, Surfaces
from graphslam.registration.plane_kernels import PlanePairs
from graphslam_frontends.odometry.motion_prior import LEAST

EPS = 1e-6


def some_scans(rng, dim, n=7, beams=9):
    """Steps that wind, each with beams of several ages."""
    g = SE2 if dim == 2 else SE3
    xi = 0.1 * rng.standard_normal((n, g.dof))
    xi[:, np.arange(g.dof)[g.position][0]] += 0.4
    u = g.exp(xi)
    u[0] = g.identity
    A = 0.02 * rng.standard_normal((n, g.dof, g.dof))
    times = np.cumsum(rng.uniform(0.3, 0.6, n))
    return Scans(
        times=times,
        odometry=Odometry(times=times, increments=u, covariances=A @ np.swapaxes(A, 1, 2) + 1e-2 * np.eye(g.dof)),
        offsets=np.arange(n + 1, dtype=np.int64) * beams,
        points=(3.0 * rng.standard_normal((n * beams, dim))).astype(np.float32),
        origins=np.zeros((n * beams, dim), np.float32),
        returns=np.ones(n * beams, bool),
        ages=rng.uniform(0, 0.3, n * beams).astype(np.float32),
        max_range=30.0,
        biases=LEAST,
        tilt=0.05 * rng.standard_normal((n, 2)) if dim == 3 else None,
        tilt_sigma=4e-3,
        tilt_time=5.0,
    )


def path_of(scans, rng):
    g = scans.group
    poses = [g.exp(0.2 * rng.standard_normal(g.dof))]
    for u in scans.odometry.increments[1:]:
        poses.append(g.compose(g.compose(poses[-1], u), g.exp(0.03 * rng.standard_normal(g.dof))))
    return np.array(poses)


def some_problem(rng, dim, pairs=40):
    scans = some_scans(rng, dim)
    cloud = ScanReturns.of(scans, chunk_length=1.0, chunk_time=10.0)
    motion = MotionModel(scans, knot=1.0, bridge=cloud.bridge())
    normals = rng.standard_normal((len(cloud.points), dim))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tilts = rng.uniform(0.0, 0.3, (len(normals), dim - 1, dim)).astype(np.float32)
    surfaces = Surfaces(normals, np.ones(len(normals), bool), np.arange(len(normals)), tilts)
    p, q = rng.integers(0, len(normals), (2, pairs))
    other = cloud.step[p] != cloud.step[q]
    p, q = p[other], q[other]
    poses = path_of(scans, rng)
    problem = RefinementProblem(motion, cloud, poses[0].copy())
    states = (0.01 * rng.standard_normal(len(motion.knots)), 0.01 * rng.standard_normal(motion.constants))
    return problem, surfaces, PlanePairs(p, q, cloud.step[p], cloud.step[q]), poses, states


def moved(problem, poses, states, column, by):
    n, w, K = len(poses), problem.motion.group.dof, len(problem.motion.knots)
    step = np.zeros(n * w + K + problem.motion.constants)
    step[column] = by
    return problem.moved(poses, states, step)


def differences(problem, poses, states, function):
    """Derivative of a function of path and states by the step, one column at a time."""
    width = problem.motion.widths.sum()
    columns = []
    for c in range(width):
        up, down = (function(*moved(problem, poses, states, c, s * EPS)) for s in (1, -1))
        columns.append((up - down) / (2 * EPS))
    return np.stack(columns, axis=-1)


def dense_terms(terms, widths):
    """Residuals and the whole Jacobian of one kind of factor."""
    begin = np.cumsum(widths) - widths
    first = np.cumsum((0, *terms.widths))
    f, m = terms.r.shape
    J = np.zeros((f, m, widths.sum()))
    for u, w in enumerate(terms.widths):
        for k in range(f):
            J[k, :, begin[terms.nodes[k, u]] : begin[terms.nodes[k, u]] + w] += terms.J[k, :, first[u] : first[u + 1]]
    return terms.r, J


@pytest.mark.parametrize("dim", [2, 3])
def test_jacobians_of_motion_gravity_and_gauge(rng, dim):
    problem, _, _, poses, states = some_problem(rng, dim)
    motion = problem.motion
    held = motion.group.compose(poses[0], motion.group.exp(np.full(motion.group.dof, 1e-7)))
    makers = [lambda p, s, k=k: motion.terms(p, s)[k] for k in range(len(motion.terms(poses, states)))]
    makers.append(lambda p, s: motion.gauge(p, held))
    names = set()
    for make in makers:
        terms = make(poses, states)
        names.add(terms.name)
        _, J = dense_terms(terms, motion.widths)
        plain = differences(problem, poses, states, lambda p, s, make=make: make(p, s).r)
        np.testing.assert_allclose(J, plain, atol=2e-5 * max(1.0, np.abs(plain).max()), err_msg=terms.name)
    wanted = {"odometry", "yaw bias", "yaw bias walk", "constants", "gauge"}
    assert names == (wanted | {"gravity"} if dim == 3 else wanted)


@pytest.mark.parametrize("dim", [2, 3])
def test_one_step_is_that_of_the_dense_problem_and_so_is_the_covariance(rng, dim):
    problem, surfaces, pairs, poses, states = some_problem(rng, dim)
    motion = problem.motion
    w = rng.uniform(10.0, 1000.0, len(pairs.source))
    w[3] = 0.0
    solved, step = problem.linearise(poses, states, pairs, surfaces, w, [])
    size = motion.widths.sum()
    H, g, cost = np.zeros((size, size)), np.zeros(size), 0.0
    r = surface_residuals(pairs, problem.cloud, surfaces, poses)
    J = differences(problem, poses, states, lambda p, s: surface_residuals(pairs, problem.cloud, surfaces, p))
    H += J.T @ (w[:, None] * J)
    g += J.T @ (w * r)
    assert solved.parts["scans"] == pytest.approx(float(w @ r**2), rel=1e-9)
    for terms in [*motion.terms(poses, states), motion.gauge(poses, problem.held)]:
        e, K = dense_terms(terms, motion.widths)
        H += np.einsum("fmi,fmj->ij", K, K)
        g += np.einsum("fmi,fm->i", K, e)
        cost += float(np.sum(e**2))
    assert sum(solved.parts.values()) - solved.parts["scans"] == pytest.approx(cost, rel=1e-9)
    wanted = -np.linalg.solve(H, g)
    np.testing.assert_allclose(step, wanted, atol=1e-6 * np.abs(wanted).max())
    C, d = np.linalg.inv(H), motion.group.dof
    blocks = solved.factor.inverse_diagonal_blocks(np.arange(len(poses), dtype=np.int64) * d, d)
    for k, block in enumerate(blocks):
        plain = C[k * d : (k + 1) * d, k * d : (k + 1) * d]
        np.testing.assert_allclose(block, plain, atol=1e-5 * np.abs(C).max())


def of_group(g, poses, centre, J):
    """Derivatives by the pose of each row as those by a motion about a centre in the axes of the world."""
    about = np.array(g.identity)
    about[: g.dim] = centre
    A = g.adjoint(g.between(np.broadcast_to(about, poses.shape), poses))
    return np.linalg.solve(np.swapaxes(A, 1, 2), J[..., None])[..., 0], A


@pytest.mark.parametrize("dim", [2, 3])
def test_what_noise_of_normals_feigns_is_not_held(rng, dim):
    """Shares, and the step with them, against derivatives that are taken pair by pair to the frame of their group."""
    problem, surfaces, pairs, poses, states = some_problem(rng, dim, pairs=90)
    g, cloud, d = group_of(poses), problem.cloud, group_of(poses).dof
    k = len(pairs.source)
    found = SurfacePairs(pairs, rng.integers(0, 2, k), np.zeros((k, 3)), np.zeros((k, 3)))
    w = rng.uniform(10.0, 1000.0, k)
    holds = chunk_information(found, cloud, surfaces, poses, w)

    def derivatives(s):
        J = differences(problem, poses, states, lambda p, _: surface_residuals(pairs, cloud, s, p))[:, : len(poses) * d]
        J = J.reshape(k, len(poses), d)
        return J[np.arange(k), pairs.i], J[np.arange(k), pairs.j]

    Ji, Jj = derivatives(surfaces)
    tilted = [derivatives(replace(surfaces, normals=surfaces.tilts[:, a].astype(float)))[0] for a in range(dim - 1)]
    r = surface_residuals(pairs, cloud, surfaces, poses)
    gradient = np.zeros((len(poses), d))
    for m in (0, 1):
        some = np.flatnonzero(found.whose == m)
        at = g.transform(poses[pairs.j[some]], cloud.points[pairs.target[some]])
        centre = at.mean(axis=0)
        np.testing.assert_allclose(holds.centre[m], centre, atol=1e-9)
        v, A = of_group(g, poses[pairs.i[some]], centre, Ji[some])
        u, B = of_group(g, poses[pairs.j[some]], centre, Jj[some])
        np.testing.assert_allclose(u, -v, atol=1e-6)
        information = (v.T * w[some]) @ v
        noise_induced = sum(
            (x.T * w[some]) @ x for x in (of_group(g, poses[pairs.i[some]], centre, t[some])[0] for t in tilted)
        )
        values, V = eigh(information, noise_induced)
        share = noise_induced @ V @ np.diag(np.maximum(1.0 - NOISE_INDUCED / values, 0.0)) @ V.T
        assert 0 < np.sum(values > NOISE_INDUCED) < d or dim == 2
        np.testing.assert_allclose(
            share @ information @ share.T, holds.share[m] @ information @ holds.share[m].T, rtol=1e-4, atol=1e-3
        )
        kept = v @ holds.share[m].T
        Ji[some] = np.einsum("kij,ki->kj", A, kept)
        Jj[some] = -np.einsum("kij,ki->kj", B, kept)
        seen = g.transform(
            g.inverse(poses[pairs.j[some]]), g.transform(poses[pairs.i[some]], cloud.points[pairs.source[some]])
        )
        pull = v * r[some, None]
        for a, t in enumerate(tilted):
            aside = np.sum(surfaces.tilts[pairs.target[some], a] * (seen - cloud.points[pairs.target[some]]), axis=1)
            pull -= of_group(g, poses[pairs.i[some]], centre, t[some])[0] * aside[:, None]
        pull = w[some, None] * pull @ holds.share[m].T
        np.add.at(gradient, pairs.i[some], np.einsum("kij,ki->kj", A, pull))
        np.add.at(gradient, pairs.j[some], -np.einsum("kij,ki->kj", B, pull))
    rows = np.zeros((k, len(poses), d))
    rows[np.arange(k), pairs.i], rows[np.arange(k), pairs.j] = Ji, Jj
    rows = rows.reshape(k, -1)
    H = rows.T @ (w[:, None] * rows)
    none, step0 = problem.linearise(poses, states, pairs, surfaces, np.zeros(k), [])
    some, step1 = problem.linearise(poses, states, pairs, surfaces, w, [], holds)
    C0, C1 = (np.linalg.inv(x.factor.inverse_block(np.arange(len(step0)))) for x in (none, some))
    n = len(poses) * d
    np.testing.assert_allclose((C1 - C0)[:n, :n], H, atol=1e-4 * np.abs(H).max())
    wanted = gradient.ravel()
    np.testing.assert_allclose((C0 @ step0 - C1 @ step1)[:n], wanted, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_distances_of_points_from_planes(rng, dim):
    problem, surfaces, pairs, poses, _ = some_problem(rng, dim)
    g, cloud = group_of(poses), problem.cloud
    for k, r in enumerate(surface_residuals(pairs, problem.cloud, surfaces, poses)):
        p, q = pairs.source[k], pairs.target[k]
        seen = g.transform(g.inverse(poses[pairs.j[k]]), g.transform(poses[pairs.i[k]], cloud.points[p]))
        assert r == pytest.approx(float(surfaces.normals[q] @ (seen - cloud.points[q])), abs=1e-9)


def drawn_pairs(rng, points, count):
    """Pairs among some points, with incidences drawn."""
    p, q = rng.integers(0, points, (2, count))
    c = rng.uniform(0.05, 1.0, points)
    mp, mq = np.bincount(p, minlength=points)[p], np.bincount(q, minlength=points)[q]
    none = np.zeros(count)
    once = np.column_stack([c[p] ** 2 + c[q] ** 2, np.ones(count), none])
    spent = np.column_stack([mp * c[p] ** 2 + mq * c[q] ** 2, 0.5 * (mp + mq), none])
    steps = np.zeros(count, np.int64)
    return SurfacePairs(PlanePairs(p, q, steps, steps), steps, once, spent), c


def test_pairs_promise_no_more_than_their_shared_points_allow(rng):
    found, c = drawn_pairs(rng, 60, 150)
    separate = rng.permutation(60) < 30  # points are either sources or targets
    keep = separate[found.pairs.source] & ~separate[found.pairs.target]
    p, q = found.pairs.source[keep], found.pairs.target[keep]
    mp, mq = np.bincount(p, minlength=60)[p], np.bincount(q, minlength=60)[q]
    rho, f = 0.025, 0.01
    B = np.zeros((len(p), 60))
    B[np.arange(len(p)), p] = np.sqrt((rho * c[p]) ** 2 + 0.5 * f**2)
    B[np.arange(len(p)), q] = -np.sqrt((rho * c[q]) ** 2 + 0.5 * f**2)
    promised = rho**2 * (mp * c[p] ** 2 + mq * c[q] ** 2) + f**2 * 0.5 * (mp + mq)
    least = np.linalg.eigvalsh(np.diag(promised) - B @ B.T)[0]
    assert least > -1e-9
    # without the multiplicities they would promise more
    once = rho**2 * (c[p] ** 2 + c[q] ** 2) + f**2
    assert np.linalg.eigvalsh(np.diag(once) - B @ B.T)[0] < -1e-4


@pytest.mark.parametrize(("rho", "f"), [(0.025, 0.0), (0.01, 0.01), (0.0, 0.02), (0.05, 0.005)])
def test_noise_of_ranges_and_surfaces_is_found_from_residuals(rng, rho, f):
    found, _ = drawn_pairs(rng, 4000, 30000)
    motion = rng.uniform(0, 1e-4, 30000) * (rng.random(30000) < 0.5)
    found = replace(found, once=np.column_stack([found.once[:, :2], motion]))
    sigma = np.sqrt(found.once @ np.array([rho**2, f**2, 1.0]))
    r = sigma * rng.standard_normal(30000)
    wild = rng.random(30000) < 0.03
    r[wild] = rng.uniform(-0.3, 0.3, wild.sum())
    a, b = np.sqrt(pair_noise(found, r)[:2])
    assert a == pytest.approx(rho, abs=0.1 * rho + 0.003)
    assert b == pytest.approx(f, abs=0.15 * f + 0.004)


@pytest.mark.parametrize("shared", [0.0, 0.01])
def test_errors_that_points_of_a_scan_share_are_seen_in_sums_of_residuals(rng, shared):
    """30 steps of 200 points on 500 surfaces that several use; in each step blocks of 80 err alike."""
    steps, n, q = 30, 200, 500
    step = np.repeat(np.arange(steps + 1), [n] * steps + [q])
    points = np.zeros((len(step), 2))
    cloud = ScanReturns(
        points, points, step, np.zeros(len(step)), np.zeros(steps + 1, np.int64), np.array([0, len(step)])
    )
    p, target = np.arange(steps * n), steps * n + rng.integers(0, q, steps * n)
    sigma = 0.02
    r = sigma * (rng.standard_normal(steps * n) + rng.standard_normal(steps * n + q)[target]) / np.sqrt(2.0)
    blocks = step[p] * 3 + (p % n) // 80
    r += shared * rng.standard_normal(3 * steps)[blocks]
    once = np.tile([0.0, 1.0, 0.0], (len(p), 1))
    found = SurfacePairs(PlanePairs(p, target, step[p], step[target]), np.zeros(len(p), np.int64), once, once)
    variance = sigma**2 + shared**2
    size = np.bincount(blocks)
    wanted = 1.0 + np.sum(shared**2 * size * (size - 1.0)) / np.sum(variance * size) if shared else 1.0
    assert correlation_factor(found, cloud, r, np.array([0.0, variance, 1.0])) == pytest.approx(
        wanted, rel=0.35 if shared else 0.25
    )


def test_wild_pairs_have_no_information(rng):
    found, _ = drawn_pairs(rng, 4000, 1000)
    noise = np.array([0.02**2, 0.0, 1.0])
    near, far = point_information(found, np.zeros(1000), noise), point_information(found, np.full(1000, 0.5), noise)
    np.testing.assert_allclose(near, 1.0 / (found.spent @ noise))
    assert np.all(far < 3e-4 * near)


@pytest.mark.parametrize("dim", [2, 3])
def test_beams_are_placed_where_the_motion_within_their_step_was(rng, dim):
    scans = some_scans(rng, dim)
    cloud = ScanReturns.of(scans, chunk_length=1.0, chunk_time=10.0)
    g, poses = scans.group, path_of(scans, rng)
    motion = MotionModel(scans, knot=1.0)
    wrong = motion.corrections(poses)
    np.testing.assert_allclose(
        g.compose(scans.odometry.increments[1:], g.exp(wrong[1:])), g.between(poses[:-1], poses[1:]), atol=1e-9
    )
    small = 1e-3 * wrong
    mended = cloud.corrected(small)
    for k in range(0, len(cloud.points), 5):
        T = g.exp(-cloud.age[k] * small[cloud.step[k]])
        np.testing.assert_allclose(mended.points[k], g.transform(T, cloud.points[k]), atol=1e-5)
    half = replace(cloud, age=np.full(len(cloud.age), 0.5))
    np.testing.assert_allclose(half.bridge(), 0.25)
    assert np.all(replace(cloud, age=np.zeros(len(cloud.age))).bridge() == 0)
