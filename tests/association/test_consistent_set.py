"""Consistent sets of loops: cycles against a brute-force twin, honest χ², cliques against all subsets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from graphslam.association.clique import maximum_clique
from graphslam.association.consistent_set import (
    LoopArrays,
    OdometryChain,
    chain_chi2,
    consistent_loops,
    largest_consistent_set,
    pair_chi2,
)
from graphslam.core.errors import ConfigError, CovarianceError, GeometryError
from tests.reference.plain_network import between, compose, exp, inverse
from tests.reference.slow_loops import cycle_chi2, largest_clique


def drive(rng: np.random.Generator, dim: int, n: int, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True poses of a drive in circles, its noisy increments and their covariances."""
    d = 3 if dim == 2 else 6
    move = np.zeros(d)
    move[[2, 0] if dim == 2 else [2, 3]] = [2 * np.pi / 25, 1.0]
    moves = np.tile(move, (n - 1, 1)) + 0.05 * rng.standard_normal((n - 1, d))
    A = rng.standard_normal((n - 1, d, d))
    Q = sigma**2 * (np.eye(d) + 0.1 * A @ np.swapaxes(A, 1, 2))
    poses = [exp(np.zeros(d))]
    for m in moves:
        poses.append(compose(poses[-1], exp(m)))
    noise = np.einsum("kij,kj->ki", np.linalg.cholesky(Q), rng.standard_normal((n - 1, d)))
    return np.array(poses), compose(exp(moves), exp(noise)), Q


def loops_of(
    rng: np.random.Generator, poses: np.ndarray, ends: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    d = 3 if poses.shape[1] == 3 else 6
    P = np.tile(sigma**2 * np.diag(np.linspace(0.5, 2.0, d)), (len(ends), 1, 1))
    noise = np.einsum("kij,kj->ki", np.linalg.cholesky(P), rng.standard_normal((len(ends), d)))
    return compose(between(poses[ends[:, 0]], poses[ends[:, 1]]), exp(noise)), P


# crossing, nested, apart, overlapping with the chain between the ends, turned, twice the same
ENDS = np.array([[1, 14], [3, 15], [16, 4], [0, 9], [6, 18], [4, 2], [1, 14]])


@pytest.mark.parametrize("dim", [2, 3])
def test_cycles_equal_the_brute_force_twin_in_every_order_of_ends(rng: np.random.Generator, dim: int) -> None:
    poses, z, Q = drive(rng, dim, 20, 0.01)
    T, P = loops_of(rng, poses, ENDS, 0.02)
    chain = OdometryChain.of(z, Q)
    loops = LoopArrays.of(chain, ENDS, T, P)
    # turned loops are the same measurements
    forward = [
        (int(a), int(b), m, c) for (a, b), m, c in zip(loops.ends, loops.measured, loops.covariance, strict=True)
    ]
    i, j = np.triu_indices(len(ENDS), 1)
    if dim == 3:
        i, j = i[::2], j[::2]
    slow = [cycle_chi2(z, Q, forward[a], forward[b]) for a, b in zip(i, j, strict=True)]
    assert pair_chi2(chain, loops, i, j) == pytest.approx(slow, rel=0.02, abs=1e-6)
    alone = [cycle_chi2(z, Q, loop, None) for loop in forward]
    assert chain_chi2(chain, loops) == pytest.approx(alone, rel=0.02)
    # a loop said backwards is the same loop, to the order of the linearisation
    ad_free = LoopArrays.of(
        chain, ENDS[:, ::-1], inverse(loops_of(rng, poses, ENDS, 0.0 + 1e-9)[0]), np.tile(P[0], (len(ENDS), 1, 1))
    )
    assert (ad_free.ends[:, 0] < ad_free.ends[:, 1]).all()
    assert np.allclose(
        compose(inverse(ad_free.measured), between(poses[ad_free.ends[:, 0]], poses[ad_free.ends[:, 1]]))[:, :2],
        0.0,
        atol=1e-6,
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_chi2_of_right_loops_is_consistent_both_ways(rng: np.random.Generator, dim: int) -> None:
    """Over many drives D² of pairs and of single loops is χ²: mean and tail inside two-sided bounds.

    Halving or doubling the stated covariances must fall outside.
    """
    d, runs = (3 if dim == 2 else 6), 300
    pairs, singles, doubled = [], [], []
    for _ in range(runs):
        poses, z, Q = drive(rng, dim, 30, 0.004)
        ends = np.array([[1, 22], [27, 6]])
        T, P = loops_of(rng, poses, ends, 0.01)
        chain = OdometryChain.of(z, Q)
        loops = LoopArrays.of(chain, ends, T, P)
        pairs.append(pair_chi2(chain, loops, [0], [1])[0])
        singles.append(chain_chi2(chain, loops)[0])
        twice = OdometryChain.of(z, 2 * Q)
        doubled.append(pair_chi2(twice, LoopArrays.of(twice, ends, T, 2 * P), [0], [1])[0])
    low, high = stats.chi2.ppf([0.0005, 0.9995], d * runs) / runs
    for value in (pairs, singles):
        assert low < np.mean(value) < high
        outside = int(np.sum(np.array(value) > stats.chi2.ppf(0.95, d)))
        assert stats.binom.ppf(0.0005, runs, 0.05) <= outside <= stats.binom.ppf(0.9995, runs, 0.05)
    assert np.mean(doubled) < low


@pytest.mark.parametrize("dim", [2, 3])
def test_wrong_loops_are_refused_with_reasons_and_right_ones_kept(rng: np.random.Generator, dim: int) -> None:
    poses, z, Q = drive(rng, dim, 120, 0.003)
    ends = np.stack([np.arange(0, 30, 2), np.arange(0, 30, 2) + 75], axis=1)
    T, P = loops_of(rng, poses, ends, 0.02)
    # nine random wrong loops, and four that agree with each other: the second half circle taken for the first
    places = np.array([[5, 60], [50, 101], [22, 90], [33, 71], [8, 99], [60, 110], [1, 57], [13, 66], [40, 83]])
    wrong, Pw = loops_of(rng, poses, np.roll(places, 3, axis=0), 0.02)
    alias = np.stack([np.arange(4) + 10, np.arange(4) + 47], axis=1)
    away = exp(np.full(3 if dim == 2 else 6, 0.7))  # one wrong motion of the second stretch for all of them
    same, Ps = loops_of(rng, np.concatenate([poses[:40], compose(away, poses[40:])]), alias, 0.02)
    all_ends = np.concatenate([ends, places, alias])
    found = consistent_loops(
        z, Q, (all_ends, np.concatenate([T, wrong, same]), np.concatenate([P, Pw, Ps])), against_chain=False
    )
    good = len(ends)
    assert found.accepted[:good].sum() >= good - 2  # each is judged by itself at a level of its own
    assert not found.accepted[good:].any()
    assert found.exact
    assert found.clique.sum() == found.bound
    assert "contradicts" in found.reasons[good]
    assert "agrees with all" in found.reasons[int(np.argmax(found.clique))]
    assert np.allclose(found.chi2, found.chi2.T)
    # the aliased ones do agree among themselves: it is the others that speak against them
    i, j = np.triu_indices(4, 1)
    assert (found.chi2[good + 9 + i, good + 9 + j] < stats.chi2.ppf(0.9999, 3 if dim == 2 else 6)).all()


def test_one_contradiction_in_many_is_forgiven_only_if_asked() -> None:
    chi2 = np.ones((30, 30))
    chi2[3, 7] = chi2[7, 3] = 50.0
    chi2[12, :10] = chi2[:10, 12] = 50.0
    chi2[20, 20] = 60.0
    strict = largest_consistent_set(chi2, 11.0, readmit=0.0)
    assert int(strict.accepted.sum()) == 27  # without 20, 12 and one of 3 and 7
    lenient = largest_consistent_set(chi2, 11.0)
    assert sorted(np.flatnonzero(~lenient.accepted)) == [12, 20]
    assert lenient.reasons[20] == "contradicts the chain: D² = 60 > 11"
    assert any(r.startswith("readmitted: contradicts 1 of 27") for r in lenient.reasons)
    assert largest_consistent_set(chi2, 11.0, against_chain=False).accepted[20]
    unknown = np.full((3, 3), np.nan)
    assert largest_consistent_set(unknown, 11.0).accepted.all()


def test_cliques_are_maximal_by_all_subsets(rng: np.random.Generator) -> None:
    for density in (0.2, 0.5, 0.8, 0.95):
        for n in (1, 2, 7, 13):
            A = np.triu(rng.random((n, n)) < density, 1)
            A = A | A.T
            found = maximum_clique(A)
            members = np.flatnonzero(found.members)
            assert found.exact
            assert found.size == len(members) == largest_clique(A)
            assert A[np.ix_(members, members)].sum() == len(members) * (len(members) - 1)


def test_a_planted_clique_is_found_and_a_search_cut_short_bounds_it(rng: np.random.Generator) -> None:
    n = 300
    A = np.triu(rng.random((n, n)) < 0.5, 1)
    planted = rng.permutation(n)[:60]
    A[np.ix_(planted, planted)] = True
    A = np.triu(A, 1)
    A = A | A.T
    found = maximum_clique(A)
    assert found.exact
    assert set(planted) <= set(np.flatnonzero(found.members))
    sparse = np.triu(rng.random((200, 200)) < 0.7, 1)
    cut = maximum_clique(sparse | sparse.T, budget=50)
    assert not cut.exact
    full = maximum_clique((sparse | sparse.T)[:60, :60])
    assert full.exact
    assert full.size <= cut.bound
    assert cut.size <= cut.bound
    assert maximum_clique(np.zeros((0, 0), bool)).size == 0


def test_a_cut_chain_compares_nothing_across_the_cut(rng: np.random.Generator) -> None:
    poses, z, Q = drive(rng, 2, 60, 0.01)
    known = np.ones(59, dtype=bool)
    known[30] = False
    z[30] = np.nan
    chain = OdometryChain.of(z, Q, known)
    ends = np.array([[2, 40], [3, 41], [1, 20]])
    T, P = loops_of(rng, poses, ends, 0.01)
    loops = LoopArrays.of(chain, ends, T, P)
    assert np.isfinite(pair_chi2(chain, loops, [0], [1])).all()  # both over the cut: the chain joins their ends
    assert np.isnan(pair_chi2(chain, loops, [0], [2])).all()
    assert np.isnan(chain_chi2(chain, loops)).tolist() == [True, True, False]


def test_bad_input_is_refused_by_name(rng: np.random.Generator) -> None:
    poses, z, Q = drive(rng, 2, 20, 0.01)
    ends = np.array([[0, 10], [2, 12]])
    T, P = loops_of(rng, poses, ends, 0.01)
    with pytest.raises(ConfigError, match="level"):
        consistent_loops(z, Q, (ends, T, P), level=1.0)
    with pytest.raises(ConfigError, match="readmit"):
        consistent_loops(z, Q, (ends, T, P), readmit=1.5)
    with pytest.raises(GeometryError, match="loop 1 does not join"):
        consistent_loops(z, Q, (np.array([[0, 10], [2, 20]]), T, P))
    with pytest.raises(GeometryError, match="loop 0 is not finite"):
        consistent_loops(z, Q, (ends, T * np.nan, P))
    with pytest.raises(CovarianceError, match="covariance of loop 1 is not positive"):
        consistent_loops(z, Q, (ends, T, P * np.array([1.0, -1.0])[:, None, None]))
    with pytest.raises(CovarianceError, match="covariance of increment 0 is not finite"):
        consistent_loops(z, Q * np.nan, (ends, T, P))
    with pytest.raises(GeometryError, match="symmetric"):
        maximum_clique(np.triu(np.ones((3, 3), bool), 1))
