"""Gaussians of poses and points in space: Jacobians by finite differences, and the minimum of a plain solver."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp

from graphslam.core import se3
from graphslam.linear.space_maps import (
    ORIGIN,
    PlacedMap,
    SpaceMap,
    minimise_space_maps,
    normal_equations,
    space_objective,
    step_values,
)


def poses(rng: np.random.Generator, n: int, turn: float = 1.0) -> np.ndarray:
    return np.hstack([3.0 * rng.normal(size=(n, 3)), se3.so3_exp(turn * rng.normal(size=(n, 3)))])


def information(rng: np.random.Generator, n: int) -> sp.csr_matrix:
    L = rng.normal(size=(n, n))
    return sp.csr_matrix(L @ L.T + n * np.eye(n))


@pytest.mark.parametrize("chart", ["group", "cartesian"])
@pytest.mark.parametrize("base", [ORIGIN, 0])
def test_jacobians_are_those_of_finite_differences(chart: str, base: int) -> None:
    rng = np.random.default_rng(0)
    P, L = poses(rng, 4), 3.0 * rng.normal(size=(6, 3))
    anchors = np.array([0, 1, ORIGIN, 1, 0])
    m = SpaceMap(poses(rng, 2, 0.4), rng.normal(size=(5, 3)), anchors, information(rng, 27), chart)
    one = PlacedMap(m, base, np.array([1, 3]), np.array([0, 2, 3, 5, 2]))
    u, J = one.linearise(P, L)
    np.testing.assert_array_equal(u, one.residual(P, L))
    h, numeric = 1e-6, np.zeros(J.shape)
    for k, step in enumerate(h * np.eye(J.shape[1])):
        numeric[:, k] = (one.residual(*step_values(P, L, step)) - one.residual(*step_values(P, L, -step))) / (2 * h)
    np.testing.assert_allclose(J.toarray(), numeric, atol=1e-8)


def test_a_map_at_its_mean_has_no_residual_and_its_own_information() -> None:
    rng = np.random.default_rng(1)
    m = SpaceMap(poses(rng, 2), rng.normal(size=(3, 3)), np.array([0, 1, ORIGIN]), information(rng, 21))
    one = PlacedMap(m, ORIGIN, np.arange(2), np.arange(3))
    f, g, H = normal_equations([one], m.poses, m.points)
    assert f == pytest.approx(0.0, abs=1e-20)
    np.testing.assert_allclose(g, 0.0, atol=1e-9)
    np.testing.assert_allclose(H.toarray(), m.information.toarray(), atol=1e-9)


def test_the_minimum_is_that_of_a_plain_solver() -> None:
    rng = np.random.default_rng(2)
    a = SpaceMap(poses(rng, 1, 0.5), rng.normal(size=(4, 3)), np.zeros(4, np.int64), information(rng, 18))
    b = SpaceMap(poses(rng, 1, 0.5), rng.normal(size=(3, 3)), np.zeros(3, np.int64), information(rng, 15))
    maps = [
        PlacedMap(a, ORIGIN, np.array([0]), np.array([0, 1, 2, 3])),
        PlacedMap(b, 0, np.array([1]), np.array([2, 3, 4])),
    ]
    start = np.vstack([a.poses, se3.se3_compose(a.poses[0], b.poses)])
    points = np.vstack([a.points, se3.se3_transform(a.poses[0], b.points[2:])])
    found = minimise_space_maps(maps, start, points)
    halves = [np.linalg.cholesky(m.map.information.toarray()).T for m in maps]

    def whitened(step: np.ndarray) -> np.ndarray:
        values = step_values(start, points, step)
        return np.concatenate([W @ m.residual(*values) for W, m in zip(halves, maps, strict=True)])

    plain = scipy.optimize.least_squares(whitened, np.zeros(27), xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert found.converged
    assert found.objective == pytest.approx(2.0 * plain.cost, rel=1e-8)
    assert space_objective(maps, found.poses, found.points) == pytest.approx(found.objective, rel=1e-12)
