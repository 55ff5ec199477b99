"""Loops against each other: equal to a slow twin that composes poses, consistent by sampling; a false loop is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_adjoint, se2_between, se2_compose, se2_exp, se2_inverse, se2_log, se2_transform
from graphslam.core.submap import LandmarkMap, Match, Submap
from graphslam.evaluate.loop_consistency import find_landmark_loops, loop_consistency
from graphslam.join.submap_solver import solve_submaps
from tests.reference.submap_chain import submap_chain


def loop_chain(rng: np.random.Generator, **options) -> tuple[list[Submap], np.ndarray]:
    """Submaps of which many share landmarks, and their true poses."""
    chain, truth = submap_chain(rng, **{"reach": 20.0, "landmarks": 60, **options})
    return chain, np.vstack([np.zeros((1, 3)), truth.exit_poses])


def slow_alignment(a: LandmarkMap, b: LandmarkMap) -> np.ndarray:
    """``T_ab`` by the landmarks that both hold: weighted least squares, iterated to the end."""
    common = [i for i in a.ids if i in b.ids]
    ia = np.array([list(a.ids).index(i) for i in common])
    ib = np.array([list(b.ids).index(i) for i in common])
    za, zb = a.positions[ia], b.positions[ib]
    ca, cb = ((3 + 2 * i[:, None] + np.arange(2)).ravel() for i in (ia, ib))
    start = np.linalg.svd((zb - zb.mean(0)).T @ (za - za.mean(0)))
    R = start[2].T @ np.diag([1, np.linalg.det(start[2].T @ start[0].T)]) @ start[0].T
    T = np.array([*(za.mean(0) - R @ zb.mean(0)), np.arctan2(R[1, 0], R[0, 0])])
    for _ in range(20):
        c, s = np.cos(T[2]), np.sin(T[2])
        R = np.array([[c, -s], [s, c]])
        turn = np.kron(np.eye(len(common)), R)
        S = a.covariance[np.ix_(ca, ca)] + turn @ b.covariance[np.ix_(cb, cb)] @ turn.T
        J = np.vstack([np.column_stack([R, R @ np.array([-p[1], p[0]])]) for p in zb])
        r = (za - se2_transform(T, zb)).ravel()
        T = se2_compose(T, se2_exp(np.linalg.solve(J.T @ np.linalg.solve(S, J), J.T @ np.linalg.solve(S, r))))
    return T


def slow_cycle(chain: list[Submap], X: np.ndarray, a: int, b: int) -> np.ndarray:
    """Error of the cycle a → b by the loop, back by the chain; nonlinear, then told in world coordinates."""
    T = np.zeros(3)
    for k in range(a, b):
        T = se2_compose(T, chain[k].landmarks.exit_pose)
    C = se2_compose(se2_inverse(T), slow_alignment(chain[a].landmarks, chain[b].landmarks))
    return se2_adjoint(X[b]) @ se2_log(C)


def drawn(chain: list[Submap], rng: np.random.Generator, scale: float) -> list[Submap]:
    """The same submaps with noise of ``scale`` times what they claim on top."""
    out = []
    for s in chain:
        lm = s.landmarks
        z = lm.mean + scale * np.linalg.cholesky(lm.covariance) @ rng.standard_normal(len(lm.mean))
        fresh = replace(lm, exit_pose=z[:3], positions=z[3:].reshape(-1, 2))
        out.append(Submap.from_landmarks(s.key, fresh))
    return out


def test_errors_equal_composed_poses(rng):
    chain, X = loop_chain(rng, sigma=1e-3, sigma_heading=1e-4)
    loops = find_landmark_loops(chain, X)
    assert len(loops) > 20
    for k in range(0, len(loops), 3):
        slow = slow_cycle(chain, X, loops.a[k], loops.b[k])
        assert np.allclose(loops.errors[k], slow, atol=2e-2 * np.sqrt(np.diag(loops.covariance)[3 * k : 3 * k + 3]))
        common = set(chain[loops.a[k]].landmarks.ids) & set(chain[loops.b[k]].landmarks.ids)
        assert loops.shared[k] == len(common) >= 2
        assert loops.shape_dof[k] == 2 * len(common) - 3


def test_joint_covariance_is_that_of_a_sample_of_composed_poses(rng):
    chain, X = loop_chain(rng, sigma=2e-3, sigma_heading=2e-4, submaps=9, landmarks=25, reach=25.0)
    clean = drawn(chain, rng, 0.0)
    loops = find_landmark_loops(clean, X)
    some = np.array([0, len(loops) // 2, len(loops) - 1])
    sample = []
    for _ in range(300):
        noisy = drawn(clean, rng, 1.0)
        sample.append(np.concatenate([slow_cycle(noisy, X, loops.a[k], loops.b[k]) for k in some]))
    ix = (3 * some[:, None] + np.arange(3)).ravel()
    want, got = loops.covariance[np.ix_(ix, ix)], np.cov(np.array(sample).T)
    sd = np.sqrt(np.diag(want))
    assert np.abs((got - want) / np.outer(sd, sd)).max() < 0.25
    # and the pair statistic is χ² of three degrees of freedom
    e = np.array(sample)[:, :3] - np.array(sample)[:, 3:6]
    C = want[:3, :3] + want[3:6, 3:6] - want[:3, 3:6] - want[3:6, :3]
    e = e - e.mean(axis=0)
    assert np.mean(np.einsum("ti,ij,tj->t", e, np.linalg.inv(C), e)) == pytest.approx(3.0, rel=0.15)


def test_matrix_equals_one_pair_at_a_time(rng):
    chain, X = loop_chain(rng)
    loops = find_landmark_loops(chain, X, min_gap=2)
    got = loop_consistency(loops)
    S = loops.covariance
    for i in range(0, len(loops), 5):
        assert got.single[i] == pytest.approx(
            loops.errors[i] @ np.linalg.solve(S[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], loops.errors[i])
        )
        for j in range(1, len(loops), 4):
            if i == j:
                continue
            D = np.zeros((3, len(S)))
            D[:, 3 * i : 3 * i + 3], D[:, 3 * j : 3 * j + 3] = np.eye(3), -np.eye(3)
            e = loops.errors[i] - loops.errors[j]
            assert got.d2[i, j] == pytest.approx(e @ np.linalg.solve(D @ S @ D.T, e), rel=1e-5)
            assert got.d2[j, i] == got.d2[i, j]
    assert len(got.table()) == len(loops)


@pytest.mark.parametrize(("claimed", "verdict"), [(1.0, "consistent"), (0.25, "overconfident"), (4.0, "conservative")])
def test_alarm_fires_for_half_and_double_noise_and_is_silent_else(claimed, verdict):
    verdicts, values, inside, shape = [], [], [], []
    for seed in range(20):
        chain, _ = loop_chain(np.random.default_rng(seed), claimed=claimed)
        loops = find_landmark_loops(chain, solve_submaps(chain).poses)
        test = loop_consistency(loops).test()
        verdicts.append(test["verdict"])
        values.append(test["value"])
        inside.append(test["inside"])
        shape.append(test["shape"])
    # 20 verdicts at 95 %: more than 4 false ones have a probability of 0.003
    assert verdicts.count(verdict) >= (16 if claimed == 1.0 else 19), (verdicts, values)
    assert np.mean(values) == pytest.approx(1 / claimed, rel=0.15)
    assert np.mean(shape) == pytest.approx(1 / claimed, rel=0.1)
    if claimed == 1.0:
        assert 0.93 < np.mean(inside) < 0.97


def test_a_scale_of_the_covariance_is_one_of_the_squares(rng):
    chain, X = loop_chain(rng)
    one, five = (loop_consistency(find_landmark_loops(chain, X, covariance_scale=s)) for s in (1.0, 5.0))
    assert np.allclose(one.d2, 5.0 * five.d2, rtol=1e-6)
    assert one.test()["dof"] == pytest.approx(five.test()["dof"])


def test_a_false_loop_disagrees_with_the_others_and_is_named(rng):
    """Two submaps far apart are told that two of their landmarks are the same pair; nobody else believes it."""
    chain, X = loop_chain(rng, submaps=20, landmarks=90)
    ids = [s.landmarks.ids.copy() for s in chain]
    assert not set(ids[2]) & set(ids[8])
    ids[8][:2] = ids[2][:2]
    consistent = loop_consistency(find_landmark_loops(chain, X))
    assert consistent.blame().max() < 0.5
    got = loop_consistency(find_landmark_loops(chain, X, ids=ids))
    # the pair also turns up between these submaps' neighbours; the loop 2–8 is the false one of all
    k = int(np.flatnonzero((got.loops.a == 2) & (got.loops.b == 8))[0])
    assert got.blame()[k] > 0.9
    false = np.flatnonzero(got.blame() > 0.5)
    assert {(int(got.loops.a[i]), int(got.loops.b[i])) for i in false} >= {(2, 8)}
    assert all(8 in (got.loops.a[i], got.loops.b[i]) for i in false)  # all that are blamed hang on the false names
    assert got.test()["verdict"] == "overconfident"


def test_matches_of_a_front_end_are_loops(rng):
    chain, X = loop_chain(rng, landmarks=60)
    bare = [
        Submap(key=s.key, interval=s.interval, exit_pose=s.exit_pose, exit_covariance=s.exit_covariance) for s in chain
    ]
    C = np.diag([0.02, 0.02, 0.002]) ** 2

    def match(target, here, error):
        T = se2_compose(se2_between(X[target], X[here]), se2_exp(np.asarray(error)))
        return Match(target=target, T_target_here=T, covariance=C, fitness=1.0, support=1.0)

    bare[6] = replace(bare[6], matches=(match(0, 6, [0.0, 0.0, 0.0]), match(1, 6, [0.01, 0.0, 0.0])))
    bare[9] = replace(bare[9], matches=(match(0, 9, [3.0, 0.0, 0.5]), replace(match(0, 9, [0.0, 0.0, 0.0]), target=77)))
    loops = find_landmark_loops(bare, X)
    assert list(zip(loops.a, loops.b)) == [(0, 6), (1, 6), (0, 9)]  # submap 77 is nowhere
    got = loop_consistency(loops)
    assert np.argmax(got.blame()) == 2
    assert got.d2[0, 1] < 12.0 < got.d2[0, 2]
    # by hand: the loop's own noise and the six exits between
    S = se2_adjoint(X[6]) @ C @ se2_adjoint(X[6]).T
    for k in range(6):
        S = S + se2_adjoint(X[k + 1]) @ bare[k].exit_covariance @ se2_adjoint(X[k + 1]).T
    assert np.allclose(loops.covariance[:3, :3], S, rtol=2e-2, atol=1e-9)


def test_few_are_chosen_evenly_and_the_rest_is_counted(rng):
    chain, X = loop_chain(rng)
    everything, some = find_landmark_loops(chain, X), find_landmark_loops(chain, X, max_loops=10)
    assert len(some) <= 10
    assert some.left_out == len(everything) - len(some)
    pairs = set(zip(everything.a.tolist(), everything.b.tolist()))
    assert set(zip(some.a.tolist(), some.b.tolist())) < pairs
    far = find_landmark_loops(chain, X, min_gap=4)
    assert np.all(far.b - far.a >= 4)


def test_impossible_questions_are_refused(rng):
    chain, X = loop_chain(rng, submaps=4, laps=0.3)
    with pytest.raises(DataError, match="poses do not fit"):
        find_landmark_loops(chain, X[:-1])
    with pytest.raises(DataError, match="two shared landmarks"):
        find_landmark_loops(chain, X, min_shared=1)
    with pytest.raises(DataError, match="no loops"):
        find_landmark_loops(chain, X, ids=[np.full(len(s.landmarks), -1) for s in chain])
    lm = chain[1].landmarks
    same = replace(lm, positions=np.tile(lm.positions[:1], (len(lm), 1)))  # all landmarks at one point: no heading
    with_same = [chain[0], Submap.from_landmarks(1, same), *chain[2:]]
    assert find_landmark_loops(with_same, X).skipped >= 1
    close = lm.positions[:1] + rng.normal(0.0, 0.01, lm.positions.shape)  # closer than their σ: still no heading
    with_close = [chain[0], Submap.from_landmarks(1, replace(lm, positions=close)), *chain[2:]]
    assert find_landmark_loops(with_close, X).skipped >= 1
