"""Gaussians: round trips, moment matching against sampling, refusal of bad covariances."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from graphslam.core.errors import CovarianceError
from graphslam.core.gaussian import (
    Gaussian,
    Information,
    check_covariance,
    chi2_mean_bounds,
    chi2_quantile,
    moment_match,
)


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n + 2))
    return A @ A.T / n


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 8), seed=st.integers(0, 2**32 - 1))
def test_moments_information_round_trip(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = Gaussian(rng.normal(size=n), random_covariance(rng, n))
    back = g.to_information().to_gaussian()
    assert np.allclose(back.mean, g.mean, atol=1e-6)
    assert np.allclose(back.covariance, g.covariance, rtol=1e-6, atol=1e-9)
    assert np.allclose(g.to_information().mean(), g.mean, atol=1e-6)


def test_covariance_block_equals_the_dense_inverse(rng: np.random.Generator) -> None:
    n = 30
    A = sp.random_array((n, n), density=0.1, rng=rng) + 4 * sp.eye_array(n)
    info = Information(sp.csc_matrix(A.T @ A), rng.normal(size=n))
    ix = [7, 0, 21]
    assert np.allclose(info.covariance_block(ix), np.linalg.inv(info.matrix.toarray())[np.ix_(ix, ix)], atol=1e-12)


def test_singular_information_is_an_error() -> None:
    with pytest.raises(CovarianceError, match="factorised"):
        Information(sp.csc_matrix(np.diag([1.0, 0.0])), np.zeros(2)).mean()


def test_marginal_picks_blocks_and_keeps_track_of_angles(rng: np.random.Generator) -> None:
    g = Gaussian(np.arange(4.0), random_covariance(rng, 4), angular=(2,))
    m = g.marginal([3, 2])
    assert m.mean.tolist() == [3.0, 2.0]
    assert m.angular == (1,)
    assert np.array_equal(m.covariance, g.covariance[np.ix_([3, 2], [3, 2])])


def test_mahalanobis_wraps_angles() -> None:
    g = Gaussian([0.0, np.pi - 0.05], np.diag([4.0, 0.01]), angular=(1,))
    assert g.mahalanobis2([2.0, -np.pi + 0.05]) == pytest.approx(1.0 + 0.1**2 / 0.01)


def test_kl_of_one_dimension_by_hand() -> None:
    a, b = Gaussian([1.0], [[4.0]]), Gaussian([0.0], [[9.0]])
    assert a.kl_from(b) == pytest.approx(np.log(3 / 2) + (4 + 1) / 18 - 0.5)
    assert a.kl_from(a) == pytest.approx(0.0, abs=1e-15)


def test_moment_matching_against_sampling(rng: np.random.Generator) -> None:
    w = np.array([0.2, 0.5, 0.3])
    means = rng.normal(size=(3, 3)) * 2
    covs = np.stack([random_covariance(rng, 3) for _ in w])
    n = 400_000
    which = rng.choice(3, size=n, p=w)
    L = np.linalg.cholesky(covs)
    x = means[which] + np.einsum("nij,nj->ni", L[which], rng.normal(size=(n, 3)))
    g = moment_match(3.0 * w, means, covs)  # weights need no normalisation
    spread = np.sqrt(np.diag(g.covariance))
    assert np.all(np.abs(g.mean - x.mean(0)) < 5 * spread / np.sqrt(n))
    assert np.abs(g.covariance - np.cov(x.T)).max() < 0.02 * g.covariance.max()


def test_moment_matching_of_headings_on_both_sides_of_the_cut(rng: np.random.Generator) -> None:
    # headings around π: a plain mean would say 0
    h = np.pi + 0.1 * rng.standard_normal(2000)
    means = np.stack([rng.standard_normal(2000), np.arctan2(np.sin(h), np.cos(h))], -1)
    g = moment_match(np.ones(2000), means, np.diag([1e-6, 1e-6]), angular=(1,))
    assert abs(abs(g.mean[1]) - np.pi) < 0.02
    assert g.covariance[1, 1] == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize(
    ("cov", "what"),
    [
        ([[1.0, 0.5], [0.0, 1.0]], "not symmetric"),
        ([[1.0, np.nan], [np.nan, 1.0]], "not finite"),
        ([[np.inf, 0.0], [0.0, 1.0]], "not finite"),
        ([[0.0, 0.0], [0.0, 0.0]], "not positive definite"),
        ([[1.0, 2.0], [2.0, 1.0]], "not positive definite"),
        ([[-1.0, 0.0], [0.0, 1.0]], "not positive definite"),
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "wrong shape"),
        ([1.0, 2.0], "wrong shape"),
    ],
)
def test_bad_covariance_is_refused_with_its_name(cov: list, what: str) -> None:
    with pytest.raises(CovarianceError, match=what) as error:
        check_covariance(cov, what="my covariance", where="file 7")
    assert "my covariance" in str(error.value)
    assert "file 7" in str(error.value)


def test_wrong_dimension_says_which_was_wanted() -> None:
    with pytest.raises(CovarianceError, match=r"\(3, 3\)"):
        check_covariance(np.eye(2), dim=3)


def test_rounding_asymmetry_is_averaged_not_refused() -> None:
    P = np.array([[1.0, 0.5], [0.5 + 1e-9, 1.0]])
    Q = check_covariance(P)
    assert Q[0, 1] == Q[1, 0]
    assert P[0, 1] != P[1, 0]  # the argument is not changed


def test_small_but_clear_asymmetry_is_refused_whatever_the_scale() -> None:
    with pytest.raises(CovarianceError, match="not symmetric"):
        check_covariance(1e-12 * np.array([[1.0, 0.5], [0.4, 1.0]]))


def test_chi2_bounds_hold_the_stated_share_of_means(rng: np.random.Generator) -> None:
    low, high = chi2_mean_bounds(3, 10, 0.95)
    means = rng.chisquare(3, size=(20_000, 10)).mean(axis=1)
    share = np.mean((means > low) & (means < high))
    assert abs(share - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 20_000)
    assert np.mean(means < low) == pytest.approx(0.025, abs=0.006)  # both tails, not one


def test_chi2_quantile_is_scipys() -> None:
    assert chi2_quantile(0.95, 2) == pytest.approx(-2 * np.log(0.05))
    assert chi2_quantile(0.5, 7) == pytest.approx(stats.chi2.median(7))
