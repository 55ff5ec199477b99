"""Association with joint covariances, its kernel against an obvious twin, and merging."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.association.compatibility import search_compatible_sets
from graphslam.association.landmarks import AssociationConfig, CompatiblePairings, associate_landmarks, find_pairings
from graphslam.association.merging import euclidean_merges, mahalanobis_merges
from graphslam.core.errors import ConfigError
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.solve.batch import BatchSolver
from tests.reference.graph_chain import anonymous, dense_submap, make_chain
from tests.reference.submap_model import predict_submap

JC, NN = AssociationConfig(), AssociationConfig(method="nearest-neighbour")


@pytest.mark.parametrize("config", [JC, NN], ids=["jc", "nn"])
def test_whole_chain_is_identified(rng, config):
    chain = make_chain(rng, m=16, landmarks=25, laps=2.0)
    g = FactorGraph()
    solver = BatchSolver(g)
    name: dict[int, int] = {}  # ours -> true
    wrong = split = 0
    for s in chain.submaps:
        ids = associate_landmarks(g, anonymous(s), config)
        assert len(set(ids[ids >= 0].tolist())) == np.sum(ids >= 0)
        g.add_submap(anonymous(s), landmark_ids=ids)
        solver.update()
        for ours, true in zip(g.landmark_ids_of(s.key).tolist(), s.landmarks.ids.tolist()):
            split += ours not in name and true in name.values()
            wrong += name.setdefault(ours, true) != true
    assert wrong == 0
    assert split <= 2


def drifted_graph(rng, shift: np.ndarray, points: np.ndarray) -> tuple[FactorGraph, Submap]:
    """A map of ``points``, then a long uncertain leg that comes back to its start, off by ``shift``."""
    g = FactorGraph()
    n = len(points)
    P = 0.02**2 * np.eye(3 + 2 * n)
    first = LandmarkMap(ids=np.arange(n), exit_pose=np.array([5.0, 0, 0]), positions=points, covariance=P)
    g.add_submap(Submap.from_landmarks(0, first))
    g.add_submap(dense_submap(1, np.array([-5.0, 0, 0]) + shift, np.diag([2.0**2, 2.0**2, 0.05**2])))
    seen = predict_submap(np.zeros(3), np.array([3.0, 0, 0.2]), points)  # the truth is back at the start
    again = LandmarkMap(ids=np.full(n, -1), exit_pose=seen[:3], positions=seen[3:].reshape(-1, 2), covariance=P)
    return g, Submap.from_landmarks(2, again)


def test_joint_test_closes_a_loop_that_nearest_neighbour_gets_wrong(rng):
    """All predictions are off by the same 2.5 m; trees stand about as close: only a joint test can tell."""
    x, y = np.meshgrid(np.arange(5) * 3.0, np.arange(3) * 3.0)
    points = np.stack([x.ravel(), y.ravel()], -1) + rng.uniform(-0.8, 0.8, (15, 2))
    g, submap = drifted_graph(rng, np.array([2.5, 0.3, 0.03]), points)
    truth = np.arange(15)
    np.testing.assert_array_equal(associate_landmarks(g, submap, JC), truth)
    nearest = associate_landmarks(g, submap, NN)
    assert np.sum((nearest >= 0) & (nearest != truth)) >= 3


def test_gate_covers_what_it_should(rng):
    """Innovations of true pairings follow their claimed joint covariance (Monte Carlo)."""
    d2, n2 = [], []
    for _ in range(150):
        chain = make_chain(rng, m=3, landmarks=6, reach=60.0, sigma=0.02)
        g = FactorGraph()
        for s in chain.submaps[:2]:
            g.add_submap(s)
        BatchSolver(g).update()
        wide = AssociationConfig(gate=1e9, max_distance=100.0)
        p = find_pairings(g, anonymous(chain.submaps[2]), np.arange(6), wide)
        true = np.flatnonzero(g.values.landmark_ids[p.target] == chain.submaps[2].landmarks.ids[p.observed])
        c = (2 * true[:, None] + np.arange(2)).ravel()
        nu = p.innovation[true].ravel()
        d2.append(nu @ np.linalg.solve(p.covariance[np.ix_(c, c)], nu) / len(nu))
        n2.append(np.mean(p.distance2()[true]) / 2)
    assert 0.9 < np.mean(d2) < 1.1  # three standard errors of 1800 scalars
    assert 0.8 < np.mean(n2) < 1.2  # individually they share the pose's error, so fewer count


def slow_search(
    p: CompatiblePairings, seed: int, gate: float, limit: np.ndarray, *, persistent: bool
) -> tuple[list[int], float, float]:
    """The greedy search by explicit conditioning with inverses: pairings, score, cost."""

    def conditional(k: int, paired: list[int]) -> tuple[float, float]:
        a = np.array([2 * k, 2 * k + 1])
        nu, C = p.innovation.ravel(), p.covariance
        if not paired:
            v, S = nu[a], C[np.ix_(a, a)]
        else:
            b = np.concatenate([[2 * t, 2 * t + 1] for t in paired])
            K = C[np.ix_(a, b)] @ np.linalg.inv(C[np.ix_(b, b)])
            v, S = nu[a] - K @ nu[b], C[np.ix_(a, a)] - K @ C[np.ix_(b, a)]
        return float(v @ np.linalg.inv(S) @ v), float(np.log(np.linalg.det(S)))

    paired, total, pick = [], 0.0, seed
    score = cost = 0.0
    while True:
        d2, volume = conditional(pick, paired)
        if total + d2 > limit[len(paired) + 1]:
            return paired, score, cost
        total, score, cost = total + d2, score + gate - d2, cost + d2 + volume
        paired.append(pick)
        best = (np.inf, -1)
        for k in range(len(p.observed)):
            if any(p.observed[k] == p.observed[t] or p.target[k] == p.target[t] for t in paired):
                continue
            e2, logdet = conditional(k, paired)
            if e2 <= gate and not (persistent and total + e2 > limit[len(paired) + 1]):
                best = min(best, (e2 + logdet, k))
        if best[1] < 0:
            return paired, score, cost
        pick = best[1]


def random_pairings(rng: np.random.Generator, observed: int, known: int) -> CompatiblePairings:
    """Every pair of some observations and landmarks, with covariances of very different sizes."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(observed), np.arange(known), indexing="ij"))
    n = 2 * len(i)
    A = np.exp(rng.uniform(-1.5, 1.5, len(i))).repeat(2)[:, None] * (
        np.eye(n) + rng.standard_normal((n, n)) / np.sqrt(n)
    )
    C = A @ A.T
    nu = 0.6 * np.linalg.cholesky(C) @ rng.standard_normal(n)
    return CompatiblePairings(i.astype(np.int64), j.astype(np.int64), nu.reshape(-1, 2), C)


@pytest.mark.parametrize("persistent", [False, True])
def test_search_is_its_slow_twin(rng, persistent):
    cases = [random_pairings(rng, 5, 5) for _ in range(4)]
    for _ in range(3):
        x, y = np.meshgrid(np.arange(4) * 2.0, np.arange(2) * 2.0)
        points = np.stack([x.ravel(), y.ravel()], -1) + rng.uniform(-0.5, 0.5, (8, 2))
        g, submap = drifted_graph(rng, np.array([1.2, -0.4, 0.02]), points)
        cases.append(find_pairings(g, submap, np.arange(8), JC))
    differ = 0
    for p in cases:
        assert len(p.observed) > 15
        limit = np.array([np.inf, 11.8, *np.linspace(1.5, 3.0, 7)])
        seeds = np.arange(len(p.observed))
        found = search_compatible_sets(
            p.observed, p.target, p.innovation, p.covariance, seeds, 11.8, limit, persistent=persistent
        )
        for s in seeds:
            paired, value, cost = slow_search(p, int(s), 11.8, limit, persistent=persistent)
            assert found.of(s).tolist() == paired
            assert found.score[s] == pytest.approx(value, abs=1e-6)
            assert found.cost[s] == pytest.approx(cost, abs=1e-6)
            differ += len(slow_search(p, int(s), 11.8, limit, persistent=not persistent)[0]) != len(paired)
    assert differ > 0  # the limits are tight enough for persistence to matter


def test_nothing_is_matched_where_nothing_is(rng):
    chain = make_chain(rng, m=2, landmarks=10, reach=50.0)
    g = FactorGraph()
    assert np.all(associate_landmarks(g, anonymous(chain.submaps[0])) == -1)  # an empty graph
    g.add_submap(chain.submaps[0])
    s = anonymous(chain.submaps[1])
    far = LandmarkMap(
        ids=s.landmarks.ids,
        exit_pose=s.landmarks.exit_pose,
        positions=s.landmarks.positions + 200.0,
        covariance=s.landmarks.covariance,
    )
    assert np.all(associate_landmarks(g, Submap.from_landmarks(1, far)) == -1)
    assert len(associate_landmarks(g, dense_submap(1, np.zeros(3), np.eye(3)))) == 0


def test_known_ids_stay_and_are_not_given_again(rng):
    chain = make_chain(rng, m=2, landmarks=10, reach=50.0)
    g = FactorGraph()
    g.add_submap(chain.submaps[0])
    ids = np.full(10, -1)
    ids[3] = 7  # the front end is (wrongly) sure of this one
    got = associate_landmarks(g, chain.submaps[1].with_ids(ids))
    assert got[3] == 7
    assert np.sum(got == 7) == 1


@pytest.mark.parametrize("options", [{"method": "magic"}, {"gate": 0.0}, {"starts": 0}, {"joint_probability": 1.0}])
def test_bad_options_are_refused(options):
    with pytest.raises(ConfigError):
        AssociationConfig(**options)


# ------------------------------------------------------------------ merging


def split_graph(rng) -> tuple[FactorGraph, dict[int, int]]:
    """Two laps whose second lap knows nothing of the first: every landmark is there twice."""
    chain = make_chain(rng, m=16, landmarks=20, laps=2.0, sigma=0.02)
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(s, landmark_ids=s.landmarks.ids + (100 if s.key >= 8 else 0))
    BatchSolver(g).update()
    return g, {i: i % 100 for i in g.values.landmark_ids.tolist()}


def test_mahalanobis_merge_finds_the_twins_and_no_others(rng):
    g, truth = split_graph(rng)
    merges = mahalanobis_merges(g)
    assert len(merges) >= 10
    assert all(truth[a] == truth[b] for a, b in merges)
    for keep, drop in merges:
        g.merge_landmarks(keep, drop)
    BatchSolver(g).update()
    assert g.objective()["submap"].chi2_per_dof < 1.3


def test_only_the_euclidean_merge_repairs_a_duplicate_inside_a_submap(rng):
    points = np.array([[2.0, 0.0], [2.3, 0.1], [6.0, 1.0]])
    lm = LandmarkMap(ids=np.full(3, -1), exit_pose=np.array([4.0, 0, 0]), positions=points, covariance=1e-2 * np.eye(9))
    g = FactorGraph()
    g.add_submap(Submap.from_landmarks(0, lm))
    assert mahalanobis_merges(g) == []
    assert euclidean_merges(g, within_submap=False) == []
    assert euclidean_merges(g, 0.2) == []
    assert euclidean_merges(g, 0.7) == [(0, 1)]
    g.merge_landmarks(0, 1)
    BatchSolver(g).update()
    np.testing.assert_allclose(g.landmark(0), [2.15, 0.05], atol=1e-9)  # the id stands twice and both count
    np.testing.assert_allclose(g.covariance().marginal("l0"), 0.5e-2 * np.eye(2), atol=1e-12)


def test_a_row_of_near_ones_does_not_collapse(rng):
    points = np.stack([np.arange(6) * 0.5, np.zeros(6)], -1)
    lm = LandmarkMap(ids=np.full(6, -1), exit_pose=np.zeros(3), positions=points, covariance=1e-2 * np.eye(15))
    g = FactorGraph()
    g.add_submap(Submap.from_landmarks(0, lm))
    merges = euclidean_merges(g, 0.7)
    assert 2 <= len(merges) <= 4
    for keep, drop in merges:
        assert np.linalg.norm(points[keep] - points[drop]) <= 0.7
        g.merge_landmarks(keep, drop)


def test_merging_prefers_the_one_seen_more_often(rng):
    chain = make_chain(rng, m=3, landmarks=5, reach=60.0, noise=0.0)
    g = FactorGraph()
    for s in chain.submaps:
        ids = s.landmarks.ids + (50 if s.key == 0 else 0)
        g.add_submap(s, landmark_ids=ids)
    assert sorted(euclidean_merges(g, 0.5)) == [(i, i + 50) for i in range(5)]
