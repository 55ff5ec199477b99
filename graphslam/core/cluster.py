"""A connection to a Dask cluster, where one is wanted: the package itself needs none."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from graphslam.core.errors import ConfigError, GraphSlamError

if TYPE_CHECKING:
    from distributed import Client


def require_distributed() -> ModuleType:
    """Import ``distributed`` (Dask's scheduler, BSD).

    Raises
    ------
    GraphSlamError
        If it is not installed; names the extra that brings it.
    """
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise GraphSlamError(
            f"a Dask cluster needs the package distributed ({error}); pip install 'graphslam-submaps[cluster]'"
        ) from error


def connect(address: str, *, timeout: float = 10.0) -> Client:
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

    Raises
    ------
    GraphSlamError
        If ``distributed`` is not installed.
    ConfigError
        If nobody answers at the address, or it is not one.
    """
    distributed = require_distributed()
    try:
        client: Client = distributed.Client(address, timeout=timeout, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(f"no Dask scheduler answers at {address!r} ({error}); wanted host:port") from error
    return client
