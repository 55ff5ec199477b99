"""The door to a Dask cluster: opens where there is one, and says what is missing where there is none."""

from __future__ import annotations

import sys

import pytest

from graphslam.core.cluster import connect, require_distributed
from graphslam.core.errors import ConfigError, GraphSlamError


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(GraphSlamError, match=r"graphslam-submaps\[cluster\]"):
        require_distributed()
    with pytest.raises(GraphSlamError, match=r"graphslam-submaps\[cluster\]"):
        connect("127.0.0.1:1")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense://here"])
def test_nobody_there_is_an_error_that_names_the_address(address: str) -> None:
    with pytest.raises(ConfigError, match=address):
        connect(address, timeout=1.0)


def test_a_cluster_is_found_and_not_made_the_default() -> None:
    distributed = require_distributed()
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as local,
        connect(local.scheduler_address) as client,
    ):
        assert client.submit(sum, [1, 2, 3]).result() == 6
        assert client not in distributed.client._global_clients.values()
