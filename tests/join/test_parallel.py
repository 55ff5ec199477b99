"""A tree of joins in one process, in a pool of processes and on a Dask cluster: the same bits."""

from __future__ import annotations

import math
import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from graphslam.core.cluster import connect_cluster
from graphslam.core.errors import ConfigError, CovarianceError, IndeterminateError
from graphslam.core.extras import import_extra
from graphslam.core.submap import Submap
from graphslam.join.association import MapAssociationConfig
from graphslam.join.joined_map import JoinedMap, JoinResult
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_tree
from graphslam_studies.sim.local_maps import simulate_local_maps


@pytest.fixture(scope="module")
def chain() -> list[Submap]:
    return simulate_local_maps(75, 3, scans=20)[0]


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Two workers, two processes."""
    with import_extra("distributed", "a Dask cluster").LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def assert_same(a: JoinResult, b: JoinResult) -> None:
    np.testing.assert_array_equal(a.vector, b.vector)
    np.testing.assert_array_equal(a.landmark_ids, b.landmark_ids)
    np.testing.assert_array_equal(a.information.indices, b.information.indices)
    np.testing.assert_array_equal(a.information.data, b.information.data)
    assert all(np.array_equal(i, j) for i, j in zip(a.submap_ids, b.submap_ids, strict=True))
    assert a.objective == b.objective


RULES = [None, MapAssociationConfig(rule="nearest", sensor_range=30.0)]


@pytest.mark.parametrize("association", RULES, ids=["ids", "recognised"])
def test_a_cluster_and_a_pool_give_the_same_bits(
    chain: list[Submap], scheduler: str, association: MapAssociationConfig | None
) -> None:
    alone = join_tree(chain, association=association)
    assert_same(join_tree(chain, association=association, executor=scheduler), alone)
    with connect_cluster(scheduler) as client:
        shared = join_tree(chain, association=association, executor=client)
        assert client.submit(math.sqrt, 4).result() == 2.0  # the caller's client is left open
    assert_same(shared, alone)
    assert all(shared.times[part] > 0.0 for part in ("association", "update", "recovery"))
    assert optimise_from_join(chain, shared).objective_polished == pytest.approx(
        optimise_from_join(chain, alone).objective_polished, rel=1e-9
    )


def test_processes_give_the_same_bits(chain: list[Submap]) -> None:
    assert_same(join_tree(chain, workers=2), join_tree(chain))


def test_an_error_in_a_worker_arrives(chain: list[Submap], scheduler: str, monkeypatch: pytest.MonkeyPatch) -> None:
    real = JoinedMap.leaves

    def spoiled(submaps, *, identified, classical):
        leaves, matrices = real(submaps, identified=identified, classical=classical)
        leaves[40].values *= -1.0
        return leaves, matrices

    monkeypatch.setattr(JoinedMap, "leaves", staticmethod(spoiled))
    with pytest.raises((IndeterminateError, CovarianceError), match="not positive definite"):
        join_tree(chain, executor=scheduler)


def test_impossible_workers_are_refused(chain: list[Submap]) -> None:
    with pytest.raises(ConfigError, match="0 workers"):
        join_tree(chain, workers=0)
    with pytest.raises(ConfigError, match="no address of a Dask scheduler"):
        join_tree(chain, executor="nonsense://here")


def test_a_joined_map_travels_without_its_factors(chain: list[Submap]) -> None:
    leaf = JoinedMap.leaf(chain[0], identified=True)
    block = leaf.covariance_block(np.arange(5))
    back = pickle.loads(pickle.dumps(leaf))
    assert back._factor is None
    assert leaf._factor is not None
    np.testing.assert_array_equal(back.covariance_block(np.arange(5)), block)
    joined = join_tree(chain)
    again = pickle.loads(pickle.dumps(joined))
    assert again.problem is None
    np.testing.assert_array_equal(again.vector, joined.vector)
    assert optimise_from_join(chain, again).objective_polished == pytest.approx(
        optimise_from_join(chain, joined).objective_polished, rel=1e-12
    )
