"""What decides on loops: the χ² of a loop that is in a graph, against the graph without it."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.geometry import Array
from graphslam.core.poses import SE3
from graphslam.loops.measure import Loop
from graphslam.loops.rules import LEARNT, chi2_without

R = np.diag([0.012, 0.012, 0.014, 0.10, 0.13, 0.10]) ** 2


def fused(prior: Array, error: Array) -> tuple[Loop, Array, Array, float]:
    """A loop that is off by ``error`` from a prior at the identity: itself, where both meet, posterior, true χ²."""
    information = np.linalg.inv(prior) + np.linalg.inv(R)
    P = np.linalg.inv(information)
    loop = Loop(i=0, j=1, T_ij=SE3.exp(error), covariance=R, source="front-end")
    return loop, SE3.exp(P @ np.linalg.solve(R, error)), P, float(error @ np.linalg.solve(prior + R, error))


def test_it_is_that_of_the_prior(rng: np.random.Generator) -> None:
    prior = 4.0 * R
    for _ in range(20):
        error = 0.1 * np.linalg.cholesky(prior + R) @ rng.standard_normal(6)  # small: first order
        loop, T, P, wanted = fused(prior, error)
        assert chi2_without(loop, T, P) == pytest.approx(wanted, rel=0.02)


def test_what_the_graph_learnt_from_the_loop_is_no_test_of_it(rng: np.random.Generator) -> None:
    """A chain that knows the place to metres; bending it has changed P by more than R and P differ."""
    prior = np.diag([0.009, 0.010, 0.08, 2.9, 1.5, 0.7]) ** 2
    for _ in range(20):
        error = np.linalg.cholesky(prior + R) @ rng.standard_normal(6) * [1.0, 1.0, 0.3, 0.1, 0.1, 0.3]
        loop, T, P, wanted = fused(prior, error)
        for off in (-2e-3, 2e-3):
            assert chi2_without(loop, T, (1.0 + off) * P) <= 1.5 * wanted + 1.0
    # yet one that is far off is still told
    loop, T, P, wanted = fused(prior, np.array([0.0, 0.0, 0.0, 60.0, 0.0, 0.0]))
    assert wanted > 400.0
    assert chi2_without(loop, T, 1.002 * P) > 30.0
    assert 0.0 < LEARNT < 0.1
