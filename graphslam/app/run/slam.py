"""Online SLAM: records are added one after the other."""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.options import RunOptions
from graphslam.app.run.outputs import write_outputs
from graphslam.app.run.pipeline import finish_run, run
from graphslam.app.run.run import Run
from graphslam.app.run.stages import RunClock
from graphslam.app.run.submap_slam import SubmapSlam
from graphslam.backend.back_end import Observer
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.poses import group_of
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import LandmarkObservations, LaserScans, Stream
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.stream_checks import check_streams
from graphslam.io.growing_log import GrowingLog
from graphslam.io.log_kinds import kind_name
from graphslam.maps.global_map import GlobalMap, make_global_map
from graphslam.solve.batch import state_of
from graphslam.solve.solution import make_solution
from graphslam_frontends.base import PoseEstimate

SCANS = (LaserScans, RangeScans, PointClouds, LandmarkObservations)
"""Records after which observers get the current pose."""


class Slam:
    """Online SLAM: the same as :func:`graphslam.run`, but records are added from outside.

    Records are added in the order of their time stamps. A submap enters the graph, which is then solved, as soon as its
    records are complete; :attr:`map` and :attr:`path` are those of the graph. Steps that need the whole log are in
    :meth:`finish`: the last search for loops, refinement with scans, map fusion, and the verdict. The result has the
    same bytes as that of ``gs.run`` with the same records and options.

    Used beams are freed from memory; they stay on disk until the end, where the verdict and a refinement read them
    once more. The work is done inside :meth:`add`, in the caller's thread, with one BLAS thread. If sensors cannot
    wait, put a queue in between.

    Some steps need the whole log; :attr:`waits_for` names the first of them. Then records are only stored, and
    :meth:`finish` runs over them. This applies to front ends that decide late (``rbpf-grid``), compute their steps from
    the whole log (``scan-window``), or make a single map; to options of ``segslam``; to an IMU, a compass or beacons in
    the graph; and to calibration (``calibrate.given``, ``calibrate.use = "always"``). With ``"auto"`` nothing is
    estimated from records that arrive later; the noise is that of the options.

    Parameters
    ----------
    frontend : str
        Registered name.
    name : str
        Of the log, in reports.
    solver, seed
        As for :func:`graphslam.run`.
    out : path, optional
        Run folder; without one nothing is written.
    config : mapping, optional
        Nested options: ``{"frontend": {...}, "backend": {...}, "gps": {...}}``; ``"preset"`` names a source whose
        recommended settings are used, by default none.
    observers : sequence of Observer
        Notified during the run (:class:`graphslam.backend.back_end.Observer`).
    records : path, optional
        Folder for beams during recording; default: a temporary folder, deleted at the end.

    Raises
    ------
    GraphSlamError
        Or one of its children; the message has what, where, got, wanted.

    Examples
    --------
    >>> with gs.Slam("rbpf-ekf", config={"frontend": {"particles": 10}}) as slam:
    ...     slam.add(log["controls"])
    ...     slam.add(log["landmarks"])
    ...     done = slam.finish()
    >>> len(done.submaps) > 3
    True
    """

    def __init__(
        self,
        frontend: str,
        *,
        name: str = "live",
        solver: str = "isam2",
        seed: int = 0,
        out: str | Path | None = None,
        config: Mapping[str, Any] | None = None,
        observers: Sequence[Observer] = (),
        records: str | Path | None = None,
    ) -> None:
        options = RunOptions.for_records(name, frontend, solver, seed, config)
        self.waits_for = _waits_for(options)
        """The part that needs the whole log; empty if submaps are made while records arrive."""
        self._asked: dict[str, Any] = {
            "frontend": frontend, "solver": solver, "seed": seed, "out": out,
            "config": {"preset": "none", **(config or {})}, "progress": list(observers) or False,
        }  # fmt: skip
        self._stack, self._closed, self._to = ExitStack(), False, tuple(observers)
        self._run: Run | None = None
        self._seconds = 0.0
        with self._closing_on_error():
            folder = records or self._stack.enter_context(tempfile.TemporaryDirectory(prefix="graphslam-records-"))
            self._feed = GrowingLog(name, folder)
            self._slam: SubmapSlam | None = None
            if self.waits_for:
                return
            self._folder = self._stack.enter_context(RunFolder.start(out, options.as_config(), resume=False))
            self._stack.enter_context(one_blas_thread())
            gc.collect()
            gc.freeze()  # a full garbage collection during `add` takes 0.1 s, most of it for imported modules
            self._stack.callback(gc.unfreeze)
            self._slam = SubmapSlam(options, self._feed, observers, self._folder)

    def add(self, records: Stream, stream: str | None = None) -> None:
        """Add one or more records of a sensor, and process all that is complete.

        Records that are not later than those of the stream so far (late, or given twice) are dropped, and counted in
        :attr:`dropped` and in the report of the run.

        Parameters
        ----------
        records : Stream
            Of any type that a log can have, such as :class:`graphslam.PointClouds` with one scan; mounting, limits and
            noise of the sensor must be the same every time.
        stream : str, optional
            Name of the sensor; default: name of the type of its records (``PointClouds``: ``point-clouds``).

        Raises
        ------
        DataError
            The records are of another sensor. They are not added; others may follow.
        GraphSlamError
            The front end or the graph cannot use the records; no more records are accepted.
        """
        if self._feed.ended or self._closed:
            raise DataError("records after the end", where=self._feed.name, wanted="a new Slam")
        begin = time.perf_counter()
        self._feed.add(stream or kind_name(records), records)
        if self._slam is not None:
            try:
                self._slam.step()
            except BaseException:
                self.close()
                raise
            watching = [o for o in self._to if type(o).pose_estimated is not Observer.pose_estimated]
            here = self.estimate if watching and isinstance(records, SCANS) else None
            if here is not None:
                for o in watching:
                    o.pose_estimated(here)
        self._seconds += time.perf_counter() - begin

    @property
    def dropped(self) -> dict[str, int]:
        """Numbers of records that came late or twice, by stream."""
        return dict(self._feed.drops.counts)

    @property
    def estimate(self) -> PoseEstimate | None:
        """The current pose; None before the first.

        ``pose`` is ``T_world_base``, in the frame of the first base, with the current poses of the graph;
        ``covariance`` is that of the motion since the submap ``anchor``. ``segslam`` answers after every scan: mean of
        the particles, then dead reckoning over the time ``lag``. Other front ends answer with the end of the last
        submap, at ``time``.
        """
        if self._slam is None or self._slam.options.front is None:
            return None
        graph, submaps = self._slam.back.graph, self._slam.submaps
        found, n = self._slam.options.front.estimate(), len(submaps)
        if found is None:
            if not n:
                return None
            end, d = submaps[-1].interval[1], group_of(graph.values.poses).dof
            return PoseEstimate(end, n, graph.values.poses[graph.submaps[-1].exit_node], np.zeros((d, d)), end)
        if not n:
            return found
        at = graph.submaps[-1].exit_node if found.anchor >= n else graph.submaps[found.anchor].node
        g, T = group_of(found.pose), graph.values.poses[at]
        for s in self._slam.waiting[: max(found.anchor - n, 0)]:
            T = g.compose(T, s.exit_pose)
        return replace(found, pose=g.compose(T, found.pose))

    @property
    def submaps(self) -> Sequence[Submap]:
        """Finished submaps, which are in the graph."""
        return () if self._slam is None else tuple(self._slam.submaps)

    @property
    def map(self) -> GlobalMap:
        """The current map: trajectory, nodes and landmarks of the graph; after :meth:`finish` that of the run.

        Raises
        ------
        MissingDataError
            No submap is finished yet.
        """
        if self._run is not None:
            return self._run.map
        if self._slam is None or not self._slam.submaps:
            why = self.waits_for or "the first submap ends after its last record"
            raise MissingDataError(f"no submap is finished yet: {why}", where=self._feed.name)
        back, submaps = self._slam.back, self._slam.submaps
        here = make_solution(
            self._asked["solver"], back.graph, state_of(back.graph), iterations=0, gap=None, seconds=0.0
        )
        least = self._slam.options.settings.backend.confirmed_hits
        return make_global_map(here, submaps, back.landmark_hits(submaps), least)

    @property
    def path(self) -> Trajectory:
        """The current path, in the frame of the first base, up to the end of the last submap: see :attr:`map`."""
        return self.map.trajectory

    @property
    def log(self) -> SensorLog:
        """All records, after :meth:`finish`; their data are on disk in the folder ``records``."""
        return self._feed.log

    def finish(self) -> Run:
        """End of the records: the last submap, loops, the refined path, maps, and the verdict.

        Raises
        ------
        GraphSlamError
            No map can be made from the records.
        """
        if self._run is not None:
            return self._run
        if self._closed:
            raise DataError("it was closed", where=self._feed.name, wanted="a new Slam")
        self._closed = True
        with self._stack:
            self._feed.end()
            self._run = self._whole() if self._slam is None else self._finished(self._slam)
        return self._run

    def close(self) -> None:
        """Release locks and files; without :meth:`finish` there is no result."""
        self._closed = True
        self._stack.close()

    def __enter__(self) -> Slam:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _whole(self) -> Run:
        return run(self._feed.log, **self._asked)

    def _finished(self, slam: SubmapSlam) -> Run:
        log, clock = self._feed.log, RunClock(self._seconds)  # without the time between records
        noticed = check_streams(log)
        if self._folder is not None:
            slam.options = slam.options.with_digest(log)
            self._folder.describe(slam.options.as_config())
        result = finish_run(log, slam, clock, noticed)
        return result if self._folder is None else write_outputs(self._folder.path, result)

    def _closing_on_error(self) -> ExitStack:
        guard = ExitStack()
        guard.push(lambda kind, *_: self._stack.close() if kind is not None else None)
        return guard


def _waits_for(options: RunOptions) -> str:
    """The part that needs the whole log; empty if there is none."""
    front, settings = options.front, options.settings
    assert front is not None
    if front.waits_for():
        return front.waits_for()
    for what, use in (("imu", settings.imu.use), ("compass", settings.compass.use), ("beacons", settings.beacons.use)):
        if use != "none":
            return f"{what}.use = {use!r} needs the whole log"
    if settings.calibrate.given is not None or settings.calibrate.use == "always":
        return "a calibration is applied to the whole log"
    return ""
