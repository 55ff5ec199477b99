"""The online joiner: at the optimum whenever it says so, and as the plain sequence where it never has a reason."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.submap import Submap
from graphslam.evaluate.consistency import joint_nees
from graphslam.join.association import MapAssociationConfig
from graphslam.join.joined_map import JoinedMapView
from graphslam.join.order import join_sequential
from graphslam.join.submap_solver import solve_submaps
from graphslam_studies.baselines.online import RelinearisationPolicy, join_online
from graphslam_studies.sim.local_maps import simulate_local_maps
from tests.reference.submap_chain import submap_chain

NEVER = RelinearisationPolicy(closure_gap=10**6, max_heading=math.inf)


@pytest.fixture
def chain(rng: np.random.Generator) -> list[Submap]:
    return submap_chain(rng, submaps=13, landmarks=45)[0]


def test_every_submap_is_the_batch_optimum_of_the_submaps_so_far(chain: list[Submap]) -> None:
    seen = []

    def on_join(k: int, view: JoinedMapView) -> None:
        best = solve_submaps(chain[: k + 1])
        np.testing.assert_allclose(view.x[view.landmark_at[:, None] + np.arange(2)], best.landmarks, atol=1e-6)
        np.testing.assert_allclose(view.pose(), best.poses[-1], atol=1e-6)
        np.testing.assert_allclose(view.pose_covariance(), best.pose_covariance(k + 1), rtol=1e-4, atol=1e-12)
        for block, j in zip(view.landmark_marginals(), view.ids):
            np.testing.assert_allclose(block, best.landmark_covariance(int(j)), rtol=1e-4, atol=1e-12)
        seen.append(k)

    joined = join_online(chain, policy=RelinearisationPolicy(every=1), on_join=on_join)
    assert seen == list(range(len(chain)))
    assert joined.converged
    assert joined.relinearisations["every"] == joined.relinearisations["all"] == len(chain) - 1
    assert joined.times["relinearisation"] > 0.0
    assert joined.objective == pytest.approx(solve_submaps(chain).objective, rel=1e-9)


def test_without_a_reason_it_is_the_sequence(chain: list[Submap]) -> None:
    joined, plain = join_online(chain, policy=NEVER), join_sequential(chain)
    np.testing.assert_array_equal(joined.vector, plain.vector)
    assert joined.relinearisations == {"every": 0, "closure": 0, "heading": 0, "all": 0}
    assert not joined.converged
    assert "relinearisation" not in joined.times


def test_reasons_are_distinguished(chain: list[Submap]) -> None:
    last: dict[int, int] = {}
    closures = 0
    gap = 4
    for k, s in enumerate(chain):
        ids = [int(j) for j in s.landmarks.ids]
        closures += any(last.get(j, k) < k - gap for j in ids)
        last |= dict.fromkeys(ids, k)
    assert closures > 0
    only = join_online(chain, policy=RelinearisationPolicy(closure_gap=gap, max_heading=math.inf))
    assert only.relinearisations == {"every": 0, "closure": closures, "heading": 0, "all": closures}
    bent = join_online(chain, policy=RelinearisationPolicy(closure_gap=10**6, max_heading=1e-4))
    assert bent.relinearisations["closure"] == 0
    assert 0 < bent.relinearisations["heading"] == bent.relinearisations["all"] < len(chain)
    third = join_online(chain, policy=RelinearisationPolicy(closure_gap=10**6, max_heading=math.inf, every=3))
    assert third.relinearisations["every"] == third.relinearisations["all"] == (len(chain) - 1) // 3


def test_headings_stay_near_their_linearisation(chain: list[Submap]) -> None:
    """Where a heading has moved further than the policy allows, the map stands at its optimum; elsewhere none has."""
    limit = math.radians(0.05)
    used: list[float] = []
    arrived, optimal = [0.0], []

    def on_join(k: int, view: JoinedMapView) -> None:
        headings = view.x[view.pose_at + 2]
        if k:
            used.append(arrived[-1])
            off = np.abs(np.angle(np.exp(1j * (headings[:-1] - np.array(used)))))
            if off.max() > limit:
                np.testing.assert_allclose(view.pose(), solve_submaps(chain[: k + 1]).poses[-1], atol=1e-6)
                optimal.append(k)
                used[:] = headings[:-1]
        arrived.append(float(headings[-1]))

    policy = RelinearisationPolicy(closure_gap=10**6, max_heading=limit)
    joined = join_online(chain, policy=policy, on_join=on_join)
    assert 0 < len(optimal) < len(chain) - 1
    assert len(optimal) <= joined.relinearisations["heading"] == joined.relinearisations["all"]


def test_recognised_landmarks_of_a_relinearised_map(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=20, landmarks=60)
    nobody = [s.with_ids(np.full(len(s.landmarks), -1)) for s in submaps]
    joined = join_online(
        nobody, association=MapAssociationConfig(rule="joint", sensor_range=14.0), policy=RelinearisationPolicy(every=1)
    )
    by_name = join_online(submaps, policy=RelinearisationPolicy(every=1))
    assert len(joined.landmark_ids) == pytest.approx(len(by_name.landmark_ids), abs=2)
    a = np.concatenate([s.landmarks.ids for s in submaps])
    b = np.concatenate(joined.submap_ids)
    if len(np.unique(np.column_stack([a, b]), axis=0)) == len(np.unique(a)) == len(np.unique(b)):
        np.testing.assert_allclose(joined.poses, by_name.poses, atol=1e-6)


def test_a_landmark_that_stands_twice_in_a_submap(chain: list[Submap]) -> None:
    old, new = (int(i) for i in chain[4].landmarks.ids[:2])
    twice = [s.with_ids(np.where(s.landmarks.ids == old, new, s.landmarks.ids)) for s in chain]
    joined = join_online(twice, policy=RelinearisationPolicy(every=1, rtol=1e-13))
    best = solve_submaps(twice)
    np.testing.assert_allclose(joined.landmarks, best.landmarks, atol=1e-5)
    assert joined.objective == pytest.approx(best.objective, rel=1e-6)


def test_the_default_policy_keeps_the_map_consistent_over_a_closure() -> None:
    """Two laps with the stated noise: once linearised the map believes in its errors, relinearised it does not."""
    ratios = {"once": [], "online": []}
    for seed in range(4):
        submaps, truth = simulate_local_maps(40, seed)
        at_truth = {int(j): p for j, p in zip(truth.landmark_ids, truth.landmarks)}
        for name, joined in (("once", join_sequential(submaps)), ("online", join_online(submaps))):
            error = np.array([at_truth[int(j)] for j in joined.landmark_ids]) - joined.landmarks
            ix = np.arange(3 * len(submaps), joined.states)
            P = joined.covariance_block(ix)
            ratios[name].append(joint_nees(error.ravel(), covariance=P) / error.size)
    assert 0.85 < np.mean(ratios["online"]) < 1.15
    assert np.mean(ratios["online"]) < np.mean(ratios["once"])


@pytest.mark.parametrize("bad", [{"closure_gap": 0}, {"every": -1}, {"max_heading": 0.0}, {"rtol": 0.0}])
def test_impossible_policies_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError, match="relinearisation"):
        RelinearisationPolicy(**bad)
