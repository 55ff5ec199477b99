"""Gaussians: round trips, moment matching against sampling, refusal of bad covariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from graphslam.core.errors import CovarianceError, FormatError
from graphslam.core.gaussian import (
    Gaussian,
    check_covariance,
    chi2_mean_bounds,
    chi2_quantile,
    ellipse_rings,
    equal_tail_gate,
    first_no_covariance,
    largest_sigmas,
    moment_match,
)
from graphslam_studies.evaluate.information import information_matrices


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n + 2))
    return A @ A.T / n


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


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("units", [(1.0, 1.0), (1e4, 1e-3), (1e-9, 1e-9)])
def test_what_counts_as_rounding_is_a_millionth_of_the_two_sigmas(units: tuple[float, float], sign: float) -> None:
    """Sums of float32 figures differ by 1e-7 of σ_i σ_j; a wrong sign or a lost term by far more, in whatever units."""
    unit = np.outer(units, units)
    for off, refused in ((0.7e-6, False), (1.4e-6, True)):
        P = unit * np.array([[1.0, 0.3 + sign * off], [0.3, 1.0]])
        if refused:
            with pytest.raises(CovarianceError, match="not symmetric"):
                check_covariance(P)
        else:
            np.testing.assert_allclose(check_covariance(P), unit * np.array([[1, 0.3], [0.3, 1]]), rtol=3e-6)


def test_refusals_name_the_first_bad_element_and_its_value() -> None:
    P = np.eye(4)
    P[1, 3] = P[3, 1] = np.nan
    with pytest.raises(CovarianceError, match=r"nan at \(1, 3\)"):
        check_covariance(P)
    P[1, 3], P[3, 1] = 0.25, 0.5
    with pytest.raises(CovarianceError, match=r"0\.25 and 0\.5 at \(1, 3\)"):
        check_covariance(P)
    with pytest.raises(CovarianceError, match="smallest eigenvalue -2"):
        check_covariance(np.diag([3.0, -2.0, 1.0]))
    with pytest.raises(CovarianceError, match="symmetric"):  # a variance below zero has no root, and no warning either
        check_covariance([[-1.0, 0.2], [0.1, 1.0]])


def test_a_gaussian_holds_checked_copies() -> None:
    mean, P = [1.0, 2.0], [[2.0, 0.5 + 1e-9], [0.5, 1.0]]
    g = Gaussian(mean, P)
    assert isinstance(g.mean, np.ndarray)
    np.testing.assert_array_equal(g.covariance, g.covariance.T)
    with pytest.raises(CovarianceError, match=r"\(2, 2\)"):
        Gaussian(mean, np.eye(3))
    with pytest.raises(CovarianceError):
        Gaussian(mean, -np.eye(2))


def test_differences_of_many_points_wrap_each_heading_and_nothing_else() -> None:
    g = Gaussian([10.0, 3.0, -3.0], np.eye(3), angular=(1, 2))
    x = np.array([[20.0, -3.0, 3.0], [0.0, 3.1, -3.1]])
    tau = 2 * np.pi
    np.testing.assert_allclose(g.difference(x), [[10.0, tau - 6.0, 6.0 - tau], [-10.0, 0.1, -0.1]], atol=1e-12)


def test_kl_wraps_angles(rng: np.random.Generator) -> None:
    P = random_covariance(rng, 3)
    g = Gaussian([1.0, 2.0, 3.1], P, angular=(2,))
    turned = Gaussian([1.0, 2.0, 3.1 - 2 * np.pi], P, angular=(2,))
    assert g.kl_from(turned) == pytest.approx(0.0, abs=1e-9)


def test_kl_of_correlated_gaussians_against_sampling(rng: np.random.Generator) -> None:
    """KL(p ‖ q) is the mean of log p - log q over draws of p: a halved covariance or a dropped term does not fit."""
    p = Gaussian(rng.normal(size=3), random_covariance(rng, 3))
    q = Gaussian(p.mean + 0.3, 1.5 * random_covariance(rng, 3))
    x = rng.multivariate_normal(p.mean, p.covariance, size=100_000)
    ratio = stats.multivariate_normal(p.mean, p.covariance).logpdf(x)
    ratio -= stats.multivariate_normal(q.mean, q.covariance).logpdf(x)
    assert p.kl_from(q) == pytest.approx(ratio.mean(), abs=5 * ratio.std() / np.sqrt(len(x)))


@pytest.mark.parametrize("gate", [5.99, 13.8])
@pytest.mark.parametrize(("dof", "other"), [(2, 3), (3, 1), (2, 6)])
def test_equal_gates_fail_equally_many_good_observations(gate: float, dof: int, other: int) -> None:
    rng = np.random.default_rng(dof + other)
    n = 200_000
    share = stats.chi2.sf(gate, dof)
    failed = np.mean(rng.chisquare(other, n) > equal_tail_gate(gate, dof, other))
    assert failed == pytest.approx(share, abs=5 * np.sqrt(share / n))
    assert equal_tail_gate(gate, dof, dof) == pytest.approx(gate)


def test_moment_matching_weighs_covariances_and_wraps_differences(rng: np.random.Generator) -> None:
    """Two headings on both sides of the cut, 3 : 1, each with a covariance of its own: by hand."""
    covariances = np.array([np.diag([1.0, 0.04]), np.diag([3.0, 0.02])])
    g = moment_match([3.0, 1.0], [[0.0, np.pi - 0.01], [4.0, -np.pi + 0.01]], covariances, angular=(1,))
    assert g.mean[0] == pytest.approx(1.0)
    mean = np.angle(0.75 * np.exp(1j * (np.pi - 0.01)) + 0.25 * np.exp(1j * (np.pi + 0.01)))
    assert g.mean[1] == pytest.approx(mean)
    a, b = np.pi - 0.01 - mean, np.pi + 0.01 - mean
    between = 0.75 * np.outer([-1.0, a], [-1.0, a]) + 0.25 * np.outer([3.0, b], [3.0, b])
    np.testing.assert_allclose(g.covariance, np.diag([1.5, 0.035]) + between, atol=1e-12)
    np.testing.assert_array_equal(g.covariance, g.covariance.T)
    assert g.angular == (1,)


def test_bounds_are_of_95_percent_unless_stated_otherwise() -> None:
    assert chi2_mean_bounds(3, 10) == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 30) / 10))


def test_chi2_bounds_hold_the_stated_share_of_means(rng: np.random.Generator) -> None:
    low, high = chi2_mean_bounds(3, 10, 0.95)
    means = rng.chisquare(3, size=(20_000, 10)).mean(axis=1)
    share = np.mean((means > low) & (means < high))
    assert abs(share - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 20_000)
    assert np.mean(means < low) == pytest.approx(0.025, abs=0.006)  # both tails, not one


def test_chi2_quantile_is_scipys() -> None:
    assert chi2_quantile(0.95, 2) == pytest.approx(-2 * np.log(0.05))
    assert chi2_quantile(0.5, 7) == pytest.approx(stats.chi2.median(7))


def random_covariances(rng: np.random.Generator, n: int, d: int) -> np.ndarray:
    A = rng.standard_normal((n, d, d))
    return A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(d)


def test_inverses_name_the_first_matrix_that_has_none(rng):
    P = random_covariances(rng, 5, 3)
    np.testing.assert_allclose(information_matrices(P, "file") @ P, np.broadcast_to(np.eye(3), P.shape), atol=1e-9)
    for k, bad in ((1, -np.eye(3)), (3, np.zeros((3, 3))), (4, np.full((3, 3), np.nan)), (2, 1e-320 * np.eye(3))):
        spoilt = P.copy()
        spoilt[k] = bad
        with pytest.raises(FormatError, match=rf"file: 1 covariances are not positive definite, first: number {k}"):
            information_matrices(spoilt, "file")


def test_rings_lie_at_the_quantile_and_run_counter_clockwise(rng):
    centres, P = rng.normal(0, 5, (4, 2)), random_covariances(rng, 4, 2)
    rings = ellipse_rings(centres, P, 0.9, 24)
    assert rings.shape == (4, 25, 2)
    np.testing.assert_array_equal(rings[:, 0], rings[:, -1])
    d = rings - centres[:, None]
    np.testing.assert_allclose(np.einsum("kni,kij,knj->kn", d, np.linalg.inv(P), d), stats.chi2.ppf(0.9, 2), rtol=1e-9)
    area = 0.5 * np.sum(d[:, :-1, 0] * d[:, 1:, 1] - d[:, :-1, 1] * d[:, 1:, 0], axis=1)
    full = np.pi * stats.chi2.ppf(0.9, 2) * np.sqrt(np.linalg.det(P))  # 24 corners leave out a hundredth
    np.testing.assert_allclose(area, full, rtol=0.02)
    assert len(np.unique(np.round(rings[0, :-1], 9), axis=0)) == 24


def test_largest_sigmas_are_those_of_the_longest_axes(rng):
    P = random_covariances(rng, 6, 3)
    np.testing.assert_allclose(largest_sigmas(P), np.sqrt(np.linalg.eigvalsh(P)[:, -1]), rtol=1e-9)
    assert largest_sigmas(np.zeros((0, 3, 3))).shape == (0,)
    assert first_no_covariance(P) is None
    assert first_no_covariance(np.zeros((2, 3, 3))) is None
    uneven = np.diag([1e-4, 1e-2, 1e6])[None]
    uneven[0, 0, 1] = 1e-3  # rounding of the largest entry, though not of the second
    assert first_no_covariance(uneven) is None
    P[2] = -P[2]
    assert first_no_covariance(P) == 2
