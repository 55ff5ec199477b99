"""Interface of all front ends: sensor data in, submaps out, one at a time, resumable after any submap."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LandmarkObservations
from graphslam.core.submap import Submap
from graphslam_frontends.odometry.steps import Steps

Watch: TypeAlias = Callable[[Any], None]
"""Callback for the progress of a front end, of its own type (``segslam``:
`graphslam_frontends.segslam.progress.SegSlamProgress`)."""


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """The current pose of the base, relative to a submap.

    Parameters
    ----------
    time : float
        Stamp [s].
    anchor : int
        Key of the submap whose base the pose is relative to; the number of submaps so far: the end of the last one.
    pose : (7,) or (3,)
        ``T_anchor_base``.
    covariance : (6, 6) or (3, 3)
        Of ``pose``, right tangent. The covariance of the anchor in the map is not included.
    filtered : float
        Scans until this time are used [s]; after it the motion is dead reckoning.
    """

    time: float
    anchor: int
    pose: Array
    covariance: Array
    filtered: float

    @property
    def lag(self) -> float:
        """Time since the last scan that is used [s]."""
        return self.time - self.filtered


@runtime_checkable
class FrontEnd(Protocol):
    """A front end registered under the entry point ``graphslam.frontends``.

    Classes inherit from it. A front end is built from its configuration alone. All its random numbers are from
    ``seed.child(key of the submap)``, and a submap depends only on the log and the end of the previous one, so that a
    run resumed after submap k gives the same result as an uninterrupted one.

    It implements one of two methods, from which the other follows: :meth:`follow`, if submaps can be made while records
    arrive, or :meth:`submaps`, if the whole log is needed.
    """

    name: ClassVar[str]
    draws: ClassVar[bool] = False
    """Do its submaps depend on random numbers, that is on the seed?"""
    calibrates: ClassVar[str] = ""
    """Data for the calibration besides the motion: ``observations`` of landmarks, ``scans``, or none."""
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
        """Yield the submaps of a complete log, in order.

        Parameters
        ----------
        after : Submap or None
            The last existing submap; the next one starts at its end.
        drops : DropCounter or None
            Counts unused records.
        watch : callable or None
            Called with the progress of the front end after every step; does not change the result.
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
        """Yield submaps as soon as enough records have arrived; None: more records are needed.

        The submaps do not depend on the portions in which records arrive, and are those of :meth:`submaps`.

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
        """Does it output submaps while records arrive?"""
        return cls.follow is not FrontEnd.follow

    def waits_for(self) -> str:
        """The part that needs the whole log; empty if submaps are made while records arrive."""
        return "" if self.incremental() else f"the front end {self.name} needs the whole log"

    def estimate(self) -> PoseEstimate | None:
        """The current pose, while records arrive; None: not known yet, or only at the ends of submaps."""
        return None

    def with_calibration(self, log: SensorLog, asked: Mapping[str, Any], *, corrected: bool, drift: bool) -> FrontEnd:
        """The front end for a log whose noise was estimated.

        Parameters
        ----------
        asked : mapping
            Options of this front end that the user set: they are not changed.
        corrected : bool
            Systematic errors were estimated and removed, and no check contradicts the estimates.
        drift : bool
            The odometry errors per metre were estimated from scans.
        """
        return self

    def steps(self, log: SensorLog) -> Steps | None:
        """The steps of the log, for a refinement by scans; None if it uses no scans."""
        return None

    def forget(self) -> None:
        """Free the memory of the last log; its data are computed again when needed."""
        return

    def observations(self, log: SensorLog) -> tuple[str, LandmarkObservations] | None:
        """Name of its stream of landmarks, and the observations in it; None if it uses none.

        ``detections`` of its submaps are indices of these, so that data associations can be checked.
        """
        return None
