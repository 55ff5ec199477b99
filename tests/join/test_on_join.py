"""What a caller sees of the map after every submap: the same in information and in covariance form."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.submap import Submap
from graphslam.join.association import MapAssociationConfig
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinedMapView
from graphslam.join.order import join_sequential
from tests.reference.submap_chain import submap_chain

ONE_BY_ONE = [join_sequential, join_ekf]


@pytest.fixture
def chain(rng: np.random.Generator) -> list[Submap]:
    return submap_chain(rng, submaps=11, landmarks=40)[0]


@pytest.mark.parametrize("join", ONE_BY_ONE)
def test_the_view_after_submap_k_is_the_join_of_the_first_k(join, chain: list[Submap]) -> None:
    seen: list[int] = []

    def on_join(k: int, view: JoinedMapView) -> None:
        seen.append(k)
        whole = join(chain[: k + 1])
        np.testing.assert_array_equal(view.ids, whole.landmark_ids)
        np.testing.assert_allclose(view.pose(), whole.poses[-1], atol=1e-9)
        np.testing.assert_allclose(view.x[view.landmark_at[:, None] + np.arange(2)], whole.landmarks, atol=1e-9)
        np.testing.assert_allclose(view.pose_covariance(), whole.pose_covariance(k + 1), rtol=1e-6, atol=1e-14)
        marginals = view.landmark_marginals()
        assert marginals.shape == (len(view.ids), 2, 2)
        for i, block in zip(whole.landmark_ids, marginals):
            np.testing.assert_allclose(block, whole.landmark_covariance(int(i)), rtol=1e-6, atol=1e-14)
        assert [len(e) for e in view.entries] == [len(s.landmarks) for s in chain[: k + 1]]
        for entry, s in zip(view.entries, chain):
            np.testing.assert_array_equal(view.ids[entry], s.landmarks.ids)

    join(chain, on_join=on_join)
    assert seen == list(range(len(chain)))


def test_both_forms_tell_the_same_at_every_submap(chain: list[Submap]) -> None:
    estimates: dict[str, list[np.ndarray]] = {"eif": [], "ekf": []}
    for name, join in (("eif", join_sequential), ("ekf", join_ekf)):

        def on_join(k: int, view: JoinedMapView, name: str = name) -> None:
            estimates[name].append(
                np.concatenate([view.pose(), view.pose_covariance().ravel(), view.landmark_marginals().ravel()])
            )

        join(chain, on_join=on_join)
    for a, b in zip(estimates["eif"], estimates["ekf"], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("join", ONE_BY_ONE)
def test_watching_changes_nothing(join, chain: list[Submap]) -> None:
    watched = join(chain, on_join=lambda k, view: view.landmark_marginals())
    np.testing.assert_array_equal(watched.vector, join(chain).vector)


@pytest.mark.parametrize("join", ONE_BY_ONE)
def test_recognised_landmarks_have_no_id_in_the_view(join, chain: list[Submap]) -> None:
    counts: list[int] = []

    def on_join(k: int, view: JoinedMapView) -> None:
        assert np.all(view.ids == -1)
        assert len(view.ids) == len(view.landmark_at) == 1 + max(e.max() for e in view.entries)
        counts.append(len(view.ids))

    joined = join(chain, association=MapAssociationConfig(rule="nearest", sensor_range=14.0), on_join=on_join)
    assert counts[-1] == len(joined.landmark_ids) == len(np.unique(joined.landmark_ids))
