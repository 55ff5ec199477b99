"""The group chart against its definition, its derivative against differences, and what it is good for."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.charts import apply_inverse_left_jacobian, check_chart, inverse_left_jacobian_terms, map_difference
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import rotation2

QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


def mean_rotation(d: float) -> np.ndarray:
    """``V(d) = ∫₀¹ R(s d) ds`` by the midpoint rule."""
    s = (np.arange(20_000) + 0.5) / 20_000
    return rotation2(s * d).mean(axis=0)


@pytest.mark.parametrize("d", [-3.1, -1.0, -2e-3, -1e-3, -1e-9, 0.0, 1e-6, 1.9e-3, 2.1e-3, 0.3, 2.0, np.pi])
def test_the_arc_is_the_inverse_of_the_mean_rotation(d: float) -> None:
    a, b, slope = (float(v) for v in inverse_left_jacobian_terms(d))
    np.testing.assert_allclose(a * np.eye(2) - b * QUARTER, np.linalg.inv(mean_rotation(d)), atol=1e-8)
    e = np.array([2.0, -0.7])
    np.testing.assert_allclose(apply_inverse_left_jacobian(e, d), (a * np.eye(2) - b * QUARTER) @ e, atol=1e-14)
    h = 1e-6
    assert slope == pytest.approx(
        (float(inverse_left_jacobian_terms(d + h)[0]) - float(inverse_left_jacobian_terms(d - h)[0])) / (2 * h),
        abs=1e-8,
    )


def test_the_weighted_square_is_that_of_the_chart_as_it_is_defined(rng: np.random.Generator) -> None:
    """``(V⁻¹ (p - R p̂), d)`` with the information carried over by its derivative at the estimate: the longer way."""
    mean, x = rng.normal(0, 4, 9), rng.normal(0, 4, 9)
    A = rng.normal(size=(9, 9))
    information = A @ A.T
    mean[2], x[2] = 0.4, 1.3
    d = x[2] - mean[2]
    rows = [0, 1, 3, 4, 5, 6, 7, 8]
    points, hats = x[rows].reshape(-1, 2), mean[rows].reshape(-1, 2)
    r = np.zeros(9)
    r[rows] = ((points - hats @ rotation2(d).T) @ np.linalg.inv(mean_rotation(d)).T).ravel()
    r[2] = d
    D = np.eye(9)  # of the chart by the vector, at the estimate
    D[rows, 2] = -(hats @ QUARTER.T).ravel()
    inverse = np.linalg.inv(D)
    u = map_difference(x, mean, "group")
    assert u @ information @ u == pytest.approx(r @ inverse.T @ information @ inverse @ r, rel=1e-7)
    np.testing.assert_allclose(map_difference(x, mean, "cartesian"), x - mean)


def test_a_heading_error_that_turns_all_is_an_error_of_the_heading_alone(rng: np.random.Generator) -> None:
    """Exit and landmarks swing about the base by 0.6 rad: in the chart they swing along one direction, without a rest.

    With the covariance of a heading error (everything is moved by ``S p̂`` a radian) and little else the distance is
    that of the heading alone, where the Cartesian one sees the arcs leave the tangent."""
    p = rng.normal(0, 5, (6, 2))
    mean = np.concatenate([p[0], [0.2], p[1:].ravel()])
    swing = np.concatenate([(p[0] @ QUARTER.T), [1.0], (p[1:] @ QUARTER.T).ravel()])
    P = 0.3**2 * np.outer(swing, swing) + 1e-4 * np.eye(len(mean))
    turned = p @ rotation2(0.6).T
    x = np.concatenate([turned[0], [0.8], turned[1:].ravel()])
    group, plain = (map_difference(x, mean, c) for c in ("group", "cartesian"))
    assert group @ np.linalg.solve(P, group) == pytest.approx(4.0, rel=0.01)
    assert plain @ np.linalg.solve(P, plain) > 100.0


def test_unknown_charts_are_refused() -> None:
    with pytest.raises(ConfigError, match="polar"):
        check_chart("polar")
