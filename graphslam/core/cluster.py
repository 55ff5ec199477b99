"""Optional connection to a Dask cluster."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.extras import import_extra

_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx|inproc)://)?(\[[0-9a-fA-F:.%]+\]|[\w.-]+):\d{1,5}|inproc://[\w./-]+")

if TYPE_CHECKING:
    from distributed import Client


def check_address(address: str) -> None:
    """Refuse what cannot be the address of a scheduler; Dask itself waits for half a minute."""
    if not _ADDRESS.fullmatch(address):
        raise ConfigError(f"{address!r} is no address of a Dask scheduler; wanted host:port, as 10.0.0.1:8786")


def connect_cluster(address: str, *, timeout: float = 10.0) -> Client:
    """Connect to a running scheduler.

    Parameters
    ----------
    address : str
        Such as ``tcp://10.0.0.1:8786`` or ``10.0.0.1:8786``.
    timeout : float
        Seconds to wait for an answer.

    Returns
    -------
    distributed.Client
        Not the process-wide default client; a context manager that the caller closes.
    """
    distributed = import_extra("distributed", "a Dask cluster")
    check_address(address)
    try:
        client: Client = distributed.Client(address, timeout=timeout, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(f"no Dask scheduler answers at {address!r} ({error}); wanted host:port") from error
    return client


@contextmanager
def task_runner(workers: int | None = None, address: str | None = None) -> Iterator[Callable[..., list[Any]]]:
    """A task runner: ``run(work, [arguments, …])`` returns the results of the calls of ``work``, in order.

    Parameters
    ----------
    workers : int, optional
        Processes of a temporary Dask cluster; a process that dies is restarted, and its task repeated.
    address : str, optional
        Of a running scheduler. Without either, tasks run in this process, in sequence.
    """
    if workers is not None and (address is not None or workers < 1):
        raise ConfigError(f"{workers} workers and the cluster {address!r}; wanted one of them, and at least 1 worker")
    if workers is None and address is None:
        yield lambda work, tasks: [work(*task) for task in tasks]
        return
    distributed = import_extra("distributed", "a Dask cluster")

    def on(client: Client) -> Callable[..., list[Any]]:
        def run(work: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> list[Any]:
            futures = [client.submit(work, *task, pure=False) for task in tasks]
            try:
                return list(client.gather(futures))
            except distributed.KilledWorker as error:
                raise GraphSlamError(
                    f"workers died over the same task again and again ({error}); most often it needs more memory "
                    "than a worker has"
                ) from None

        return run

    if address is not None:
        with connect_cluster(address) as client:
            yield on(client)
        return
    with (
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield on(client)
