"""Weights and systematic resampling."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam_frontends.grid.particles import effective_sample_size, normalise_log_weights, systematic_resample


def test_resampling_is_unbiased_and_systematic(rng):
    w = np.array([0.05, 0.4, 0.0, 0.25, 0.3])
    counts = np.zeros(5)
    for _ in range(4000):
        k = np.bincount(systematic_resample(w, rng.random()), minlength=5)
        assert np.all(np.abs(k - 5 * w) < 1)  # floor or ceil of n w
        counts += k
    np.testing.assert_allclose(counts / 4000, 5 * w, atol=0.03)


def test_resampling_never_leaves_the_set(rng):
    w = normalise_log_weights(rng.normal(size=1000) * 30)
    for u in (0.0, 0.5, np.nextafter(1.0, 0.0)):
        k = systematic_resample(w, u)
        assert k.min() >= 0
        assert k.max() < 1000


def test_effective_sample_size_bounds():
    assert effective_sample_size(np.full(40, 1 / 40)) == pytest.approx(40)
    assert effective_sample_size(np.eye(40)[3]) == pytest.approx(1)


def test_weights_survive_extreme_and_hopeless_likelihoods():
    np.testing.assert_allclose(normalise_log_weights(np.array([-1e5, -1e5 + np.log(3)])), [0.25, 0.75])
    np.testing.assert_allclose(normalise_log_weights(np.full(4, -np.inf)), 0.25)
    np.testing.assert_allclose(normalise_log_weights(np.array([-np.inf, 0.0])), [0, 1])
