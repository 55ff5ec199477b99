"""What a match does not determine: corridors, planes, and covariances made of that."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.registration.degeneracy import (
    calibrated_covariance,
    noise_induced_information,
    translational_degeneracy,
)
from graphslam.registration.register import Registration, register
from graphslam.registration.target import Target, flat_shapes
from tests.reference.box_world import around, corridor, heading, survey

OPTIONS = {"scale": 1.0, "sigma": (0.01, 0.001), "unknown": (3.0, 0.5), "threshold": 0.004}


def corridor_matches(sigma: float, voxel: float) -> list[tuple[Registration, Array]]:
    """Matches 0.5 m off along a corridor whose ends are out of sight, and the true poses; five in space, five flat."""
    world, found = corridor(), []
    for k in range(5):
        rng = np.random.default_rng(k)
        poses = [heading(x, rng.uniform(-0.5, 0.5), 1.2, rng.uniform(-0.3, 0.3)) for x in np.arange(-20.0, 20.0, 3.0)]
        target = Target(survey(world, np.array(poses), 2000, sigma, 25.0, rng, low=-1.0, high=1.0), voxel=voxel)
        T = heading(rng.uniform(-5, 5), rng.uniform(-0.5, 0.5), 1.2, rng.uniform(-0.3, 0.3))
        source = Target(world.scan(T, around(rng, 1500, -1.0, 1.0), sigma, 25.0, rng), voxel=voxel)
        start = T + [0.5, 0.1, 0.05, 0, 0, 0, 0]
        found.append((register(source, target, start), T))
        flat = [np.column_stack([np.cos(a), np.sin(a), 0 * a]) for a in rng.uniform(-np.pi, np.pi, (41, 361))]
        scans = [
            se3.se3_transform(p, world.scan(p, rays, sigma, 25.0, rng))[:, :2]
            for p, rays in zip((heading(x, 0.2, 1.0, 0.1) for x in np.arange(-20.0, 20.0)), flat)
        ]
        pose = np.array([rng.uniform(-5, 5), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)])
        here = world.scan(heading(pose[0], pose[1], 1.0, pose[2]), flat[-1], sigma, 25.0, rng)[:, :2]
        found.append((register(here, Target(np.concatenate(scans), voxel=voxel), pose + [0.5, 0.1, 0.03]), pose))
    return found


@pytest.mark.parametrize(("sigma", "voxel"), [(0.01, 0.2), (0.025, 0.2), (0.025, 0.3), (0.05, 0.3)])
def test_straight_corridor_is_flagged_along_itself_and_nowhere_else(sigma: float, voxel: float) -> None:
    """Fitness and rmse are perfect, half a metre off; the eigenvalue tells, and the covariance says what is not known.

    The greatest ratio of these is half of what the gate asks, so that it is not met by chance.
    """
    for r, T in corridor_matches(sigma, voxel):
        assert r.converged
        assert r.fitness > 0.85
        assert r.degeneracy < (0.002 if len(T) == 7 else 0.005)
        assert "degenerate" in r.why
        if len(T) == 7:
            axis, error = se3.quat_rotate(T[3:], r.weakest), se3.se3_log(se3.se3_between(r.T_target_source, T))
            across, turn = error[4:], error[:3]
        else:
            axis = se2.rotation2(T[2]) @ r.weakest
            error = se2.se2_log(se2.se2_between(r.T_target_source, T))
            across, turn = error[1:2], error[2:]
        assert abs(axis[0]) > 0.999  # the corridor lies along x
        assert r.weakest_sigma == pytest.approx(3.0, rel=0.01)  # as unknown as max_shift lets it be
        assert error @ np.linalg.solve(r.covariance, error) / len(error) < 2.5
        # what the walls hold is held
        sigmas = np.sqrt(np.linalg.eigvalsh(r.covariance))
        assert sigmas[-1] == pytest.approx(3.0, rel=0.05)
        assert sigmas[-2] < 0.05
        assert np.all(np.abs(turn) < 0.02)
        assert np.all(np.abs(across) < 0.5)


@pytest.mark.parametrize("dim", [2, 3])
def test_ratio_and_direction_of_planes(dim: int) -> None:
    """Points whose normals are stated: n along the first axis, three along the second, nine along the third."""
    d = 3 if dim == 2 else 6
    move = slice(0, 2) if dim == 2 else slice(3, 6)
    H = np.zeros((d, d))
    R = se2.rotation2(0.4) if dim == 2 else se3.quat_to_matrix(se3.so3_exp(np.array([0.2, -0.4, 0.7])))
    values = np.array([1.0, 3.0, 9.0])[:dim]
    H[move, move] = R @ np.diag(values) @ R.T
    found = translational_degeneracy(H, dim)
    assert found.ratio == pytest.approx(values[0] / values[-1])
    np.testing.assert_allclose(found.eigenvalues, values)
    assert abs(found.weakest @ R[:, 0]) == pytest.approx(1.0)
    assert translational_degeneracy(np.zeros((d, d)), dim).ratio == 0.0
    H[move, move] = R @ np.diag([-1.0, 2.0, 3.0][:dim]) @ R.T  # more was noise_induced than there was
    assert translational_degeneracy(H, dim).ratio == 0.0


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_spurious_is_the_sum_over_the_pairs(dim: int, rng: np.random.Generator) -> None:
    n, d = 20, 3 if dim == 2 else 6
    p = rng.uniform(-5, 5, (n, dim))
    if dim == 2:
        R = se2.rotation2(0.7)
    else:
        R = se3.quat_to_matrix(se3.so3_exp(np.array([0.1, 0.3, -0.5])))
    own, other = rng.standard_normal((2, n, dim))
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    A = rng.standard_normal((2, n, dim, dim)) * 0.1
    noise = A @ np.swapaxes(A, -1, -2)
    expected = np.zeros((d, d))
    for k in range(n):
        if dim == 2:
            J = R @ np.array([[1, 0, -p[k, 1]], [0, 1, p[k, 0]]])
        else:
            J = R @ np.hstack([-se3.skew(p[k]), np.eye(3)])
        C = flat_shapes(other[k : k + 1])[0] + R @ flat_shapes(own[k : k + 1])[0] @ R.T
        w = np.trace(np.linalg.inv(C)) - 0.5 * (dim - 1)
        S = 0.5 * np.eye(dim) + w * 0.25 * (noise[1][k] + R @ noise[0][k] @ R.T)
        expected += J.T @ S @ J
    found = noise_induced_information(p, R, (own, other), (noise[0], noise[1]))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_noise_of_a_normal_is_that_of_a_monte_carlo(dim: int) -> None:
    """Normals of a noisy plane, scanned a thousand times: their spread is the covariance stated, on both sides."""
    rng = np.random.default_rng(dim)
    grid = np.linspace(-0.5, 0.5, 5)
    base = np.column_stack([grid, 0 * grid]) if dim == 2 else np.array([[x, y, 0.0] for x in grid for y in grid])
    n, spread, stated = len(base), [], []
    for _ in range(1000):
        points = base + 0.05 * rng.standard_normal(n)[:, None] * np.eye(dim)[-1]
        normal, noise = Target(points, neighbours=n).normals(np.array([0]))
        spread.append(normal[0] / normal[0, -1])
        stated.append(noise[0])
    measured = np.var(np.array(spread)[:, : dim - 1], axis=0)
    mean = np.mean(stated, axis=0)
    ratio = np.diag(mean)[: dim - 1] / measured
    assert np.all((ratio > 0.4) & (ratio < 1.2)), ratio  # 5 points of a line lose two of their degrees of freedom
    assert np.mean(stated, axis=0)[-1, -1] < 0.1 * np.diag(mean)[0]


def test_too_few_points_around_have_no_normal(rng: np.random.Generator) -> None:
    normals, noise = Target(rng.uniform(0, 1, (4, 3))).normals(np.arange(4))
    assert not normals.any()
    assert not noise.any()
    assert np.array_equal(flat_shapes(normals), np.tile(np.eye(3), (4, 1, 1)))
    same = Target(np.tile([1.0, 2.0, 3.0], (30, 1)))  # thirty times the same point
    assert np.all(np.isfinite(same.normals(np.arange(30))[1]))


@pytest.mark.parametrize("dim", [2, 3])
def test_covariance_is_the_inverse_where_all_is_held_and_unknown_where_nothing_is(dim: int) -> None:
    d, move = (3, slice(0, 2)) if dim == 2 else (6, slice(3, 6))
    A = np.random.default_rng(dim).standard_normal((d, 40))
    information = 1e4 * A @ A.T
    floor = np.full(d, 0.001**2)
    floor[move] = 0.01**2
    held = calibrated_covariance(information, dim=dim, **OPTIONS)
    np.testing.assert_allclose(held, np.linalg.inv(information) + np.diag(floor), rtol=1e-3, atol=1e-9)
    double = calibrated_covariance(information, dim=dim, **{**OPTIONS, "scale": 2.0})
    np.testing.assert_allclose(double - np.diag(floor), 2 * (held - np.diag(floor)), rtol=1e-2, atol=1e-9)
    nothing = calibrated_covariance(np.zeros((d, d)), dim=dim, **OPTIONS)
    np.testing.assert_allclose(np.sqrt(np.diag(nothing)[move]), 3.0, rtol=1e-3)
    lost = calibrated_covariance(-information, dim=dim, **OPTIONS)
    assert np.all(np.linalg.eigvalsh(lost) > 0)
    # one direction held by a thousandth of the others: as good as not at all
    axis = np.zeros(d)
    axis[move] = np.eye(dim)[0]
    weak = 1e4 * (np.eye(d) - 0.999 * np.outer(axis, axis))
    P = calibrated_covariance(weak, dim=dim, **OPTIONS)
    assert axis @ P @ axis == pytest.approx(9.0)
    assert np.sqrt(np.delete(np.diag(P), np.flatnonzero(axis))).max() < 0.02
    P = calibrated_covariance(weak, dim=dim, **{**OPTIONS, "threshold": 1e-4})
    assert axis @ P @ axis == pytest.approx(0.1, rel=0.05)
