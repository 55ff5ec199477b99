"""Algorithm 1: recognising landmarks; the beam search against brute force; merging by distance."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.submap import Submap
from graphslam.io.slsjf import read_slsjf_local_maps
from graphslam.join import association
from graphslam.join.association import CandidatePairs, MapAssociationConfig, match_landmarks
from graphslam.join.eif import join_maps
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinedMap
from graphslam.join.order import join_sequential, join_tree
from tests.reference.submap_chain import random_covariance, submap_chain


def forget(submaps: list[Submap]) -> list[Submap]:
    return [s.with_ids(np.full(len(s.landmarks), -1)) for s in submaps]


def pair_scores(submaps: list[Submap], found: tuple[np.ndarray, ...]) -> tuple[float, float]:
    """Precision and recall over pairs of entries that are said to be one landmark."""
    a = np.concatenate([s.landmarks.ids for s in submaps])
    b = np.concatenate(found)
    same_a, same_b = a[:, None] == a[None], b[:, None] == b[None]
    upper = np.triu(np.ones_like(same_a), 1).astype(bool)
    both = np.sum(same_a & same_b & upper)
    return both / np.sum(same_b & upper), both / np.sum(same_a & upper)


@pytest.mark.parametrize("rule", ["nearest", "joint"])
@pytest.mark.parametrize("join", [join_sequential, join_tree, join_ekf])
def test_landmarks_are_recognised_around_a_loop(join, rule: str, rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=20, landmarks=60)
    options = MapAssociationConfig(rule=rule, sensor_range=14.0)
    joined = join(forget(submaps), association=options)
    precision, recall = pair_scores(submaps, joined.submap_ids)
    assert precision > 0.995
    assert recall > 0.97
    assert all(len(np.unique(i)) == len(i) for i in joined.submap_ids)  # exclusive
    given = join(submaps)
    if precision == recall == 1.0:
        np.testing.assert_allclose(joined.poses, given.poses, atol=1e-8)


@pytest.mark.data
def test_landmarks_of_the_published_maps_are_recognised(data_dir: Path) -> None:
    """200 real local maps, five loops through a park, 299 trees: against the published identities."""
    submaps = read_slsjf_local_maps(data_dir / "victoria_park_processed")
    joined = join_sequential(submaps, association=MapAssociationConfig(rule="joint"))
    precision, recall = pair_scores(submaps, joined.submap_ids)
    assert precision > 0.9995
    assert recall > 0.985
    assert 299 <= len(joined.landmark_ids) <= 330
    assert joined.times["association"] > 0


def test_a_submap_out_of_reach_is_not_even_looked_at(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=10, landmarks=60, radius=200.0, reach=60.0, laps=0.5)
    joined = join_sequential(submaps[:8])
    a = JoinedMap.leaf(submaps[0], identified=False)
    for s in submaps[1:8]:
        leaf = JoinedMap.leaf(s, identified=False)
        a = join_maps(a, leaf, np.full(len(leaf.landmark_at), -1))
    far = JoinedMap.leaf(submaps[8], identified=False)
    asked: list[np.ndarray] = []
    real = a.covariance_block
    a.covariance_block = lambda ix: asked.append(ix) or real(ix)  # type: ignore[method-assign,func-returns-value]
    match_landmarks(a, far, MapAssociationConfig(sensor_range=60.0, radius=5.0))
    assert len(joined.landmark_ids) > 0
    assert max(len(ix) for ix in asked) < 0.5 * len(a.x)  # a submatrix, never the whole


def problem(rng: np.random.Generator, known: int, observed: int, drift: float) -> tuple[CandidatePairs, np.ndarray]:
    """A pose with some drift among known landmarks, and observations of the first of them."""
    landmarks = rng.uniform(-12, 12, (known, 2))
    P = random_covariance(rng, np.concatenate([[drift, drift, drift / 30.0], np.full(2 * known, 0.05)]))
    state = np.concatenate([np.zeros(3), landmarks.ravel()])
    true = state + np.linalg.cholesky(P) @ rng.standard_normal(len(P))
    c, s = np.cos(true[2]), np.sin(true[2])
    z = (true[3:].reshape(-1, 2)[:observed] - true[:2]) @ np.array([[c, -s], [s, c]])
    Q = random_covariance(rng, np.full(2 * observed, 0.05))
    z = z + (np.linalg.cholesky(Q) @ rng.standard_normal(len(Q))).reshape(-1, 2)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(observed), np.arange(known), indexing="ij"))
    pairs = CandidatePairs.predict(np.zeros(3), landmarks, P, z, Q, i, j)
    return pairs.subset(pairs.mahalanobis2() <= chi2_quantile(0.9973, 2)), z


def joint_distance(pairs: CandidatePairs, chosen: tuple[int, ...]) -> float:
    C = pairs.joint_covariance()
    ix = np.array([2 * k + e for k in chosen for e in (0, 1)])
    nu = pairs.innovation[list(chosen)].ravel()
    return float(nu @ np.linalg.solve(C[np.ix_(ix, ix)], nu))


def test_joint_search_finds_the_largest_compatible_set(rng: np.random.Generator) -> None:
    """Against brute force over all exclusive sets."""
    searched = 0
    for _ in range(15):
        pairs, _ = problem(rng, known=6, observed=4, drift=2.0)
        p = len(pairs.i)
        best = 0
        for size in range(1, 5):
            for chosen in itertools.combinations(range(p), size):
                k = list(chosen)
                if len(set(pairs.i[k])) < size or len(set(pairs.j[k])) < size:
                    continue
                if joint_distance(pairs, chosen) <= chi2_quantile(0.9973, 2 * size):
                    best = size
                    break
        found = pairs.joint(0.9973, 25)
        assert len(set(pairs.i[found])) == len(set(pairs.j[found])) == len(found)
        assert joint_distance(pairs, tuple(found)) <= chi2_quantile(0.9973, 2 * max(len(found), 1)) * (1 + 1e-9)
        assert len(found) >= best - (0 if p < 12 else 1)
        searched += p > len(found)
    assert searched >= 8  # there was a choice


def test_joint_rule_survives_a_drift_that_fools_the_nearest_neighbour(rng: np.random.Generator) -> None:
    wrong = {"nearest": 0, "joint": 0}
    for _ in range(30):
        pairs, _ = problem(rng, known=25, observed=10, drift=3.0)
        for rule, chosen in (("nearest", pairs.nearest()), ("joint", pairs.joint(0.9973, 25))):
            wrong[rule] += int(np.sum(pairs.i[chosen] != pairs.j[chosen]))
    assert wrong["joint"] <= 6
    assert wrong["nearest"] > 5 * max(wrong["joint"], 1)


def test_too_many_pairs_are_cut_to_the_nearest_of_every_landmark(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pairs, _ = problem(rng, known=25, observed=10, drift=2.0)
    whole = pairs.joint(0.9973, 25)
    assert not caplog.records
    assert len(pairs.i) > 40
    monkeypatch.setattr(association, "_MOST_PAIRS", 40)
    few = pairs.joint(0.9973, 25)
    assert f"{len(pairs.i)} candidate pairs" in caplog.text
    d2 = pairs.mahalanobis2()
    for k in few:  # nobody nearer was left out for a pair that was tried
        assert np.sum((pairs.i == pairs.i[k]) & (d2 < d2[k])) <= 40 // 10 + 1
    monkeypatch.setattr(association, "_MOST_PAIRS", len(pairs.i))
    np.testing.assert_array_equal(pairs.joint(0.9973, 25), whole)


def test_nearest_takes_the_smallest_distance_first(rng: np.random.Generator) -> None:
    pairs, _ = problem(rng, known=8, observed=5, drift=1.5)
    chosen = pairs.nearest()
    d2 = pairs.mahalanobis2()
    left = set(range(len(pairs.i)))
    for k in chosen:
        assert d2[k] == min(d2[list(left)])
        left = {q for q in left if pairs.i[q] != pairs.i[k] and pairs.j[q] != pairs.j[k]}
    assert not left


def test_pair_covariances_are_the_blocks_of_the_joint_one(rng: np.random.Generator) -> None:
    pairs, _ = problem(rng, known=5, observed=4, drift=1.0)
    C = pairs.joint_covariance()
    for k, S in enumerate(pairs.covariances()):
        np.testing.assert_allclose(S, C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], atol=1e-12)


def test_innovation_covariance_is_right_by_monte_carlo(rng: np.random.Generator) -> None:
    n, d2 = 3000, []
    for _ in range(n):
        landmark = np.array([[6.0, 2.0]])
        P = np.diag([0.04, 0.09, 1e-4, 0.01, 0.02])
        true = np.concatenate([np.zeros(3), landmark.ravel()]) + np.sqrt(np.diag(P)) * rng.standard_normal(5)
        c, s = np.cos(true[2]), np.sin(true[2])
        Q = np.diag([0.01, 0.03])
        z = (true[3:] - true[:2]) @ np.array([[c, -s], [s, c]]) + np.sqrt(np.diag(Q)) * rng.standard_normal(2)
        zero = np.zeros(1, dtype=int)
        d2.append(CandidatePairs.predict(np.zeros(3), landmark, P, z[None], Q, zero, zero).mahalanobis2()[0])
    assert 1.9 < np.mean(d2) < 2.1
    assert 0.03 < np.mean(np.array(d2) > chi2_quantile(0.95, 2)) < 0.07


@pytest.mark.parametrize(
    "bad", [{"rule": "guess"}, {"sensor_range": 0.0}, {"radius": -1.0}, {"confidence": 1.0}, {"starts": 0}]
)
def test_impossible_options_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError):
        MapAssociationConfig(**bad)
