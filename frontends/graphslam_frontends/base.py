"""What every front end is: sensor data in, submaps out, one at a time, resumable at submap granularity."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LandmarkObservations
from graphslam.core.submap import Submap
from graphslam_frontends.odometry.steps import Steps

Watch: TypeAlias = Callable[[Any], None]
"""Takes the progress of a front end, of its own kind (``segslam``:
`graphslam_frontends.segslam.progress.SegSlamProgress`)."""


@runtime_checkable
class FrontEnd(Protocol):
    """A front end registered under the entry point ``graphslam.frontends``.

    Classes inherit from it. A front end is built from its configuration alone. Everything it draws comes from
    ``seed.child(key of the submap)`` and a submap depends on nothing but the log and the end of the one before, so that
    a run resumed after submap k is the run that was never stopped.

    It has one of two methods, and the other follows from it: :meth:`follow`, where submaps can be made while records
    come, or :meth:`submaps`, where only the whole log says what they are.
    """

    name: ClassVar[str]
    draws: ClassVar[bool] = False
    """Are its submaps drawn, so that another branch of the seed tree gives others?"""
    calibrates: ClassVar[str] = ""
    """What calibration uses beside the motion: ``sightings`` of landmarks, ``scans``, or nothing (no calibration)."""
    config: Any

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """Yield the submaps of a log that is whole, in order.

        Parameters
        ----------
        after : Submap or None
            The last submap that is already there; the next one starts at its end.
        drops : DropCounter or None
            Where records that are not used are counted.
        watch : callable or None
            Called with the front end's own progress after every step that it can show; changes nothing.
        """
        found = self.follow(RecordSource(log), seed=seed, after=after, drops=drops, watch=watch)
        return (submap for submap in found if submap is not None)

    def follow(
        self,
        feed: RecordSource,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap | None]:
        """Yield submaps as soon as the records that have come make them; None: all of these are used, more are wanted.

        The submaps are the same in whatever portions the records come, and those of :meth:`submaps`.

        Parameters
        ----------
        seed, after, drops, watch
            As in :meth:`submaps`.
        """
        while not feed.ended:
            yield None
        yield from self.submaps(feed.log, seed=seed, after=after, drops=drops, watch=watch)

    @classmethod
    def incremental(cls) -> bool:
        """Does it make submaps while records come?"""
        return cls.follow is not FrontEnd.follow

    def with_calibration(self, log: SensorLog, asked: Mapping[str, Any], *, corrected: bool, drift: bool) -> FrontEnd:
        """The front end for a log whose noise was estimated.

        Parameters
        ----------
        asked : mapping
            Options of this front end that the user set: they stay.
        corrected : bool
            Systematic errors were estimated and removed, and nothing contradicts the estimates.
        drift : bool
            The errors of the odometry by the metre were estimated from scans.
        """
        return self

    def steps(self, log: SensorLog) -> Steps | None:
        """The steps that it made of the log, for a refinement by scans; None where it works on no scans."""
        return None

    def forget(self) -> None:
        """Free the memory of what it keeps of the last log; it is made again where it is asked for."""
        return

    def observations(self, log: SensorLog) -> tuple[str, LandmarkObservations] | None:
        """Name of the stream of landmarks that it reads, and the observations in it; None where it tells none.

        They are what ``sightings`` of its submaps are counted in, so that their identities can be audited.
        """
        return None
