"""What every front end is: sensor data in, submaps out, one at a time, resumable at submap granularity."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap


@runtime_checkable
class FrontEnd(Protocol):
    """A front end registered under the entry point ``graphslam.frontends``.

    A front end is built from its configuration alone. Everything it draws comes from ``seed.child(key of the submap)``
    and a submap depends on nothing but the log and the end of the one before, so that a run resumed after submap k is
    the run that was never stopped.
    """

    name: str
    config: Any

    def submaps(
        self, log: SensorLog, *, seed: SeedTree, after: Submap | None = None, drops: DropCounter | None = None
    ) -> Iterator[Submap]:
        """Yield submaps in order.

        Parameters
        ----------
        after : Submap or None
            The last submap that is already there; the next one starts at its end.
        drops : DropCounter or None
            Where records that are not used are counted.
        """
        ...
