"""The door to a Dask cluster: opens where there is one, and says what is missing where there is none."""

from __future__ import annotations

import math
import os

import pytest

from graphslam.core.cluster import check_address, connect_cluster, task_runner
from graphslam.core.errors import ConfigError


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense://here"])
def test_nobody_there_is_an_error_that_names_the_address(address: str) -> None:
    with pytest.raises(ConfigError, match=address):
        connect_cluster(address, timeout=1.0)


@pytest.mark.parametrize("address", ["", "x y z", "host", "host:port", "tcp://", "10.0.0.1:8786; x"])
def test_what_is_no_address_is_refused_at_once(address: str) -> None:
    with pytest.raises(ConfigError, match="is no address of a Dask scheduler; wanted host:port"):
        check_address(address)
    for known in ("10.0.0.1:8786", "tcp://node-1.local:8786", "tls://[::1]:8786"):
        check_address(known)


def test_a_cluster_is_found_and_not_made_the_default() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as local,
        connect_cluster(local.scheduler_address) as client,
    ):
        assert client.submit(sum, [1, 2, 3]).result() == 6
        assert client not in distributed.client._global_clients.values()


def test_tasks_run_here_or_in_processes_of_their_own() -> None:
    with task_runner() as run:
        assert run(math.hypot, [(3, 4), (5, 12)]) == [5.0, 13.0]
        assert run(os.getpid, [()]) == [os.getpid()]
    with task_runner(workers=1) as run:
        assert run(math.hypot, [(3, 4), (5, 12)]) == [5.0, 13.0]
        assert run(os.getpid, [()]) != [os.getpid()]
        with pytest.raises(ValueError, match="domain"):
            run(math.sqrt, [(-1,)])
    for wrong in ({"workers": 0}, {"workers": 2, "address": "127.0.0.1:1"}):
        with pytest.raises(ConfigError, match="at least 1 worker"), task_runner(**wrong):
            pass
