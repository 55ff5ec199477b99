"""Fixes, IMUs and other sensors of a log as inputs of the graph; IMUs once their axes were checked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.backend.config import BeaconOptions, CompassOptions, GpsOptions, ImuOptions
from graphslam.core.errors import MissingDataError
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.record_source import RecordSource
from graphslam.core.records import Compass, Gps, LandmarkObservations
from graphslam.evaluate.gps_repeatability import fix_segments
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.ledger import EXCLUSIVE
from graphslam.graph.sensors import sensor_kinds
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.solve.registry import Solver

Mask = npt.NDArray[np.bool_]

CHECKED_AFTER = 30.0
"""Duration of the path before the axes of an IMU are checked [s]."""
RECENTRED = 4
"""Largest number of repeated preintegrations about the estimated bias."""


def used_fixes(gps: Gps, config: GpsOptions) -> Mask:
    """Fixes that become factors ``(n,)``; the others are withheld."""
    n = len(gps.times)
    index = np.arange(n)
    segment = fix_segments(gps.times, config.segment_gap)
    masks = {
        "none": np.zeros(n, dtype=bool),
        "all": np.ones(n, dtype=bool),
        "every-second": index % 2 == 0,
        "even-segments": segment % 2 == 0,
        "odd-segments": segment % 2 == 1,
    }
    mask, last = masks[config.use], -np.inf
    for k in np.flatnonzero(mask).tolist() if config.every > 0 else []:
        if gps.times[k] - last < config.every * (1.0 - 1e-6):
            mask[k] = False
        else:
            last = gps.times[k]
    return mask


def split_fixes(gps: Gps, config: GpsOptions) -> tuple[Gps, Gps]:
    """(fixes that become factors, fixes withheld)."""
    mask = used_fixes(gps, config)
    used, withheld = gps.take(mask), gps.take(~mask)
    return used.with_sigma(config.sigma), withheld


class GpsSource:
    """The GPS fixes of a run; they are added to the graph submap by submap."""

    def __init__(self, feed: RecordSource, config: GpsOptions) -> None:
        self.feed, self.config = feed, config
        self._given = 0
        self._all: Gps | None = None

    def next(self, until: float) -> Gps | None:
        """Fixes up to a time [s] that become factors and were not returned before; None if there are none."""
        name = self.feed.of_type(Gps)
        if name is None or self.config.use == "none":
            return None
        used = self._all
        if used is None:
            whole: Gps = self.feed.part(name)  # type: ignore[assignment]
            used = split_fixes(whole, self.config)[0]
            self._all = used if self.feed.ended else None
        last = int(np.searchsorted(used.times, until, side="right"))
        first, self._given = self._given, max(self._given, last)
        return used.take(slice(first, last)) if last > first else None


class OtherSources:
    """Sensors of a log without options; their readings are added to the graph submap by submap."""

    def __init__(self, feed: RecordSource) -> None:
        self.feed = feed
        self._given: dict[str, int] = {}

    def give(self, graph: FactorGraph, until: float) -> None:
        """Add the readings up to a time [s] that were not added before."""
        for kind in sensor_kinds().values():
            if kind.options is not None or graph.dim not in kind.dims:
                continue
            for name in self.feed.names(kind.readings):
                first = self._given.get(name, 0)
                part = self.feed.part(name, first)
                count = int(np.searchsorted(part.times, until, side="right"))
                if count:
                    kind.of(graph).add(part.take(slice(0, count)), stream=name)
                    self._given[name] = first + count


def imus_of(feed: RecordSource) -> dict[str, Imu]:
    """The IMUs of a log by name, with the records so far."""
    return {name: feed.part(name) for name in feed.names(Imu)}  # type: ignore[misc]


def optional_sensors(
    log: SensorLog, compass: CompassOptions, beacons: BeaconOptions
) -> Iterator[tuple[str, Any, CompassOptions | BeaconOptions]]:
    """Compasses and distances to beacons to use: name of the stream, readings, options."""
    for kind, config, option in ((Compass, compass, "compass.use"), (LandmarkObservations, beacons, "beacons.use")):
        found = {name: s for name, s in log.streams.items() if isinstance(s, kind)}
        words = ("none", "auto") if kind is Compass else ("none",)
        if config.use in words:
            yield from ((name, s, config) for name, s in found.items() if config.use == "auto")
        elif config.use in found:
            yield config.use, found[config.use], config
        else:
            raise MissingDataError(
                f"{option} names no stream of {kind.__name__} of the log",
                got=config.use,
                wanted=", ".join([*words, *(found or ["(it has none)"])]),
            )


class ImuSource:
    """The IMUs of a run; their axes are checked, and factors are added, during the run."""

    def __init__(self, feed: RecordSource, config: ImuOptions) -> None:
        self.feed, self.config = feed, config
        self._looked: set[str] = set()
        self._given: set[str] = set()
        known = feed.names(Imu)
        if config.use not in ("none", "auto") and config.use not in known:
            raise MissingDataError(
                "imu.use names no IMU of the log",
                got=config.use,
                wanted=f"none, auto, {', '.join(known) or '(it has none)'}",
            )

    @property
    def imus(self) -> dict[str, Imu]:
        """The IMUs of the log by name, with the records so far."""
        return imus_of(self.feed)

    def look(self, graph: FactorGraph) -> None:
        """Compare the axes of every IMU with the path, once, as soon as the path is long enough.

        IMUs used by the front end are checked, too: a path made with wrong axes contradicts the specific forces.
        """
        if self.config.axes == "ignore" or not graph.submaps:
            return
        now = graph.submaps[-1].interval[1]
        for name in [n for n in self.feed.names(Imu) if n not in self._looked]:
            times = self.feed.part(name, 0, 1).times
            begin = max(float(times[0]), graph.submaps[0].interval[0]) if len(times) else np.inf
            if now - begin >= CHECKED_AFTER:
                self._looked.add(name)
                ImuFactors.of(graph).check(self.imus[name], stream=name, axes=self.config.axes)

    def attach(self, graph: FactorGraph, *, more: bool = False) -> int:
        """Add factors of the selected IMUs to the graph; returns the number of new factors.

        Parameters
        ----------
        more : bool
            More submaps follow, so one-time messages on an IMU are deferred.
        """
        made = 0
        for name in self._wanted(graph):
            imu = self.imus[name]
            if name in self._given:  # its readings were added before; only submaps are new
                imu = imu.take(np.zeros(len(imu.times), dtype=bool))
            made += len(ImuFactors.of(graph).add(imu, stream=name, config=self.config, more=more))
            self._given.add(name)
        return made

    def _wanted(self, graph: FactorGraph) -> list[str]:
        if self.config.use == "none":
            return []
        if self.config.use != "auto":
            return [self.config.use]
        spent = {e.stream for e in graph.ledger.entries() if e.kind == EXCLUSIVE}
        return [name for name in self.imus if name in self._given or name not in spent]


def repreintegrate_until_converged(graph: FactorGraph, solver: Solver) -> None:
    """Solve, preintegrate about the estimated biases and solve again, until the biases are unchanged."""
    solver.solve_to_optimum()
    for _ in range(RECENTRED):
        if not ImuFactors.of(graph).recentre():
            return
        solver.solve_to_optimum()
