"""Weights are those of a slow twin; maps that know little neither win nor lose by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.random import SeedTree
from graphslam.evidence.likelihood import CastLikelihood, EndpointLikelihood
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter import GridFilter
from graphslam_frontends.grid.particles import normalise_log_weights
from graphslam_frontends.grid.weights import evenly_spaced_indices, fill_with_mean_likelihood, maps_with_enough_scans
from tests.frontends.grid_world import ring
from tests.reference.grid_weighing import endpoint_gains


def test_spread_takes_all_or_evenly_many() -> None:
    assert evenly_spaced_indices(5, 0).tolist() == evenly_spaced_indices(5, 9).tolist() == [0, 1, 2, 3, 4]
    assert evenly_spaced_indices(0, 10).tolist() == []
    for n, most in ((305, 60), (100, 99), (7, 3)):
        got = evenly_spaced_indices(n, most)
        assert len(np.unique(got)) == most
        assert got[0] == 0
        assert got[-1] < n
        assert np.diff(got).max() - np.diff(got).min() <= 1


def test_only_maps_that_know_enough_are_asked_or_else_the_oldest() -> None:
    ages = np.array([0, 3, 12, 20])
    assert maps_with_enough_scans(ages, 12).tolist() == [False, False, True, True]
    assert maps_with_enough_scans(ages, 0).tolist() == [False, True, True, True]
    assert maps_with_enough_scans(np.array([0, 3, 5, 5]), 12).tolist() == [False, False, True, True]
    assert maps_with_enough_scans(np.array([4, 4]), 12).tolist() == [True, True]
    assert not maps_with_enough_scans(np.zeros(3, dtype=np.int64), 12).any()


def test_the_young_keep_their_share_of_the_weight(rng: np.random.Generator) -> None:
    log_weights = np.log(rng.dirichlet(np.ones(9)))
    gains = rng.normal(scale=5.0, size=9)
    known = np.array([True, False, True, True, False, True, True, True, False])
    new = fill_with_mean_likelihood(gains, log_weights, known)
    assert np.array_equal(new[known], gains[known])
    assert np.ptp(new[~known]) == 0.0
    before, after = np.exp(log_weights), normalise_log_weights(log_weights + new)
    assert after[~known].sum() == pytest.approx(before[~known].sum(), rel=1e-12)
    assert after[~known] / before[~known] == pytest.approx(np.ones(3), rel=1e-12)
    # among themselves those told weigh as if the others were not there
    assert after[known] / after[known].sum() == pytest.approx(
        normalise_log_weights(log_weights[known] + gains[known]), rel=1e-12
    )
    assert np.array_equal(fill_with_mean_likelihood(gains, log_weights, np.zeros(9, dtype=np.bool_)), np.zeros(9))
    assert np.array_equal(fill_with_mean_likelihood(gains, log_weights, np.ones(9, dtype=np.bool_)), gains)
    far = fill_with_mean_likelihood(gains - 1e6, log_weights, known)
    assert np.all(np.isfinite(far))


def test_a_likelihood_that_is_nothing_leaves_the_young_alone() -> None:
    gains = np.array([-np.inf, -2.0, 0.0])
    new = fill_with_mean_likelihood(gains, np.log(np.full(3, 1 / 3)), np.array([True, True, False]))
    assert new[2] == pytest.approx(-2.0 - np.log(2.0))


@pytest.mark.parametrize("dim", [2, 3])
def test_weights_equal_the_slow_twin(dim: int) -> None:
    steps = ring(3, dim, length=6.0, beams=60)
    config = GridFilterConfig(
        particles=4, voxel_size=0.2, weight_beams=17, young=3, heading_walk=0.05, ess_fraction=0.01
    )
    filter = GridFilter(steps, config, SeedTree(1))
    for k in range(8):
        filter.step(k)
    filter.predict(8)
    before = filter.particles.log_weights
    ((rows, _),) = filter.weighed_beams(8)
    points, _, returns = filter.steps.scan(8)
    assert returns[rows].all()
    assert len(rows) == 17
    points = points[rows]
    wanted = endpoint_gains(filter.particles.grids, filter.particles.poses, points, min(60 / 17, 1.0), config)
    got = filter.weigh(8)
    assert np.ptp(wanted) > 0.3  # the particles differ, or nothing is tested
    assert got == pytest.approx(wanted, rel=1e-5, abs=1e-4)
    assert filter.particles.weights == pytest.approx(normalise_log_weights(before + wanted), rel=1e-3)


def test_exponents_follow_the_number_of_beams() -> None:
    config = GridFilterConfig(endpoint_effective_beams=60.0)
    end, cast = config.by_end_points(240), config.by_casting(240)
    assert isinstance(end, EndpointLikelihood)
    assert isinstance(cast, CastLikelihood)
    assert end.exponent == 0.25
    assert cast.exponent == pytest.approx(1 / 60)
    assert config.by_end_points(5).exponent == 1.0
    assert config.by_end_points(0).exponent == 1.0


@pytest.mark.parametrize("likelihood", ["endpoint", "cast"])
def test_the_particle_at_the_truth_wins_and_one_half_a_metre_off_loses(likelihood: str) -> None:
    steps = ring(5, 3, length=8.0, yaw_bias=0.0, beams=600)
    config = GridFilterConfig(particles=3, likelihood=likelihood, motion_scale=0.0, position_walk=0.0, height_walk=0.0,
                              heading_walk=0.0, heading_turn=0.0, ess_fraction=0.01)  # type: ignore[arg-type]  # fmt: skip
    filter = GridFilter(replace(steps, tilt_sigma=0.0), config, SeedTree(0))
    for k in range(len(steps) - 1):
        filter.step(k)
    k = len(steps) - 1
    filter.predict(k)
    filter.particles.poses[1, 1] += 0.5
    filter.particles.poses[2, 1] -= 0.1
    gains = filter.weigh(k)
    assert gains[0] > gains[2] + 0.1 > gains[1] + 2.0
    assert filter.particles.best == 0
