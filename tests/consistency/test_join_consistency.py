"""Is the joined map's covariance the right one? Monte Carlo over chains of submaps with truth, two-sided bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.compare import map_nees
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.submap import Submap
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_tree
from graphslam.join.submap_solver import solve_submaps
from tests.reference.submap_chain import submap_chain

RUNS = 30


def mean_nees(rng: np.random.Generator, *, claimed: float, **noise: float) -> tuple[float, float]:
    """Mean joint NEES and its dimension over runs of a chain with a loop, polished from the tree."""
    d2 = []
    for _ in range(RUNS):
        submaps, truth = submap_chain(rng, submaps=10, landmarks=30, claimed=claimed, **noise)
        joined = optimise_from_join(submaps, join_tree(submaps))
        assert joined.converged
        value, dof = map_nees(joined, [s.key for s in submaps], truth)
        d2.append(value / dof)
        assert dof == joined.states
    return float(np.mean(d2)), dof


SMALL = {"sigma": 0.02, "sigma_heading": 0.001}


def test_polished_map_is_consistent(rng: np.random.Generator) -> None:
    mean, dof = mean_nees(rng, claimed=1.0, **SMALL)
    low, high = (b / dof for b in chi2_mean_bounds(dof, RUNS, 0.999))
    assert low < mean < high
    assert high - low < 0.2  # bounds that could tell


@pytest.mark.parametrize(("claimed", "over"), [(0.7, True), (1.4, False)])
def test_a_wrong_covariance_is_found_out(rng: np.random.Generator, claimed: float, over: bool) -> None:
    mean, dof = mean_nees(rng, claimed=claimed, **SMALL)
    low, high = (b / dof for b in chi2_mean_bounds(dof, RUNS, 0.999))
    assert (mean > high) if over else (mean < low)
    assert mean == pytest.approx(1.0 / claimed, rel=0.15)


def test_objective_has_the_degrees_of_freedom_it_should(rng: np.random.Generator) -> None:
    total, dof = 0.0, 0
    for _ in range(RUNS):
        submaps, _ = submap_chain(rng, submaps=10, landmarks=30, **SMALL)
        best = solve_submaps(submaps)
        total += best.objective
        dof += sum(3 + 2 * len(s.landmarks) for s in submaps) - best.states
    low, high = chi2_mean_bounds(dof, 1, 0.999)
    assert low < total < high


def test_scatter_of_the_estimates_is_the_claimed_covariance(rng: np.random.Generator) -> None:
    """One layout, noise redrawn: the sample covariance of the last pose against the one that is reported."""
    layout = np.random.default_rng(3)
    reference, _ = submap_chain(layout, submaps=8, landmarks=30, **SMALL)
    last, claims = [], []
    for seed in range(150):
        noise = np.random.default_rng([seed, 11])
        noisy = []
        for s in reference:
            z = s.landmarks.mean + np.linalg.cholesky(s.landmarks.covariance) @ noise.standard_normal(
                len(s.landmarks.mean)
            )
            local = replace(s.landmarks, exit_pose=z[:3], positions=z[3:].reshape(-1, 2))
            noisy.append(Submap.from_landmarks(s.key, local))
        best = solve_submaps(noisy)
        last.append(best.poses[-1])
        claims.append(best.pose_covariance(8))
    # The reference is itself noisy, not a truth; only the scatter about the mean is compared.
    sample, claim = np.cov(np.array(last).T), np.mean(claims, axis=0)
    w = np.linalg.eigvals(np.linalg.solve(claim, sample)).real
    assert w.min() > 0.65
    assert w.max() < 1.5
